"""Cache of detections on disk.

With a cache, the network runs only once when other parameters of the pipeline are varied.
"""

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
from pycocotools import mask as coco

from framework.config.validation import checked_path
from framework.data import DeferredTruth, Detections, Frame, FrameTruth
from framework.detection.masks.binary_masks import tight_boxes
from framework.detection.stored.fingerprint import fingerprint
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import atomic_write, path_exists, read_bytes
from framework.files.hashing import add_array
from framework.interfaces import Detector, RGBDSequence

log = logging.getLogger(__name__)

FORMAT = 2  # version of the entries; part of the keys, so that other versions are never read
CHECKSUM_BYTES = 32  # SHA-256 of an entry's name and content, stored before the content
SUFFIX = ".detections"
LARGEST_ENTRY = 2**30  # maximum size of an entry, bytes; 1000 masks with 1 MB of run lengths each
EMBEDDINGS, SPACE = "embeddings", "embedding_space"  # optional fields of Detections
FRAME_FIELDS = tuple(field.name for field in fields(Frame))
KEPT = ("boxes", "scores", "class_probabilities")  # fields of Detections that are stored unchanged


class CacheMode(Enum):
    """Values of `detection_cache`."""

    OFF = "off"
    READ_WRITE = "read_write"
    READ_ONLY = "read_only"


@runtime_checkable
class ReadsFields(Protocol):
    """Interface of detectors that read only some fields of a frame.

    Frames that are equal in these fields share a cache entry.
    """

    reads: tuple[str, ...]  # names of fields of Frame


@runtime_checkable
class Fingerprinted(Protocol):
    """Interface of detectors whose parameters do not identify their weights, for example a model name on a hub."""

    def fingerprint(self) -> str:
        """Return a hash of everything that determines the detections, except the frame.

        The hash must include the result of `framework.detection.stored.fingerprint.fingerprint(self)`.
        """


@dataclass
class CachedDetector(Detector):
    """A detector that stores its detections on disk and reuses them for equal frames.

    The key of an entry is a hash of the detector and of the frame fields that the detector reads. Frames that are equal
    in these fields share an entry, even if they are from different videos. Several processes may share a folder. A
    damaged entry is logged and computed again. You can delete entries at any time.
    """

    # not concurrent, because concurrent equal frames would each count as a miss
    detector: Detector
    directory: Path
    mode: CacheMode = CacheMode.READ_WRITE

    def __post_init__(self) -> None:
        self.calibration = self.detector.calibration
        self.classes, self.domain, self.reads = self.detector.classes, self.detector.domain, fields_read(self.detector)
        if unknown := set(self.reads) - set(FRAME_FIELDS):
            raise ConfigError(
                f"{type(self.detector).__name__}.reads: expected fields of Frame, got {', '.join(unknown)}"
            )
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
                    f"detection_cache_dir: expected a writable folder, got {self.entries} ({error.strerror}); choose "
                    "another folder"
                ) from error

    def check_sequence(self, sequence: RGBDSequence) -> None:
        self.detector.check_sequence(sequence)

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

    def _read(self, path: Path) -> Detections | None:
        if not path_exists(path):
            return None
        try:
            data = read_bytes(path, LARGEST_ENTRY)
        except DataError as error:
            log.warning("detection cache: %s; detecting the frame again", error)
            return None
        content = data[CHECKSUM_BYTES:]
        if (found := _checksum(path, content)) != data[:CHECKSUM_BYTES]:
            log.warning(
                "detection cache: %s: expected sha256 %s, got %s; detecting the frame again",
                path,
                data[:CHECKSUM_BYTES].hex(),
                found.hex(),
            )
            return None
        return unpack(content, self.classes)

    def _write(self, path: Path, detections: Detections) -> None:
        content = pack(detections)
        try:
            with atomic_write(path, sync_entry=False) as temporary:  # a lost entry is computed again
                temporary.write_bytes(_checksum(path, content) + content)
        except DataError as error:
            self._writes = False
            log.warning("detection cache: %s; storing no more detections in this run", error)


def _checksum(path: Path, content: bytes) -> bytes:
    """Return the SHA-256 of the name and content of an entry."""
    # the name detects an entry that was moved to another key
    return hashlib.sha256(f"{path.parent.name}/{path.name}\n".encode() + content).digest()


