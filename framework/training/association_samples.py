"""Samples for the learned association: pairs of clusters and instances in synthetic rooms, with their true matches."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from omegaconf import DictConfig

from framework.config.composition import composed
from framework.data import Bool, Float64, Frame, Int32, Int64, PointClusters, Pose
from framework.detection.true_instances import true_objects
from framework.interfaces import BackEnd, ClusterRefiner, Detector, MapFuser, PoseTracker, RGBDSequence
from framework.mapping.instances.association import Association, LabeledMap, Matches
from framework.mapping.instances.learned_association import CandidatePairs, pairs_of
from framework.mapping.labels.pixel_lists import PixelLists
from framework.pipeline import Pipeline
from framework.registry import build
from framework.synthetic.room import RoomKind

STREAM = 0x6173_736F  # key of the random streams of rooms; differs from those of all datasets
DETECTORS = ("simulated", "simulated_yolo11n", "simulated_maskrcnn2go")
RULES = (
    *(["fuser.overlap_rule=SMALLER", f"fuser.min_overlap={overlap}"] for overlap in (0.2, 0.35, 0.5)),
    ["fuser.overlap_rule=IOU", "fuser.min_overlap=0.25"],
    ["fuser.association=GROUND_TRUTH"],
)
"""Rules of the runs that samples are recorded in. Each room has one of them, so that maps contain different errors."""

SCALED = ("attach_rate", "merge_rate", "split_rate", "boundary_noise", "confusion", "false_positives", "miss_rate")
UNLIMITED = ("boundary_noise", "false_positives")  # errors that are not probabilities
STUDIOS = 0.5  # probability of RoomKind.STUDIO before a uniform choice; these rooms have most objects
SCALES = (0.4, 1.6)  # range of the factors of the detection errors


@dataclass(frozen=True)
class Sample:
    """The pairs of a frame and the correct decisions.

    A decision is a pair of the cluster or a new instance. Clusters of a true object belong to the instance with most
    detections of this object. Clusters of no object belong to a new instance or to an instance of no object.
    """

    pairs: CandidatePairs
    shape: tuple[int, int]  # number of clusters and of instances
    is_correct: Bool  # (P,) True = the pair is a correct decision for its cluster
    new_is_correct: Bool  # (N,) True = a new instance is a correct decision

    @property
    def decided(self) -> Int64:
        """The clusters with pairs. The others have no decision."""
        return np.unique(self.pairs.clusters)

    def correct_decisions(self, chosen: Int32) -> int:
        """Return the number of correct decisions, given the chosen instance (N,) of each cluster, -1 = new."""
        allowed = np.zeros(self.shape, np.bool_)
        allowed[self.pairs.clusters, self.pairs.instances] = self.is_correct
        right = np.column_stack([allowed, self.new_is_correct])[np.arange(len(chosen)), chosen]  # -1 = last column
        return int(right[self.decided].sum())


class RecordingAssociation(Association):
    """Association that records its pairs and the correct decisions."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.samples: list[Sample] = []
        self._detections: defaultdict[int, Counter[int]] = defaultdict(Counter)  # by true object, by instance

    def match(self, scene: LabeledMap, frame: Frame, pose: Pose, clusters: PointClusters) -> tuple[PixelLists, Matches]:
        points, matches = super().match(scene, frame, pose, clusters)
        if clusters.detected:
            objects = true_objects(clusters, frame)
            pairs = pairs_of(scene.table, matches.overlaps, clusters, matches.frame_index)
            if len(pairs.clusters):
                self.samples.append(self._sample(pairs, matches, objects))
            for instance, true_object in zip(matches.instance_ids.tolist(), objects.tolist(), strict=True):
                self._detections[instance][true_object] += 1
        return points, matches

    def _sample(self, pairs: CandidatePairs, matches: Matches, objects: Int32) -> Sample:
        ids = matches.overlaps.instance_ids.tolist()
        counts = [self._detections[k] for k in ids]
        main = [max(sorted(one), key=one.__getitem__, default=0) for one in counts]
        of_instance = np.array(main, np.int32)
        observed = np.array([one[true_object] for one, true_object in zip(counts, main, strict=True)])
        same = objects[pairs.clusters] == of_instance[pairs.instances]
        # out of several instances of one object, only that with most detections is correct
        most = np.zeros(len(objects), np.int64)
        np.maximum.at(most, pairs.clusters[same], observed[pairs.instances[same]])
        of_object = objects[pairs.clusters] > 0
        is_correct = same & (~of_object | (observed[pairs.instances] == most[pairs.clusters]))
        has_instance = np.bincount(pairs.clusters[same], minlength=len(objects)) > 0
        return Sample(
            pairs=pairs,
            shape=(len(objects), len(ids)),
            is_correct=is_correct,
            new_is_correct=(objects == 0) | ~has_instance,
        )


