"""The frames of an OpenNI recording (.oni): color and depth, paired as by SceneNN's own play-back."""

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

LARGEST_TIME_DIFFERENCE = 33_000  # us, of the two images of a frame, as in SceneNN's play-back
WAITING = 30  # images of one stream that wait for the other, 1 s: the rest of the file may lack it


@dataclass(frozen=True)
class OniFrame:
    """Color and depth of about the same moment, registered or mirrored if they were recorded so."""

    color: UInt8  # (H, W, 3) RGB
    depth_mm: UInt16  # (H, W) mm, 0 = no reading
    color_time: int  # us
    depth_time: int  # us


def read_frames(contents: OniContents, scratch: Path) -> Generator[OniFrame]:
    """Yield the frames of a recording; a truncated one is copied into the folder `scratch` meanwhile.

    Raises ConfigError without OpenNI 2, and DataError if OpenNI 2 cannot play the recording to its end or the images
    cannot form a frame.
    """
    with (
        errors_of(contents.path),
        playable(contents, scratch) as path,
        closing(play_apart(path, contents.streams)) as images,
    ):
        yield from pair(images)


def pair(images: Iterable[OniImage]) -> Iterator[OniFrame]:
    """Yield the frames of images in the file's order; of two that are too far apart the earlier one is dropped.

    The published trajectories use the frame numbers of SceneNN's play-back, which does the same. Raises DataError if
    color and depth have different sizes.
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
    """Run `play` in its own process, as OpenNI 2 crashes on some damaged recordings."""
    spawn = multiprocessing.get_context("spawn")  # the library's threads and locks do not survive a fork
    receiver, sender = spawn.Pipe(duplex=False)
    player = spawn.Process(target=_deliver, args=(sender, path, streams), daemon=True)
    player.start()
    sender.close()
    try:
        while (received := receiver.recv()) is not None:
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
    """Send the images and then None, or the error that ended them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to both processes; the parent ends this one
    try:
        with closing(play(path, streams)) as images:
            for image in images:
                sender.send(image)
            sender.send(None)
    except InstanceMapError as error:
        sender.send(error)
    except BrokenPipeError:
        return  # the receiver is closed
