"""Whether rooms that the network of words has never seen are found in words: "<colour> <class>" asked of three maps.

python -m pytest tests/benchmarks -k words -s
"""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.detection.embeddings.image_text import ImageTextModel, open_image_text
from framework.queries.text_search import by_embedding, by_names
from tests.support.word_rooms import Ask, AskedRoom, asked_room

ROOMS = ("words0", "words1", "words2")
WEIGHTS = Path(__file__).resolve().parents[2] / "plugins" / "detectors" / "room_words.safetensors"
RECALL = 0.8  # share of the queries whose object is the first answer


def asks(room: AskedRoom, model: ImageTextModel) -> dict[str, Ask]:
    """Both ways to ask."""
    return {
        "embeddings": lambda query: by_embedding(room.scene, model.embed_text(query)),
        "names": lambda query: by_names(room.scene, query),
    }


@pytest.mark.parametrize("inner", ["ground_truth", "mask_rcnn_rooms"])
def test_the_object_meant_is_the_first_answer(inner: str, capsys: pytest.CaptureFixture[str]) -> None:
    model = open_image_text(str(WEIGHTS), "main", "cpu", half=False)
    right = {"embeddings": 0, "names": 0}
    queries = 0
    for scene in ROOMS:
        room = asked_room(scene, "detector=room_words", f"detector@detector.of={inner}")
        queries += len(room.queries())
        for way, ask in asks(room, model).items():
            answers = list(room.answers(ask))
            first = sum(meant == found for _, meant, found in answers)
            right[way] += first
            wrong = [f"{query}: {room.name(found)}" for query, meant, found in answers if meant != found]
            with capsys.disabled():
                print(f"\n{inner}, {scene}, by {way}: {first} of {len(answers)} first {wrong or ''}", end="")
    assert queries >= 10
    assert right["embeddings"] >= RECALL * queries
