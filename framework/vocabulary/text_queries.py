"""What people call an object, "the two red chairs", taken apart into the classes and colours that it names."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

from framework.vocabulary.color_names import COLOR_NAMES, OTHER_SPELLINGS
from framework.vocabulary.label_spaces import MEANINGS

SAY_NOTHING = frozenset(
    (
        "a",
        "an",
        "the",
        "that",
        "this",
        "these",
        "those",
        "some",
        "any",
        "all",
        "my",
        "our",
        "your",
        "of",
        "with",
        "and",
        "or",
        "one",
        "two",
        "three",
    )
)
SHADES = frozenset(("light", "dark", "bright", "pale", "deep"))  # of a colour, which light makes as well
IRREGULAR = {"people": "person", "men": "person", "women": "person", "mice": "mouse", "knives": "knife",
             "shelves": "shelf", "scissors": "scissors", "skis": "skis", "glasses": "glass"}  # fmt: skip
EVERYDAY = {
    "fridge": "refrigerator",
    "plant": "potted plant",
    "phone": "cell phone",
    "mug": "cup",
    "screen": "tv",
    "rucksack": "backpack",
    "settee": "couch",
    "armchair": "couch",
    "stool": "chair",
    "telly": "tv",
}  # by the words of everyday that no label space has
LONGEST = 4  # words of a class's name


@dataclass(frozen=True)
class ObjectWords:
    """What a query says."""

    classes: tuple[str, ...]  # names among those that were offered, in the order of the query
    colors: tuple[str, ...]  # of COLOR_NAMES
    unknown: tuple[str, ...]  # words that are neither


def object_words(query: str, classes: Collection[str]) -> ObjectWords:
    """Takes a query apart; `classes` are the names that a class may have.

    Case, articles, plurals and shades of colours do not matter, and words of other label spaces count as what they mean
    (sofa = couch). A word that is a colour and a class, orange, is a colour where another class follows.
    """
    words = re.findall(r"[^\W_]+(?:[-'][^\W_]+)*", query.lower())
    known = {name.lower(): name for name in classes}
    found: list[str] = []
    colors: list[str] = []
    unknown: list[str] = []
    at = 0
    while at < len(words):
        length, name = _class_at(words, at, known)
        color = _color(words[at : at + 1])
        is_color = color in COLOR_NAMES and (length < 2)
        if is_color and (not name or any(_class_at(words, k, known)[1] for k in range(at + 1, len(words)))):
            colors.append(color)
            at += 1
        elif name:
            found.append(name)
            at += length
        else:
            shade = words[at] in SHADES and _color(words[at + 1 : at + 2]) in COLOR_NAMES
            if words[at] not in SAY_NOTHING and not shade:
                unknown.append(words[at])
            at += 1
    return ObjectWords(tuple(dict.fromkeys(found)), tuple(dict.fromkeys(colors)), tuple(dict.fromkeys(unknown)))


def _color(word: list[str]) -> str:
    """A word as COLOR_NAMES has it where it is a colour; "" for no word."""
    return OTHER_SPELLINGS.get(word[0], word[0]) if word else ""


def _class_at(words: list[str], at: int, known: dict[str, str]) -> tuple[int, str]:
    """How many words from `at` on are a class's name, as many as may be, and that name; 0 and "" where none are."""
    for length in range(min(LONGEST, len(words) - at), 0, -1):
        phrase = words[at : at + length]
        for last in _singulars(phrase[-1]):
            said = " ".join([*phrase[:-1], last])
            for meant in (said, MEANINGS.get(said), EVERYDAY.get(said)):
                if meant in known:
                    return length, known[meant]
    return 0, ""


def _singulars(word: str) -> list[str]:
    """What a word may be the plural of, itself first."""
    found = [word, IRREGULAR.get(word, word)]
    if word.endswith("ies"):
        found.append(word[:-3] + "y")
    if word.endswith("es"):
        found.append(word[:-2])
    if word.endswith("s"):
        found.append(word[:-1])
    return found
