"""Which objects of a map somebody means: by the embeddings of their pictures, or by class names and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.color_names import COLOR_NAMES, fits, nearest_names
from framework.data import Float32, Float64, Instance, InstanceMesh
from framework.errors import DataError
from framework.object_queries import Map
from framework.object_words import object_words

LEAST_MATCH = 0.1  # of names: below, an object is hardly what was asked for


@dataclass(frozen=True)
class Found:
    """An object that may be meant."""

    instance: Instance
    name: str  # of its likeliest class
    similarity: float  # by embeddings the cosine, in [-1, 1]; by names in [0, 1], see there
    color: str  # of COLOR_NAMES: what most of its surface is called, in the light that it was seen in
    centroid: Float64  # (3,) m, of its vertices


def by_embedding(scene: Map, text: Float32) -> list[Found]:
    """The objects by the cosine of the angle between their embedding and that of a text (D,), the nearest first.

    Objects without an embedding are left out. Raises DataError where the map's have another length.
    """
    with scene.lock:
        known = {k: i.embedding for k, i in scene.instances().items() if i.embedding is not None}
        if any(embedding.shape != text.shape for embedding in known.values()):
            raise DataError(f"the map's embeddings have other than the {len(text)} numbers of the model's texts")
        return _found(scene, {k: float(embedding @ text) for k, embedding in known.items()})


def by_names(scene: Map, query: str) -> list[Found]:
    """The objects by how probably they are of a class that the query names, times how well a colour that it names fits
    their surface, without those that are not meant at all. Those that fit alike are ranked by their confidence.

    Raises DataError for a query with a word that is neither, or with none that is.
    """
    with scene.lock:
        words = object_words(query, scene.classes)
        if words.unknown or not (words.classes or words.colors):
            unknown = ", ".join(map(repr, words.unknown or [query]))
            there = ", ".join(sorted({scene.name(instance) for instance in scene.instances().values()}))
            raise DataError(
                f"no class of this map and no colour is called {unknown}; its objects are {there or 'none'}; colours "
                f"are {', '.join(COLOR_NAMES)}"
            )
        columns = [scene.classes.index(name) for name in words.classes]
        mesh, matches = scene.mesh(), {}
        for k, instance in scene.instances().items():
            of_class = float(instance.class_probabilities[columns].sum()) if columns else 1.0
            match = of_class * (color_fit(mesh, instance, words.colors) if words.colors else 1.0)
            if match >= LEAST_MATCH:
                matches[k] = round(match, 2)  # less tells nothing
        return _found(scene, matches)


def color_fit(mesh: InstanceMesh, instance: Instance, colors: Sequence[str]) -> float:
    """How well these colours fit an object, in [0, 1]: the mean over its vertices, by the colour that fits best."""
    colors_there = _colors(mesh, instance)
    return max((float(fits(colors_there, name).mean()) for name in colors), default=0.0) if len(colors_there) else 0.0


def _colors(mesh: InstanceMesh, instance: Instance) -> Float32:
    """(M, 3) sRGB in [0, 1] of an object's vertices."""
    return np.asarray(mesh.colors[instance.vertices].astype(np.float32) / np.float32(255), np.float32)


def _found(scene: Map, similarities: dict[int, float]) -> list[Found]:
    """The objects with these similarities by id, best first; of equals, the more trusted one."""
    instances, mesh = scene.instances(), scene.mesh()
    return [
        Found(
            instance=instances[k],
            name=scene.name(instances[k]),
            similarity=similarities[k],
            color=COLOR_NAMES[int(np.bincount(nearest_names(_colors(mesh, instances[k]))).argmax())],
            centroid=mesh.vertices[instances[k].vertices].mean(axis=0, dtype=np.float64),
        )
        for k in sorted(similarities, key=lambda k: (-similarities[k], -instances[k].confidence, k))
    ]
