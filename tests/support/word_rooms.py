"""Synthetic rooms that are asked for each object by its colour and class: how often it is the first answer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from framework.api import pipeline_of
from framework.config.composition import composed
from framework.datasets.frames.frame_selection import TO_THE_END
from framework.evaluation.instances import MAX_DISTANCE, transfer_labels
from framework.interfaces import RGBDSequence
from framework.queries.map_queries import Map
from framework.queries.text_search import Found
from framework.registry import build
from framework.synthetic.sequence import Synthetic
from framework.synthetic.true_colors import NO_NAME, color_counts, color_of_materials, one_color
from framework.vocabulary.color_names import COLOR_NAMES

LEAST_SEEN = 0.005  # of a picture: what an object covers in a frame that shows it
LEAST_FRAMES = 3  # that show it, of those that are looked at
TRUTH_STRIDE = 8  # every such frame is looked at

Ask = Callable[[str], list[Found]]


@dataclass(frozen=True)
class AskedRoom:
    """A room that was mapped, what is in it and how it is asked."""

    sequence: Synthetic
    scene: Map
    called: dict[int, tuple[str, str]]  # by instance: colour and class, of what the video shows well

    def queries(self) -> dict[str, int]:
        """The instance that each "<colour> <class>" means, as far as it means one."""
        names = Counter(self.called.values())
        return {f"{color} {kind}": i for i, (color, kind) in self.called.items() if names[color, kind] == 1}

    def answers(self, ask: Ask) -> Iterator[tuple[str, int, int]]:
        """(query, the instance that is meant, that which most of the first answer's surface is of; 0 = none)."""
        truth, mesh = self.sequence.scene_truth(), self.scene.mesh()
        ids = transfer_labels(truth.points_world, truth.instance_ids, mesh.vertices, MAX_DISTANCE)
        for query, meant in self.queries().items():
            found = ask(query)
            on = ids[found[0].instance.vertices] if found else np.zeros(1, np.int32)
            yield query, meant, int(np.bincount(on).argmax())

    def name(self, instance: int) -> str:
        """What an instance is called, for the report."""
        return " ".join(self.called.get(instance, ("something", "else")))


def asked_room(scene: str, *overrides: str, stop: int = TO_THE_END, stride: int = 4) -> AskedRoom:
    """The room `scene`, mapped from given poses."""
    config = composed(
        "dataset=synthetic", f"dataset.scene={scene}", f"dataset.stop={stop}", f"dataset.stride={stride}",
        "tracker=ground_truth", "fuser.voxel_size=0.02", *overrides,
    )  # fmt: skip
    sequence = build(RGBDSequence, config.dataset)
    assert isinstance(sequence, Synthetic)
    pipeline = pipeline_of(config)
    pipeline.run(sequence)
    return AskedRoom(sequence, Map(pipeline.fuser.scene), called(sequence))


def called(sequence: Synthetic) -> dict[int, tuple[str, str]]:
    """The colour and the class of each instance that the frames show well, and that has both."""
    names = {i: name for i, name in sequence.class_names.items() if name is not None}
    colors = np.append(color_of_materials(sequence.room.surfaces.material_table), np.int32(NO_NAME))
    least = LEAST_SEEN * sequence.camera.width * sequence.camera.height
    counts = {i: np.zeros(len(COLOR_NAMES) + 1, np.int64) for i in names}
    shown: Counter[int] = Counter()
    for k in range(sequence.start, sequence.frames if sequence.stop == TO_THE_END else sequence.stop, TRUTH_STRIDE):
        T_world_camera = sequence.path.pose(k)
        color_of_pixel = colors[sequence.materials_seen(T_world_camera)]
        _, ids = sequence.exact_view(T_world_camera)
        for i in np.unique(ids).tolist():
            if i in names and np.count_nonzero(ids == i) >= least:
                shown[i] += 1
                counts[i] += color_counts(color_of_pixel, ids, i)
    found = {i: one_color(counts[i]) for i in names if shown[i] >= LEAST_FRAMES}
    return {i: (COLOR_NAMES[color], names[i]) for i, color in found.items() if color != NO_NAME}