class KeptFrames(RGBDSequence):
    """A sequence whose frames are kept in memory, for several runs."""

    def __init__(self, video: RGBDSequence) -> None:
        self.name = video.name
        self._frames = [video[k] for k in range(len(video))]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, k: int) -> Frame:
        return self._frames[k]


def record_room(room: int, frames: int, runs: int = 3, vary: bool = True) -> list[Sample]:
    """Map a random synthetic room with simulated detectors and return the samples of all frames.

    Args:
        room: The number of the room, which determines its content and the errors of the detectors.
        frames: The number of frames.
        runs: The number of runs, each with another detector.
        vary: True = the stages and the errors of the detectors are random. False = defaults.
    """
    rng = np.random.default_rng([STREAM, room])
    kind = RoomKind.STUDIO if rng.uniform() < STUDIOS else list(RoomKind)[int(rng.integers(len(RoomKind)))]
    step = int(rng.integers(4, 11))
    of_room = [
        "dataset=synthetic",
        f"dataset.scene=association{room}",
        f"dataset.kind={kind.name}",
        f"dataset.frames={frames * step}",
        f"dataset.stride={step}",
        "tracker=ground_truth",
        "backend=none",
        "fuser.voxel_size=0.02",
    ]
    video = KeptFrames(build(RGBDSequence, composed(*of_room).dataset))
    samples = []
    for run in range(runs):
        overrides = [*of_room, f"detector={DETECTORS[(room + run) % len(DETECTORS)]}", f"seed={runs * room + run}"]
        config = composed(*overrides, *(varied(overrides, rng) if vary else []))
        samples += record(config, video)
    return samples


def varied(overrides: Sequence[str], rng: np.random.Generator) -> list[str]:
    """Return overrides with a random rule, refiner and voxel size, and random errors of the detector."""
    detector = composed(*overrides).detector
    scaled = {name: float(detector[name]) * rng.uniform(*SCALES) for name in SCALED}
    return [
        *RULES[int(rng.integers(len(RULES)))],
        f"refiner={'identity' if rng.uniform() < 0.2 else 'chain'}",
        f"fuser.voxel_size={0.02 if rng.uniform() < 0.6 else 0.03}",
        *(f"detector.{key}={value if key in UNLIMITED else min(value, 0.9):.4f}" for key, value in scaled.items()),
    ]


def record(config: DictConfig, video: RGBDSequence) -> list[Sample]:
    """Map a sequence with the stages of a config and return the samples of its frames."""
    fuser = build(MapFuser, config.fuser)
    given = fuser.association  # type: ignore[attr-defined]  # all fusers with instances have it
    recording = RecordingAssociation(**{one.name: getattr(given, one.name) for one in fields(Association)})
    fuser.association = recording  # type: ignore[attr-defined]
    pipeline = Pipeline(
        build(Detector, config.detector),
        build(PoseTracker, config.tracker),
        build(ClusterRefiner, config.refiner),
        fuser,
        prefetch=0,
        backend=build(BackEnd, config.backend),
    )
    pipeline.run(video)
    return recording.samples


def stacked(samples: Sequence[Sample]) -> tuple[Float64, Int64, Int64, Bool, Bool]:
    """Return the features, clusters and instances of all pairs and their correct decisions, with unique indices."""
    first = np.cumsum([(0, 0), *(sample.shape for sample in samples)], axis=0)[:-1]
    return (
        np.concatenate([sample.pairs.features for sample in samples]),
        np.concatenate([sample.pairs.clusters + n for sample, (n, _) in zip(samples, first, strict=True)]),
        np.concatenate([sample.pairs.instances + m for sample, (_, m) in zip(samples, first, strict=True)]),
        np.concatenate([sample.is_correct for sample in samples]),
        np.concatenate([sample.new_is_correct for sample in samples]),
    )
