"""The network of words that comes with the project, in a room that it has not seen: a small share of the benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from framework.api import query as query_run
from framework.commands.results.query import main
from framework.detection.embeddings.image_text import open_image_text
from framework.files.search_paths import PROJECT_ROOT
from framework.queries.text_search import by_embedding
from framework.vocabulary.color_names import COLOR_NAMES
from tests.support.word_rooms import AskedRoom, asked_room

WEIGHTS = PROJECT_ROOT / "plugins" / "detectors" / "room_words.safetensors"
SMALL = ("dataset.width=320", "dataset.height=240", "fuser.voxel_size=0.03", "detector.min_pixels=100")


@pytest.fixture(scope="module")
def room() -> AskedRoom:
    return asked_room("words0", "detector=room_words", "detector@detector.of=ground_truth", *SMALL, stride=12)


def test_each_object_is_found_by_its_color_and_class(room: AskedRoom) -> None:
    model = open_image_text(str(WEIGHTS), "main", "cpu", half=False)
    answers = list(room.answers(lambda query: by_embedding(room.scene, model.embed_text(query))))
    assert len(answers) >= 4
    assert sum(meant == found for _, meant, found in answers) >= 0.8 * len(answers)


def test_the_words_of_other_objects_find_other_objects(room: AskedRoom) -> None:
    """Were all embeddings alike, one object would be the first answer to everything."""
    model = open_image_text(str(WEIGHTS), "main", "cpu", half=False)
    first = {query: by_embedding(room.scene, model.embed_text(query))[0].instance.id for query in room.queries()}
    assert len(set(first.values())) == len(first)


def test_objects_know_how_alike_their_pictures_were(room: AskedRoom) -> None:
    spreads = [instance.embedding_spread for instance in room.scene.instances().values() if instance.embedding_spread]
    assert spreads
    assert 0 < np.median(spreads) < 0.5
    assert room.scene.scene.embedding_space.startswith("room_words.safetensors@")


def test_the_command_finds_the_model_by_the_run(
    room: AskedRoom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    room.scene.save(tmp_path / "map.npz")
    (tmp_path / "config.yaml").write_text("detector: {model: plugins/detectors/room_words.safetensors}\n")
    query = next(iter(room.queries()))
    monkeypatch.setattr("sys.argv", ["instancemap query", str(tmp_path), query])
    main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("by embeddings of room_words.safetensors@")
    assert query.split()[1] in lines[2]
    assert len(lines) <= 2 + 5
    answer = query_run(tmp_path, query)
    assert (answer.by, answer.space) == ("embeddings", room.scene.scene.embedding_space)
    assert [str(one.instance.id) for one in answer.objects[:5]] == [line.split()[0] for line in lines[2:]]
    of_the_map = query_run(room.scene, query, model=WEIGHTS)
    assert [one.similarity for one in of_the_map.objects] == [one.similarity for one in answer.objects]
    monkeypatch.setattr("sys.argv", ["instancemap query", str(tmp_path), "a wooden chair"])
    with pytest.raises(SystemExit):
        main()
    assert "does not know 'wooden'" in capsys.readouterr().err


def test_it_is_small_and_says_what_it_is() -> None:
    model = open_image_text(str(WEIGHTS), "main", "cpu", half=False)
    assert WEIGHTS.stat().st_size < 2**20
    assert all(np.isfinite(model.embed_text(color)).all() for color in COLOR_NAMES)
