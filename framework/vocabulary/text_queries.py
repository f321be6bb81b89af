"""Parsing of text queries such as "the two red chairs" into classes and colors."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

from framework.vocabulary.color_names import COLOR_NAMES, OTHER_SPELLINGS
from framework.vocabulary.label_spaces import MEANINGS

STOP_WORDS = frozenset((
    "a", "an", "the", "that", "this", "these", "those", "some", "any", "all", "my", "our", "your", "of", "with", "and",
    "or", "one", "two", "three",
))  # fmt: skip
SHADES = frozenset(("light", "dark", "bright", "pale", "deep"))  # ignored, because they also depend on the lighting
IRREGULAR = {"people": "person", "men": "person", "women": "person", "mice": "mouse", "knives": "knife",
             "shelves": "shelf", "glasses": "glass"}  # fmt: skip
EVERYDAY = {"phone": "cell phone", "mug": "cup", "screen": "tv", "rucksack": "backpack", "settee": "couch",
            "telly": "tv"}  # fmt: skip
"""COCO names of everyday words that have none in MEANINGS."""

MAX_WORDS = 4  # maximum number of words in a name of a label space


@dataclass(frozen=True)
class ObjectWords:
    """The classes, colors and unknown words of a text query."""

    classes: tuple[str, ...]  # in the order of the query
    colors: tuple[str, ...]  # names in COLOR_NAMES, in the order of the query
    unknown: tuple[str, ...]  # other words


def object_words(query: str, classes: Collection[str]) -> ObjectWords:
    """Parse a text query.

    Case, articles, plurals and shades of colors are ignored. Names of other label spaces are mapped to COCO names (sofa
    = couch). An ambiguous word, such as orange, is a color if a class follows, otherwise a class.

    Args:
        query: The text query.
        classes: The known class names.
    """
    words = _words(query)
    known = {" ".join(_words(name)): name for name in classes}
    found, colors, unknown = list[str](), list[str](), list[str]()
    at = 0
    while at < len(words):
        length, name = _class_at(words, at, known)
        color = _color(words[at : at + 1])
        is_color = color in COLOR_NAMES and length < 2
        if is_color and (not name or any(_class_at(words, k, known)[1] for k in range(at + 1, len(words)))):
            colors.append(color)
            at += 1
        elif name:
            found.append(name)
            at += length
        else:
            shade = words[at] in SHADES and _color(words[at + 1 : at + 2]) in COLOR_NAMES
            if words[at] not in STOP_WORDS and not shade:
                unknown.append(words[at])
            at += 1
    return ObjectWords(tuple(dict.fromkeys(found)), tuple(dict.fromkeys(colors)), tuple(dict.fromkeys(unknown)))


def _words(text: str) -> list[str]:
    """Return the lower-case words of a text, without punctuation."""
    return re.findall(r"[^\W_]+(?:[-'][^\W_]+)*", text.lower())


def _color(word: list[str]) -> str:
    """Return the first word, with the spelling of COLOR_NAMES if it is a color."""
    return OTHER_SPELLINGS.get(word[0], word[0]) if word else ""


def _class_at(words: list[str], at: int, known: dict[str, str]) -> tuple[int, str]:
    """Find the longest class name that starts at a word of the query.

    Args:
        words: The words of the query.
        at: The index of the first word.
        known: The class names by their words, joined by spaces.

    Returns:
        The number of words and the class name, or 0 and "" if no class name matches.
    """
    longest = max([MAX_WORDS, *(name.count(" ") + 1 for name in known)])
    for length in range(min(longest, len(words) - at), 0, -1):
        phrase = words[at : at + length]
        for last in _singulars(phrase[-1]):
            text = " ".join([*phrase[:-1], last])
            for name in (text, MEANINGS.get(text), EVERYDAY.get(text)):
                if name in known:
                    return length, known[name]
    return 0, ""


def _singulars(word: str) -> list[str]:
    """Return the possible singulars of a word, including the word itself."""
    endings = (("ies", "y"), ("es", ""), ("s", ""))
    regular = [word.removesuffix(plural) + singular for plural, singular in endings if word.endswith(plural)]
    return [word, IRREGULAR.get(word, word), *regular]
