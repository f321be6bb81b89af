"""Text queries for objects of a map, by image embeddings or by class names and colors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Float32, Float64, Instance, InstanceMesh
from framework.errors import ConfigError, DataError
from framework.queries.map_queries import Map
from framework.runs.stored_runs import CONFIG, read_config
from framework.vocabulary.color_names import COLOR_NAMES, fits, nearest_names
from framework.vocabulary.text_queries import object_words

BY = ("embeddings", "names")
MIN_MATCH = 0.1  # minimum similarity of a match by names
LONGEST_QUERY = 1000  # maximum number of characters of a query
NAME_IT = "set --model (Python: model=)"
WITH_EMBEDDINGS = "detector=with_embeddings (CLIP or SigLIP: pip install 'instancemap[transformers]')"


@dataclass(frozen=True)
class Match:
    """An object matching a text query."""

    instance: Instance
    name: str  # name of the most likely class
    similarity: float  # by embeddings: cosine in [-1, 1]; by names: probability of class and color in [0, 1]
    color: str  # name of the most frequent color of the observed surface, such as "brown"
    centroid: Float64  # (3,) m, mean of the vertices


@dataclass(frozen=True)
class QueryResult:
    """The objects of a map matching a text query."""

    by: str  # "embeddings" of images, or "names" of classes and colors
    space: str  # model and version of the map's embeddings; "" = no embeddings
    objects: tuple[Match, ...]  # best first; by embeddings: all objects with an embedding; by names: matching objects


@dataclass(frozen=True)
class TextQuery:
    """A text query.

    Raises:
        ConfigError: A value is invalid.
    """

    words: str  # text of 1 to 1000 characters
    by: str | None = None  # embeddings or names; None = embeddings if the map has any or `model` is set, else names
    model: str | None = None  # embedding model: folder or huggingface.co id; None = model of the run's detector

    def __post_init__(self) -> None:
        if not isinstance(self.words, str) or not 0 < len(self.words.strip()) <= LONGEST_QUERY:
            raise ConfigError(f"query: expected a text of 1 to {LONGEST_QUERY} characters, got {self.words!r:.60}")
        if self.by not in (None, *BY):
            raise ConfigError(f"by: expected one of {', '.join(BY)}, got {self.by!r:.60}")
        if self.model is not None and self.by == "names":
            raise ConfigError(f"model: expected no model for by='names', got {self.model!r:.60}")


def search(scene: Map, query: TextQuery, run: Path | None = None) -> QueryResult:
    """Return the objects matching a text query.

    Args:
        scene: Map.
        query: Text query.
        run: Run directory of the map, if any.

    Raises:
        DataError: A word is unknown, or the embeddings are missing or were computed by another model.
    """
    space = scene.scene.embedding_space
    by = query.by or ("embeddings" if space or query.model is not None else "names")
    if by == "names":
        return QueryResult(by, space, tuple(by_names(scene, query.words)))
    if not space:
        where = f"{run or 'this map'}: expected embeddings of its objects, got none"
        raise DataError(f"{where}; run with {WITH_EMBEDDINGS}, or query by names")
    return QueryResult(by, space, tuple(by_embedding(scene, _embedded(query, space, run))))


def _embedded(query: TextQuery, space: str, run: Path | None) -> Float32:
    """Return the text embedding (D,) of a query."""
    from framework.detection.hub.image_text import ImageTextModel

    name, revision = _model_of(run) if query.model is None else (query.model, "main")
    opened = ImageTextModel(name, revision, "cpu", half_precision=False)
    if opened.space != space:
        where = f"{run or 'this map'}: expected the model of its embeddings, {space}"
        raise DataError(f"{where}, got {opened.space} ({name}); {NAME_IT}")
    return opened.embed_text(query.words)


def _model_of(run: Path | None) -> tuple[str, str]:
    """Return the model and revision of the detector of a run."""
    if run is None:
        raise DataError(f"model: expected the model of the map's embeddings, got none; {NAME_IT}, or query its run")
    node = read_config(run).get("detector")
    if isinstance(node, dict) and isinstance(node.get("model"), str):
        return node["model"], str(node.get("revision", "main"))
    raise DataError(f"{run / CONFIG}: expected the model of the embeddings in detector.model, got none; {NAME_IT}")


def by_embedding(scene: Map, text: Float32) -> list[Match]:
    """Return all objects with an embedding, most similar to the text embedding (D,) first.

    The similarity is the cosine of both embeddings.

    Raises:
        DataError: The embeddings of the map have another length.
    """
    with scene.lock:
        instances, mesh = scene.instances(), scene.mesh()
    known = {k: i.embedding for k, i in instances.items() if i.embedding is not None}
    lengths = {len(embedding) for embedding in known.values()}
    if lengths - {len(text)}:
        raise DataError(f"map: expected embeddings of length {len(text)}, got {max(lengths - {len(text)})}")
    return _found(scene, instances, mesh, {k: float(embedding @ text) for k, embedding in known.items()})


def by_names(scene: Map, query: str) -> list[Match]:
    """Return the objects that match the classes and colors of a query, best match first.

    The similarity is the probability of the classes times the fit of the colors.

    Raises:
        DataError: A word is unknown, or the query has neither a class nor a color.
    """
    with scene.lock:
        instances, mesh, classes = scene.instances(), scene.mesh(), scene.classes
    words = object_words(query, classes)
    if words.unknown or not (words.classes or words.colors):
        unknown = ", ".join(map(repr, words.unknown or [query]))
        there = ", ".join(sorted({scene.name(instance) for instance in instances.values()}))
        raise DataError(
            f"query: expected classes of this map or colors, got {unknown}; use the classes of its objects "
            f"({there or 'none'}) or the colors {', '.join(COLOR_NAMES)}"
        )
    columns, matches = [classes.index(name) for name in words.classes], {}
    for k, instance in instances.items():
        of_class = float(instance.class_probabilities[columns].sum()) if columns else 1.0
        match = of_class * (color_fit(mesh, instance, words.colors) if words.colors else 1.0)
        if match >= MIN_MATCH:
            matches[k] = round(match, 2)  # finer differences are not significant
    return _found(scene, instances, mesh, matches)


def color_fit(mesh: InstanceMesh, instance: Instance, colors: Sequence[str]) -> float:
    """Return the fit of the vertex colors of an object to the best-fitting name, in [0, 1]."""
    observed = _colors(mesh, instance)
    return max((float(fits(observed, name).mean()) for name in colors), default=0.0) if len(observed) else 0.0


def _colors(mesh: InstanceMesh, instance: Instance) -> Float32:
    """Return the sRGB vertex colors (M, 3) of an object, in [0, 1]."""
    return np.asarray(mesh.colors[instance.vertices].astype(np.float32) / np.float32(255), np.float32)


def _found(
    scene: Map, instances: Mapping[int, Instance], mesh: InstanceMesh, similarities: dict[int, float]
) -> list[Match]:
    """Return the matches of objects with known similarities, best first."""
    return [
        Match(
            instance=instances[k],
            name=scene.name(instances[k]),
            similarity=similarities[k],
            color=COLOR_NAMES[int(np.bincount(nearest_names(_colors(mesh, instances[k]))).argmax())],
            centroid=mesh.vertices[instances[k].vertices].mean(axis=0, dtype=np.float64),
        )
        for k in sorted(similarities, key=lambda k: (-similarities[k], -instances[k].confidence, k))
    ]