def fields_read(detector: Detector) -> tuple[str, ...]:
    """Return the names of the frame fields that a detector reads."""
    return detector.reads if isinstance(detector, ReadsFields) else FRAME_FIELDS


def identity_of(detector: Detector) -> str:
    """Return the fingerprint of a detector."""
    if not isinstance(detector, Fingerprinted):
        return fingerprint(detector)
    try:
        return detector.fingerprint()
    except AttributeError as error:  # older plugins call super().fingerprint(), which Detector no longer defines
        raise ConfigError(
            f"{type(detector).__name__}.fingerprint: expected a hash, got an error ({error}); call fingerprint() of "
            f"{fingerprint.__module__}"
        ) from error


def with_cache(detector: Detector, config: DictConfig) -> Detector:
    """Wrap a detector in a cache if `detection_cache` is enabled."""
    mode = config.detection_cache
    named = "off" if mode is False else mode  # YAML parses an unquoted off as false
    modes = {mode.value: mode for mode in CacheMode}
    if named not in modes:
        raise ConfigError(f"detection_cache: expected one of {', '.join(modes)}, got {mode!r}")
    if modes[named] is CacheMode.OFF:
        return detector
    if config.detection_cache_dir is not None:
        directory = checked_path("detection_cache_dir", config.detection_cache_dir)
    else:
        import platformdirs

        directory = Path(platformdirs.user_cache_dir("instancemap", appauthor=False)) / "detections"
    return CachedDetector(detector, directory, modes[named])


def cache_metrics(detector: Detector) -> Mapping[str, int]:
    """Return the numbers of cache hits and misses, or an empty mapping without a cache."""
    if not isinstance(detector, CachedDetector):
        return {}
    return {"detection_cache.hits": detector.hits, "detection_cache.misses": detector.misses}


def frame_hash(frame: Frame, reads: tuple[str, ...]) -> str:
    """Return the SHA-256 of some fields of a frame.

    Ground truth that is rendered on demand is identified by its origin, so that it is not rendered.
    """
    digest = hashlib.sha256()  # faster than BLAKE2 on processors with SHA instructions
    for name in sorted(reads):
        value = getattr(frame, name)
        digest.update(f"{name}=".encode())
        if isinstance(value, FrameTruth):
            if isinstance(value, DeferredTruth):
                digest.update(f"of {value.origin};".encode())
            else:
                add_array(digest, value.instance_ids)
            # repr distinguishes None from "None"; sorting makes the hash independent of the insertion order
            digest.update(repr(sorted(value.class_names.items())).encode())
        elif isinstance(value, np.ndarray):
            add_array(digest, value)
        else:  # numbers, camera and None; repr of a float is exact
            digest.update(f"{value!r};".encode())
    return digest.hexdigest()


def pack(detections: Detections) -> bytes:
    """Serialize detections to the content of an entry."""
    from safetensors.numpy import save

    boxes = tight_boxes(detections.masks).astype(np.int32)
    runs = []
    for mask, (x1, y1, x2, y2) in zip(detections.masks, boxes.tolist(), strict=True):
        # runs along rows; COCO's runs along columns would require a transposition
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
    """Deserialize detections from the content of an entry."""
    from safetensors.numpy import load

    stored = load(content)
    boxes, runs = stored["mask_boxes"], stored["runs"].tobytes()
    masks = np.zeros((len(boxes), *stored["shape"].tolist()), np.bool_)
    end = 0
    for mask, (x1, y1, x2, y2), length in zip(masks, boxes.tolist(), stored["run_bytes"].tolist(), strict=True):
        start, end = end, end + length
        rows = coco.decode({"size": [x2 - x1 + 1, y2 - y1 + 1], "counts": runs[start:end]}).T
        mask[y1 : y2 + 1, x1 : x2 + 1] = rows
    return Detections(
        masks=masks,
        classes=classes,
        exact=bool(stored["exact"][0]),
        embeddings=stored[EMBEDDINGS].copy() if EMBEDDINGS in stored else None,
        embedding_space=stored[SPACE].tobytes().decode() if SPACE in stored else "",
        boxes=stored["boxes"].copy(),  # a copy is writable, like the arrays from a detector
        scores=stored["scores"].copy(),
        class_probabilities=stored["class_probabilities"].copy(),
    )
