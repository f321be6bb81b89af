"""Detections that were computed before: an ablation over refiners and fusers runs its network once."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from omegaconf import DictConfig

from framework.config.validation import checked_path
from framework.data import Bool, DeferredTruth, Detections, Frame, FrameTruth, Int32
from framework.detection.domain import domain_of
from framework.detection.masks.binary_masks import tight_boxes
from framework.detection.stored.fingerprint import fingerprint
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import is_there, read_bytes, written_whole
from framework.files.hashing import add_array
from framework.interfaces import Detector

log = logging.getLogger(__name__)

FORMAT = 2  # of the entries: another one makes other keys, so that no entry is ever misread
CHECKSUM_BYTES = 32  # SHA-256 of an entry's place and content, before the content
SUFFIX = ".detections"
LARGEST_ENTRY = 2**30  # bytes; a thousand masks of 1 MB of run lengths
FRAME_FIELDS = tuple(field.name for field in fields(Frame))
EMBEDDINGS, SPACE = "embeddings", "embedding_space"  # of Detections, in entries that have them
KEPT = ("boxes", "scores", "class_probabilities")  # of Detections: arrays that are stored as they are


class CacheMode(Enum):
    """The values of `detection_cache`."""

    OFF = "off"
    READ_WRITE = "read_write"
    READ_ONLY = "read_only"


@runtime_checkable
class ReadsFields(Protocol):
    """A detector that looks at some fields of a frame only, and so shares more of the cache."""

    reads: tuple[str, ...]  # names of fields of Frame


@runtime_checkable
class Fingerprinted(Protocol):
    """A detector that gets weights by a name from the network, or through an address in a str: it adds their hash."""

    def fingerprint(self) -> str:
        """A hash of all that the detections depend on beside the frame, `fingerprint(self)` included."""


@dataclass
class CachedDetector(Detector):
    """Answers from a folder for the frames that `detector` has seen before, to the bit; asks it for the others.

    An entry is found by what the answer depends on: the detector's fingerprint, its classes, and the fields of the
    frame that it reads, all unless it says so. So a changed parameter, weight or image misses, and the same image of
    another video hits.
    Several processes may share a folder: entries are written whole, and two that write one write the same. A damaged
    entry is named in the log and computed again. Entries are never removed here; whoever needs the disk may delete any.
    It takes one frame at a time, whatever `detector` can: of equal frames at once, each would count as a miss.
    """

    detector: Detector
    directory: Path
    mode: CacheMode = CacheMode.READ_WRITE

    def __post_init__(self) -> None:
        self.classes = self.detector.classes
        self.domain = domain_of(self.detector)
        self.reads = self.detector.reads if isinstance(self.detector, ReadsFields) else FRAME_FIELDS
        unknown = set(self.reads) - set(FRAME_FIELDS)
        if unknown:
            raise ConfigError(f"{type(self.detector).__name__}.reads names no field of Frame: {', '.join(unknown)}")
        self.hits = 0
        self.misses = 0
        self._writes = self.mode is CacheMode.READ_WRITE
        identity = hashlib.sha256(repr((FORMAT, identity_of(self.detector), self.classes)).encode()).hexdigest()
        self.entries = self.directory / f"{type(self.detector).__name__}_{identity[:32]}"
        if self._writes:
            try:
                self.entries.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(
                    f"detection_cache_dir: {self.entries} could not be made: {error.strerror}; choose another folder"
                ) from error

    def detect(self, frame: Frame) -> Detections:
        path = self.entries / (frame_hash(frame, self.reads) + SUFFIX)
        found = self._read(path)
        if found is not None:
            self.hits += 1
            return found
        detections = self.detector.detect(frame)
        self.misses += 1
        if self._writes:
            self._write(path, detections)
        return detections

    def metrics(self) -> dict[str, int]:
        """The keys for metrics.json. A frame that the detector refused is neither a hit nor a miss."""
        return {"detection_cache.hits": self.hits, "detection_cache.misses": self.misses}

    def _read(self, path: Path) -> Detections | None:
        if not is_there(path):
            return None
        try:
            data = read_bytes(path, LARGEST_ENTRY)
        except DataError as error:
            log.warning("detection cache: %s: detected again", error)
            return None
        content = data[CHECKSUM_BYTES:]
        if _checksum(path, content) != data[:CHECKSUM_BYTES]:
            log.warning("detection cache: %s is damaged, or another entry's: detected again", path)
            return None
        return unpack(content, self.classes)

    def _write(self, path: Path, detections: Detections) -> None:
        content = pack(detections)
        try:
            with written_whole(path) as temporary:
                temporary.write_bytes(_checksum(path, content) + content)
        except DataError as error:
            self._writes = False
            log.warning("detection cache: %s; nothing more is stored in this run", error)


def _checksum(path: Path, content: bytes) -> bytes:
    """Of an entry: one that was moved to another frame's or detector's place does not hold."""
    return hashlib.sha256(f"{path.parent.name}/{path.name}\n".encode() + content).digest()


def identity_of(detector: Detector) -> str:
    """The fingerprint that the detector has of its own, else that of its class, code and parameters."""
    if not isinstance(detector, Fingerprinted):
        return fingerprint(detector)
    try:
        return detector.fingerprint()
    except AttributeError as error:  # once Detector itself had one, and those who added to it asked super()
        raise ConfigError(f"{type(detector).__name__}.fingerprint: {error}; call {fingerprint.__module__}'s") from error


def with_cache(detector: Detector, config: DictConfig) -> Detector:
    """`detector` behind the cache that `detection_cache` and `detection_cache_dir` at the top of the config ask for."""
    asked = config.detection_cache
    named = "off" if asked is False else asked  # an unquoted off is YAML's false
    modes = {mode.value: mode for mode in CacheMode}
    if named not in modes:
        raise ConfigError(f"detection_cache must be one of {', '.join(modes)}, found {asked!r}")
    if modes[named] is CacheMode.OFF:
        return detector
    return CachedDetector(detector, cache_directory(config.detection_cache_dir), modes[named])


def cache_metrics(detector: Detector) -> Mapping[str, int]:
    """Hits and misses of a detector behind a cache; nothing for another one."""
    return detector.metrics() if isinstance(detector, CachedDetector) else {}


def cache_directory(chosen: str | None) -> Path:
    """The folder chosen, or the one that the system has for such things."""
    if chosen is not None:
        return checked_path("detection_cache_dir", chosen)
    import platformdirs

    return Path(platformdirs.user_cache_dir("instancemap", appauthor=False)) / "detections"


def frame_hash(frame: Frame, reads: tuple[str, ...]) -> str:
    """SHA-256 (hex) of these fields of a frame. Faster than BLAKE2 wherever the processor knows SHA.

    Truth that is not rendered yet counts by its origin, so that a hit spares the rendering.
    """
    digest = hashlib.sha256()
    for name in sorted(reads):
        value = getattr(frame, name)
        digest.update(f"{name}=".encode())
        if isinstance(value, FrameTruth):
            if isinstance(value, DeferredTruth):
                digest.update(f"of {value.origin};".encode())
            else:
                add_array(digest, value.instance_ids)
            # repr tells None from "None", and no order of insertion
            digest.update(repr(sorted(value.class_names.items())).encode())
        elif isinstance(value, np.ndarray):
            add_array(digest, value)
        else:  # numbers, the camera and None: Python writes floats so that they read back exactly
            digest.update(f"{value!r};".encode())
    return digest.hexdigest()


def pack(detections: Detections) -> bytes:
    """An entry: safetensors with the arrays as they are, and each mask's run lengths inside its tight box.

    The rows of a mask stand for the columns of COCO's format: nothing has to be transposed, here or in `unpack`.
    """
    from pycocotools import mask as coco
    from safetensors.numpy import save

    boxes = tight_boxes(detections.masks).astype(np.int32)
    runs = []
    for mask, (x1, y1, x2, y2) in zip(detections.masks, boxes.tolist(), strict=True):
        rows = np.ascontiguousarray(mask[y1 : y2 + 1, x1 : x2 + 1])
        runs.append(coco.encode(rows.view(np.uint8).T)["counts"])
    arrays = {name: np.ascontiguousarray(getattr(detections, name)) for name in KEPT}
    if detections.embeddings is not None:
        arrays[EMBEDDINGS] = np.ascontiguousarray(detections.embeddings)
        arrays[SPACE] = np.frombuffer(detections.embedding_space.encode(), np.uint8)
    return save(
        {
            **arrays,
            "shape": np.array(detections.masks.shape[1:], np.int32),
            "exact": np.array([detections.exact]),
            "mask_boxes": boxes,
            "run_bytes": np.array([len(run) for run in runs], np.int32),
            "runs": np.frombuffer(b"".join(runs), np.uint8),
        }
    )


def unpack(content: bytes, classes: tuple[str, ...]) -> Detections:
    """The detections of an entry whose checksum holds."""
    from safetensors.numpy import load

    stored = load(content)
    masks = _unpack_masks(stored["runs"].tobytes(), stored["run_bytes"], stored["mask_boxes"], stored["shape"])
    # copies: arrays that a later stage could not write to would be a difference
    arrays = {name: stored[name].copy() for name in KEPT}
    embeddings = stored[EMBEDDINGS].copy() if EMBEDDINGS in stored else None
    space = stored[SPACE].tobytes().decode() if SPACE in stored else ""
    exact = bool(stored["exact"][0])
    return Detections(masks=masks, classes=classes, exact=exact, embeddings=embeddings, embedding_space=space, **arrays)


def _unpack_masks(runs: bytes, run_bytes: Int32, boxes: Int32, shape: Int32) -> Bool:
    from pycocotools import mask as coco

    masks = np.zeros((len(boxes), *shape.tolist()), np.bool_)
    end = 0
    for mask, (x1, y1, x2, y2), length in zip(masks, boxes.tolist(), run_bytes.tolist(), strict=True):
        start, end = end, end + length
        columns = coco.decode({"size": [x2 - x1 + 1, y2 - y1 + 1], "counts": runs[start:end]})
        mask[y1 : y2 + 1, x1 : x2 + 1] = columns.T
    return masks
