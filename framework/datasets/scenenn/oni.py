"""Frames of an OpenNI recording (.oni), decoded by the OpenNI 2 C library."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from framework.data import UInt8, UInt16
from framework.datasets.scenenn.oni_records import Images, OniContents, Stream, playable
from framework.errors import ConfigError, DataError, InstanceMapError, errors_of

LARGEST_TIME_DIFFERENCE = 33_000  # us, maximum between the images of a frame, as in SceneNN's own playback
WAITING = 30  # maximum number of unpaired images of a stream (1 s at 30 Hz); older ones are dropped
LIBRARIES = ("libOpenNI2.so.0", "libOpenNI2.so", "libOpenNI2.dylib", "OpenNI2.dll")
LONGEST_PATH = 255  # bytes, limit of OpenNI 2
PATIENCE = 10_000  # ms; playback counts as stalled after this time without an image

# constants from OniCAPI.h, OniCEnums.h and OniCProperties.h of OpenNI 2.2
API_VERSION = 2002
OK, TIME_OUT = 0, 102
SENSORS = {Stream.DEPTH: 3, Stream.COLOR: 2}
DEPTH_1_MM, DEPTH_100_UM, RGB888 = 100, 101, 200
PLAYBACK_SPEED, PLAYBACK_REPEAT = 100, 101
MANUAL = -1.0  # playback speed: images are delivered on request, so that no image is lost


class _VideoMode(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int) for name in ("pixel_format", "width", "height", "fps")]


class _Frame(ctypes.Structure):
    _fields_ = [
        ("data_size", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("sensor", ctypes.c_int),
        ("timestamp", ctypes.c_uint64),
        *((name, ctypes.c_int) for name in ("index", "width", "height")),
        ("mode", _VideoMode),
        *((name, ctypes.c_int) for name in ("cropped", "crop_x", "crop_y", "stride")),
    ]


@dataclass(frozen=True)
class OniImage:
    """One image of a recording."""

    stream: Stream
    time: int  # us
    pixels: npt.NDArray[Any]  # depth (H, W) uint16 mm, 0 = no reading; color (H, W, 3) uint8 RGB


@dataclass(frozen=True)
class OniFrame:
    """A color image and a depth image taken at about the same time."""

    color: UInt8  # (H, W, 3) RGB
    depth_mm: UInt16  # (H, W) mm, 0 = no reading
    color_time: int  # us
    depth_time: int  # us


def read_frames(contents: OniContents, scratch: Path) -> Generator[OniFrame]:
    """Yield the frames of a recording.

    Args:
        contents: The records of the recording.
        scratch: A folder for a repaired copy of a truncated recording.

    Raises:
        ConfigError: OpenNI 2 is not installed.
        DataError: OpenNI 2 cannot play the recording, or color and depth have different sizes.
    """
    with (
        errors_of(contents.path),
        playable(contents, scratch) as path,
        closing(play_in_subprocess(path, contents.streams)) as images,
    ):
        yield from pair(images)


def pair(images: Iterable[OniImage]) -> Iterator[OniFrame]:
    """Pair color and depth images that are in file order, and yield each pair as a frame.

    If the next color and depth images are more than LARGEST_TIME_DIFFERENCE apart, the earlier image is dropped.
    SceneNN's own playback drops the same images. The frame numbers therefore match the published trajectories.

    Raises:
        DataError: Color and depth have different sizes.
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
                raise DataError("expected color and depth of the same size, got {} px and {} px".format(*sizes))
            yield OniFrame(color.pixels, depth.pixels, color.time, depth.time)
            colors.popleft()
            depths.popleft()


def play_in_subprocess(path: Path, streams: Mapping[Stream, Images]) -> Generator[OniImage]:
    """Decode a file with `play` in a separate process and yield the images.

    A separate process is used because OpenNI 2 crashes on some damaged recordings.

    Raises:
        DataError: OpenNI 2 crashes or cannot play the file.
    """
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
        raise DataError(
            f"expected an intact recording, got an OpenNI 2 crash (exit status {player.exitcode}); download or record "
            "it again"
        ) from None
    finally:
        player.terminate()
        player.join()
        receiver.close()


