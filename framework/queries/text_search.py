"""Which objects of a map somebody means: by the embeddings of their pictures, or by class names and colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Float32, Float64, Instance, InstanceMesh
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import is_there
from framework.queries.map_queries import Map
from framework.runs.stored_runs import CONFIG, read_yaml
from framework.vocabulary.color_names import COLOR_NAMES, fits, nearest_names
from framework.vocabulary.text_queries import object_words

BY = ("embeddings", "names")
LEAST_MATCH = 0.1  # of names: below, an object is hardly what was asked for
LONGEST_QUERY = 1000  # characters
NAME_IT = "name it by --model, from Python by model="
WITH_EMBEDDINGS = "detector=with_embeddings (CLIP or SigLIP: pip install instancemap[transformers])"


@dataclass(frozen=True)
class Match:
    """An object that may be meant."""

    instance: Instance
    name: str  # of its likeliest class
    similarity: float  # by embeddings the cosine, in [-1, 1]; by names in [0, 1]: how probable class and colour are
    color: str  # what most of its surface is called, in the light that it was seen in: "brown"
    centroid: Float64  # (3,) m, of its vertices


@dataclass(frozen=True)
class QueryResult:
    """The objects of a map that words may mean."""

    by: str  # what they were found by: "embeddings" of their pictures, or "names" of classes and colours
    space: str  # the model that the map's embeddings are of, and its version; "" = it has no embeddings
    objects: tuple[Match, ...]  # best first; by embeddings all that have one, by names those that are meant


@dataclass(frozen=True)
class TextQuery:
    """What somebody looks for in a map. Raises ConfigError for what is no question."""

    words: str
    by: str | None = None  # of BY; None = embeddings where the map has any, or a model is named, else names
    model: str | None = None  # that embeds the words: a folder, a file or an id; None = that of the run's detector

    def __post_init__(self) -> None:
        if not isinstance(self.words, str) or not 0 < len(self.words.strip()) <= LONGEST_QUERY:
            raise ConfigError(
                f"the words to look for must be 1 to {LONGEST_QUERY} characters, found {self.words!r:.60}"
            )
        if self.by not in (None, *BY):
            raise ConfigError(f"by must be one of {', '.join(BY)}, found {self.by!r:.60}")
        if self.model is not None and self.by == "names":
            raise ConfigError(f"a model is of embeddings, and by names none is asked: found {self.model!r:.60}")


def search(scene: Map, question: TextQuery, run: Path | None = None) -> QueryResult:
    """The objects that the question means; `run` is the directory of the map's run, None = it is of none.

    Raises DataError for words that nothing is called, and where the embeddings that are asked for are not there or are
    of another model.
    """
    space = scene.scene.embedding_space
    by = question.by or ("embeddings" if space or question.model is not None else "names")
    if by == "names":
        return QueryResult(by, space, tuple(by_names(scene, question.words)))
    if not space:
        raise DataError(f"{run or 'this map'} has no embeddings: run with {WITH_EMBEDDINGS}, or ask by names")
    return QueryResult(by, space, tuple(by_embedding(scene, _embedded(question, space, run))))


def _embedded(question: TextQuery, space: str, run: Path | None) -> Float32:
    """The question's words (D,) in a map's space."""
    from framework.detection.hub.image_text import ImageTextModel

    name, revision = _model_of(run) if question.model is None else (question.model, "main")
    opened = ImageTextModel(name, revision, "cpu", half_precision=False)
    if opened.space != space:
        found = f"the embeddings of {run or 'this map'} are of {space}, and {name} is {opened.space}"
        raise DataError(f"{found}: the words need that very model, {NAME_IT}")
    return opened.embed_text(question.words)


def _model_of(run: Path | None) -> tuple[str, str]:
    """The model and the revision that a run's detector was made with. Raises DataError where its config has none."""
    if run is None:
        raise DataError(f"a map does not say of which model its embeddings are: {NAME_IT}, or ask by its run")
    node = read_yaml(run / CONFIG).get("detector") if is_there(run / CONFIG) else None
    if isinstance(node, dict) and isinstance(node.get("model"), str):
        return node["model"], str(node.get("revision", "main"))
    raise DataError(f"{run / CONFIG} does not say of which model the embeddings are: {NAME_IT}")


def by_embedding(scene: Map, text: Float32) -> list[Match]:
    """The objects by the cosine of the angle between their embedding and that of a text (D,), the nearest first.

    Objects without an embedding are left out. Raises DataError where the map's have another length.
    """
    with scene.lock:
        known = {k: i.embedding for k, i in scene.instances().items() if i.embedding is not None}
        if any(embedding.shape != text.shape for embedding in known.values()):
            raise DataError(f"the map's embeddings have other than the {len(text)} numbers of the model's texts")
        return _found(scene, {k: float(embedding @ text) for k, embedding in known.items()})


def by_names(scene: Map, query: str) -> list[Match]:
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


def _found(scene: Map, similarities: dict[int, float]) -> list[Match]:
    """The objects with these similarities by id, best first; of equals, the more trusted one."""
    instances, mesh = scene.instances(), scene.mesh()
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
