"""Tests for text queries by embeddings and by names of classes and colors."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import instancemap
from framework.api import query
from framework.commands.results.query import main
from framework.detection.hub.image_text import ImageTextModel
from framework.errors import ConfigError, DataError
from framework.interfaces import MapFuser
from framework.queries.map_queries import Map
from framework.queries.text_search import by_embedding, by_names, color_fit
from framework.vocabulary.color_names import COLOR_NAMES
from tests.support import registered
from tests.support.networks.tiny_image_text import SIDE, write_image_text
from tests.support.scenes.analytic_scene import room, walk
from tests.support.true_masks import fuse_masks, masks_of

EMBEDDINGS = np.float32([[1, 0], [0.6, 0.8], [0, 0]])
PROBABILITIES = [(0.9, 0.1), (0.2, 0.8), (0.6, 0.4)]


def mapped(embeddings: np.ndarray | None, space: str = "words@1") -> Map:
    """Map the analytic room with a chair, a bed and a chair of lower probability."""
    fuser: MapFuser = registered.built("fuser", "bayesian_tsdf", "fuser.voxel_size=0.08")
    for k, T in enumerate(walk(4)):
        frame = room().frame(T, k)
        fuse_masks(fuser, frame, masks_of(frame), [0.9] * 3, PROBABILITIES, embeddings, space)
    return Map(fuser.scene)


@pytest.fixture(scope="module")
def embedded() -> Map:
    return mapped(EMBEDDINGS)


@pytest.fixture(scope="module")
def run(embedded: Map, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    embedded.save(folder / "map.npz")
    return folder


@pytest.fixture(scope="module")
def run_without(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    mapped(None).save(folder / "map.npz")
    return folder


def test_query_by_embedding_ranks_by_similarity(embedded: Map) -> None:
    found = by_embedding(embedded, np.float32([0, 1]))
    assert [(one.instance.id, round(one.similarity, 4)) for one in found] == [(2, 0.8), (1, 0.0)]
    assert found[0].name == "bed"
    vertices = embedded.mesh(2).vertices
    np.testing.assert_allclose(found[0].centroid, vertices.mean(axis=0), atol=1e-5)
    with pytest.raises(DataError, match="expected embeddings of length 3"):
        by_embedding(embedded, np.float32([0, 1, 0]))


def test_query_by_names_ranks_by_class_probability(embedded: Map) -> None:
    found = by_names(embedded, "the chairs")
    assert [one.instance.id for one in found] == [1, 3]
    assert found[0].similarity > found[1].similarity
    assert by_names(embedded, "a bed")[0].instance.id == 2


def test_color_fit_is_fraction_of_surface(embedded: Map) -> None:
    whole, instance = embedded.mesh(), embedded.instances()[1]
    half = len(instance.vertices) // 2
    colors = np.full_like(whole.colors, 255)
    colors[instance.vertices[:half]] = (220, 20, 30)
    colors[instance.vertices[half:]] = (30, 60, 220)
    painted = replace(whole, colors=colors)
    share = half / len(instance.vertices)
    assert color_fit(painted, instance, ["red"]) == pytest.approx(share, abs=1e-3)
    assert color_fit(painted, instance, ["green", "blue"]) == pytest.approx(1 - share, abs=1e-3)
    assert color_fit(painted, instance, ["yellow"]) == pytest.approx(0, abs=1e-3)


def test_query_by_names_accepts_color_without_class(embedded: Map) -> None:
    for color in {one.color for one in by_names(embedded, "beds or chairs")}:
        found = by_names(embedded, color)
        assert [one.similarity for one in found] == sorted((one.similarity for one in found), reverse=True)
        assert color in {one.color for one in found}


@pytest.mark.parametrize("query", ["a blob", "a wooden chair", "the"])
def test_query_by_names_unknown_words_raise(embedded: Map, query: str) -> None:
    with pytest.raises(DataError, match=r"objects \(bed, chair\) or the colors black, gray") as refused:
        by_names(embedded, query)
    assert "'chair'" not in str(refused.value)


def asked(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["instancemap query", *words])
    status = 0
    try:
        main()
    except SystemExit as ended:
        status = int(ended.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_query_command_prints_method_and_matches(
    embedded: Map, run_without: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    absent = next(color for color in COLOR_NAMES if not by_names(embedded, f"a {color} bed"))
    status, out, _ = asked(monkeypatch, capsys, str(run_without), "chair")
    assert status == 0
    lines = out.splitlines()
    assert lines[0].startswith("by class names and colors, because this run has no embeddings; run it again with ")
    assert lines[1].split() == ["id", "class", "match", "confidence", "color", "position", "size"]
    assert lines[2].split()[:2] == ["1", "chair"]
    _, out, _ = asked(monkeypatch, capsys, str(run_without), "chair", "--by", "names", "--json", "--top", "1")
    answer = json.loads(out)
    assert (answer["by"], answer["space"], [one["id"] for one in answer["objects"]]) == ("names", None, [1])
    assert len(answer["objects"][0]["size"]) == 3
    _, out, _ = asked(monkeypatch, capsys, str(run_without), f"a {absent} bed")
    assert f"no object matches 'a {absent} bed'" in out


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["chair", "--by", "embeddings"], "expected embeddings of its objects, got none; run with"),
        (["flying saucer"], "query: expected classes of this map or colors, got 'flying', 'saucer'"),
    ],
)
def test_query_command_error_is_one_line(
    words: list[str], fault: str, run_without: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = asked(monkeypatch, capsys, str(run_without), *words)
    assert (status, out) == (1, "")
    assert fault in err
    assert len(err.splitlines()) == 1


def test_query_command_with_embeddings_requires_model(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No model is known for the embedding space of the fixture."""
    status, _, err = asked(monkeypatch, capsys, str(run), "a red chair")
    assert (status, len(err.splitlines())) == (1, 1)
    assert "expected the model of the embeddings in detector.model, got none; set --model" in err
    _, out, _ = asked(monkeypatch, capsys, str(run), "a bed", "--by", "names")
    assert out.splitlines()[0] == "by class names and colors"
    status, _, err = asked(monkeypatch, capsys, "nowhere", "a bed")
    assert status == 1
    assert "expected a run directory" in err
    assert asked(monkeypatch, capsys, str(run), "a bed", "--top", "0")[0] == 2