def _deliver(sender: Connection, path: Path, streams: Mapping[Stream, Images]) -> None:
    """Send each image to the parent process, then None or an error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both processes; the parent ends the child
    try:
        with closing(play(path, streams)) as images:
            for image in images:
                sender.send(image)
            sender.send(None)
    except InstanceMapError as error:
        sender.send(error)
    except BrokenPipeError:
        return  # the receiver is closed


def play(path: Path, streams: Mapping[Stream, Images]) -> Generator[OniImage]:
    """Decode a file with OpenNI 2 and yield its images.

    Incomplete images are skipped.

    Raises:
        ConfigError: OpenNI 2 is not installed.
        DataError: OpenNI 2 cannot play the file.
    """
    openni = _library()
    file = os.fsencode(path)
    if len(file) > LONGEST_PATH:
        expected = f"expected a path of at most {LONGEST_PATH} bytes for OpenNI 2"
        raise DataError(f"{expected}, got {len(file)}; move the file to a shorter path")
    with ExitStack() as stack:
        _check(openni.oniInitialize(API_VERSION), openni, "initialize")
        stack.callback(openni.oniShutdown)
        device = ctypes.c_void_p()
        _check(openni.oniDeviceOpen(file, ctypes.byref(device)), openni, "open the recording")
        stack.callback(openni.oniDeviceClose, device)
        for name, value in ((PLAYBACK_REPEAT, ctypes.c_int(False)), (PLAYBACK_SPEED, ctypes.c_float(MANUAL))):
            status = openni.oniDeviceSetProperty(device, name, ctypes.byref(value), ctypes.sizeof(value))
            _check(status, openni, "set a playback property")
        handles = []
        for stream in Stream:
            handle = ctypes.c_void_p()
            status = openni.oniDeviceCreateStream(device, SENSORS[stream], ctypes.byref(handle))
            _check(status, openni, f"open the {stream.name.lower()} stream")
            stack.callback(openni.oniStreamDestroy, handle)
            handles.append(handle)
        for handle in handles:
            _check(openni.oniStreamStart(handle), openni, "play the recording")
        yield from _images(openni, handles, streams)


def _images(openni: Any, handles: Sequence[ctypes.c_void_p], streams: Mapping[Stream, Images]) -> Generator[OniImage]:
    """Yield the complete images in playback order.

    Args:
        openni: The OpenNI 2 library.
        handles: The stream handles in the order of Stream.
        streams: The image counts of the streams.
    """
    waited = (ctypes.c_void_p * len(handles))(*handles)
    last = dict.fromkeys(Stream, 0)
    while any(last[stream] < streams[stream].last for stream in Stream):
        which = ctypes.c_int()
        status = openni.oniWaitForAnyStream(waited, len(handles), ctypes.byref(which), PATIENCE)
        if status == TIME_OUT:
            reached = (f"{stream.name.lower()} image {last[stream]} of {streams[stream].last}" for stream in Stream)
            found = f"got a stall of OpenNI 2 after {' and '.join(reached)}"
            raise DataError(f"expected an intact recording, {found}; download or record it again")
        _check(status, openni, "play the recording")
        stream = list(Stream)[which.value]
        frame = ctypes.POINTER(_Frame)()
        status = openni.oniStreamReadFrame(handles[which.value], ctypes.byref(frame))
        _check(status, openni, "play the recording")
        try:
            last[stream], time = frame.contents.index, frame.contents.timestamp
            pixels = _pixels(stream, frame.contents)
        finally:
            openni.oniFrameRelease(frame)
        if pixels is not None:
            yield OniImage(stream, time, pixels)


def _pixels(stream: Stream, frame: _Frame) -> npt.NDArray[Any] | None:
    """Return a copy of the pixels, or None for an incomplete image."""
    pixel_format, shape = frame.mode.pixel_format, (frame.height, frame.width)
    if frame.data_size < frame.stride * frame.height:
        return None
    rows = np.frombuffer(ctypes.string_at(frame.data, frame.stride * frame.height), np.uint8).reshape(frame.height, -1)
    if stream == Stream.COLOR and pixel_format == RGB888:
        return rows[:, : 3 * frame.width].reshape(*shape, 3)
    if stream == Stream.DEPTH and pixel_format in (DEPTH_1_MM, DEPTH_100_UM):
        depth = np.ascontiguousarray(rows[:, : 2 * frame.width]).view(np.uint16)
        return depth if pixel_format == DEPTH_1_MM else ((depth.astype(np.uint32) + 5) // 10).astype(np.uint16)
    known = f"{RGB888} (RGB)" if stream == Stream.COLOR else f"{DEPTH_1_MM} (1 mm) or {DEPTH_100_UM} (100 um)"
    raise DataError(f"{stream.name.lower()}: expected OpenNI pixel format {known}, got {pixel_format}")


def _library() -> Any:
    for name in LIBRARIES:
        try:
            openni = ctypes.CDLL(name)
        except OSError:
            continue
        openni.oniGetExtendedError.restype = ctypes.c_char_p
        return openni
    raise ConfigError("OpenNI 2: expected an installed library, got none; run apt-get install libopenni2-0")


def _check(status: int, openni: Any, action: str) -> None:
    if status != OK:
        reason = " ".join((openni.oniGetExtendedError() or b"").decode(errors="replace").split())
        raise DataError(f"expected OpenNI 2 to {action}, got an error ({reason or f'status {status}'})")
