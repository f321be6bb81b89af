"""Tests for parsed text queries and for color names."""

from __future__ import annotations

import numpy as np
import pytest

from framework.vocabulary.color_names import COLOR_NAMES, fits, nearest_names
from framework.vocabulary.label_spaces import COCO
from framework.vocabulary.text_queries import ObjectWords, object_words


@pytest.mark.parametrize(
    ("query", "classes", "colors", "unknown"),
    [
        ("a red chair", ("chair",), ("red",), ()),
        ("The two RED Chairs!", ("chair",), ("red",), ()),
        ("sofa", ("couch",), (), ()),
        ("gray dining tables", ("dining table",), ("gray",), ()),
        ("knives, mice and people", ("knife", "mouse", "person"), (), ()),
        ("an orange orange", ("orange",), ("orange",), ()),
        ("orange", ("orange",), (), ()),
        ("an orange chair", ("chair",), ("orange",), ()),
        ("teddy bears", ("teddy bear",), (), ()),
        ("the fridge", ("refrigerator",), (), ()),
        ("plants and a stool", ("potted plant", "chair"), (), ()),
        ("light blue couch", ("couch",), ("blue",), ()),
        ("dark gray, pale chairs", ("chair",), ("gray",), ("pale",)),
        ("a red light", (), ("red",), ("light",)),
        ("traffic light", ("traffic light",), (), ()),
        ("a blob", (), (), ("blob",)),
        ("purple", (), ("purple",), ()),
        ("", (), (), ()),
        ("buses", ("bus",), (), ()),
        ("wine glasses", ("wine glass",), (), ()),
    ],
)
def test_object_words_splits_classes_colors_and_unknown_words(
    query: str, classes: tuple[str, ...], colors: tuple[str, ...], unknown: tuple[str, ...]
) -> None:
    assert object_words(query, COCO) == ObjectWords(classes, colors, unknown)


def test_object_words_finds_only_given_classes_in_any_case() -> None:
    assert object_words("a Red Mug", ("Red mug", "Mug")).classes == ("Red mug",)
    assert object_words("a chair", ("couch",)) == ObjectWords((), (), ("chair",))


@pytest.mark.parametrize(
    "query", ["the euro_pallet", "red Euro Pallets", "euro-pallet, used", "fork/lift (a b c d e)", "größe <5.5>"]
)
def test_object_words_find_own_names_with_punctuation(query: str) -> None:
    classes = ("euro_pallet", "Euro-Pallet, used", "fork/lift (a b c d e)", "Größe <5.5>")
    found = object_words(query, classes)
    assert (len(found.classes), found.unknown) == (1, ())


@pytest.mark.parametrize("name", COLOR_NAMES)
def test_typical_color_has_its_name_and_best_fit(name: str) -> None:
    plain = {"black": (0, 0, 0), "gray": (128, 128, 128), "white": (255, 255, 255), "red": (220, 20, 30),
             "orange": (250, 130, 20), "yellow": (250, 220, 40), "green": (30, 150, 50), "blue": (30, 60, 220),
             "purple": (120, 30, 160), "pink": (250, 140, 190), "brown": (100, 60, 30),
             "beige": (220, 200, 165)}[name]  # fmt: skip
    color = np.float32([plain]) / 255
    assert COLOR_NAMES[nearest_names(color)[0]] == name
    assert fits(color, name)[0] == 1
    assert max(fits(color, other)[0] for other in COLOR_NAMES if other != name) < 1