def test_query_with_embeddings_uses_model_of_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("transformers")
    folder = write_image_text(tmp_path / "siglip")
    model = ImageTextModel(str(folder), "main", "cpu", half_precision=False)
    crops = np.random.default_rng(3).integers(0, 255, (3, SIDE, SIDE, 3)).astype(np.uint8)
    scene = mapped(model.embed_crops(crops), model.space)
    scene.save(tmp_path / "map.npz")
    (tmp_path / "config.yaml").write_text(f"detector: {{model: {folder}}}\n")
    text = model.embed_text("red chair")
    cosines = {k: float(one.embedding @ text) for k, one in scene.instances().items() if one.embedding is not None}
    ranked = sorted(cosines, key=lambda k: -cosines[k])
    assert len(ranked) == 3
    status, out, _ = asked(monkeypatch, capsys, str(tmp_path), "red chair")
    assert status == 0
    assert out.splitlines()[0].startswith(f"by embeddings of {model.space}")
    assert [int(line.split()[0]) for line in out.splitlines()[2:]] == ranked
    for answer in (query(tmp_path, "red chair"), query(scene, "red chair", model=folder)):
        assert (answer.by, answer.space) == ("embeddings", model.space)
        assert {one.instance.id: one.similarity for one in answer.objects} == pytest.approx(cosines)
    clip = write_image_text(tmp_path / "clip", "clip")
    with pytest.raises(DataError, match=f"expected the model of its embeddings, {model.space}, got clip@"):
        query(scene, "red chair", model=clip)


def test_query_accepts_directory_name_and_map(embedded: Map, run: Path, run_without: Path) -> None:
    """Runs without embeddings are queried by class names."""
    assert query is instancemap.query
    answers = [query(run_without, "chairs"), query(str(run_without), "chairs"), query(embedded, "chairs", by="names")]
    assert [answer.by for answer in answers] == ["names"] * 3
    for answer in answers:
        assert [(one.instance.id, one.name) for one in answer.objects] == [(1, "chair"), (3, "chair")]
    assert (answers[0].space, answers[2].space) == ("", embedded.scene.embedding_space)
    absent = next(color for color in COLOR_NAMES if not by_names(embedded, f"a {color} bed"))
    assert query(run, f"a {absent} bed", by="names").objects == ()


def test_query_run_without_model_in_config_raises(embedded: Map, tmp_path: Path) -> None:
    embedded.save(tmp_path / "map.npz")
    for config in ("detector: null", "detector: 3", "detector: ${hydra:x}", "detector: {model: 4}", "seed: 0"):
        (tmp_path / "config.yaml").write_text(f"{config}\n")
        with pytest.raises(
            DataError,
            match=r"config.yaml: expected the model of the embeddings in detector.model, got none; set --model",
        ):
            query(tmp_path, "bed")


@pytest.mark.parametrize(
    ("question", "fault"),
    [
        ({"words": " "}, r"query: expected a text of 1 to 1000 characters, got ' '"),
        ({"words": "chair " * 200}, r"query: expected a text of 1 to 1000 characters, got 'chair chair"),
        ({"words": 7}, r"expected a text of 1 to 1000 characters, got 7$"),
        ({"words": "bed", "by": "name"}, r"by: expected one of embeddings, names, got 'name'"),
        ({"words": "bed", "by": "names", "model": "clip"}, r"model: expected no model for by='names', got 'clip'"),
    ],
)
def test_query_invalid_arguments_raise_before_reading(question: dict[str, Any], fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        query("nowhere", **question)


def test_query_unanswerable_request_raises(embedded: Map, run_without: Path) -> None:
    with pytest.raises(DataError, match=r"query: expected a run directory with map.npz, got .* without"):
        query("nowhere", "bed")
    with pytest.raises(
        DataError, match="expected embeddings of its objects, got none; run with detector=with_embeddings"
    ):
        query(run_without, "bed", model="clip")
    with pytest.raises(DataError, match=r"this map: expected embeddings .* or query by names"):
        query(instancemap.load_map(run_without / "map.npz"), "bed", by="embeddings")
    with pytest.raises(DataError, match=r"model: expected the model of the map's embeddings, got none; set --model"):
        query(embedded, "bed")
    with pytest.raises(DataError, match="query: expected classes of this map or colors, got 'saucer'"):
        query(embedded, "saucer", by="names")
