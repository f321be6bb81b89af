"""The frames of an OpenNI recording (.oni): colour and depth, paired as SceneNN's own play-back pairs them."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from framework.data import UInt8, UInt16
from framework.datasets.scenenn.oni_records import Images, OniContents, Stream, playable
from framework.datasets.scenenn.openni import OniImage, play
from framework.errors import DataError, InstanceMapError, errors_of

LARGEST_TIME_DIFFERENCE = 33_000  # us; SceneNN's play-back takes what is further apart for different moments
WAITING = 30  # images of one stream that wait for one of the other, 1 s: the rest of the file may lack it


@dataclass(frozen=True)
class OniFrame:
    """Colour and depth of about the same moment, as they were recorded: registered or mirrored, if they were then."""

    color: UInt8  # (H, W, 3) RGB
    depth_mm: UInt16  # (H, W) mm, 0 = not measured
    color_time: int  # us
    depth_time: int  # us


def read_frames(contents: OniContents, scratch: Path) -> Generator[OniFrame]:
    """The frames of a recording; one that was cut off is copied into the folder `scratch` meanwhile.

    Raises ConfigError where OpenNI 2 is not installed, DataError when it does not play the recording to its end, or the
    images are of a kind that a frame cannot be made of.
    """
    with (
        errors_of(contents.path),
        playable(contents, scratch) as path,
        closing(play_apart(path, contents.streams)) as images,
    ):
        yield from pair(images)


def pair(images: Iterable[OniImage]) -> Iterator[OniFrame]:
    """Frames of images in the file's order; of two that are too far apart the earlier one is left out.

    This is what SceneNN's play-back does, whose numbers the published trajectories refer to. Raises DataError when
    colour and depth have different sizes.
    """
    waiting = {stream: deque[OniImage](maxlen=WAITING) for stream in Stream}
    colors, depths = waiting[Stream.COLOR], waiting[Stream.DEPTH]
    for image in images:
        waiting[image.stream].append(image)
        while colors and depths:
            color, depth = colors[0], depths[0]
            if abs(color.time - depth.time) > LARGEST_TIME_DIFFERENCE:
                (depths if depth.time < color.time else colors).popleft()
                continue
            if color.pixels.shape[:2] != depth.pixels.shape:
                sizes = (f"{image.pixels.shape[1]}x{image.pixels.shape[0]}" for image in (color, depth))
                raise DataError("color is {} and depth {}; they must have the same size".format(*sizes))
            yield OniFrame(color.pixels, depth.pixels, color.time, depth.time)
            colors.popleft()
            depths.popleft()


def play_apart(path: Path, streams: Mapping[Stream, Images]) -> Generator[OniImage]:
    """`play` in a process of its own: OpenNI 2 crashes on some damaged recordings, and then only that process ends."""
    spawn = multiprocessing.get_context("spawn")  # the library's threads and locks do not survive a fork
    receiver, sender = spawn.Pipe(duplex=False)
    player = spawn.Process(target=_deliver, args=(sender, path, streams), daemon=True)
    player.start()
    sender.close()
    try:
        while True:
            received = receiver.recv()
            if received is None:
                return
            if isinstance(received, InstanceMapError):
                raise received
            yield received
    except (EOFError, OSError):
        player.join()
        raise DataError(f"it is damaged, OpenNI 2 crashed on it with status {player.exitcode}") from None
    finally:
        player.terminate()
        player.join()
        receiver.close()


def _deliver(sender: Connection, path: Path, streams: Mapping[Stream, Images]) -> None:
    """Sends the images and then None, or the fault that ended them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to both processes; the other one ends this one
    try:
        with closing(play(path, streams)) as images:
            for image in images:
                sender.send(image)
            sender.send(None)
    except InstanceMapError as error:
        sender.send(error)
    except BrokenPipeError:
        return  # nobody listens any more
