"""Classes of objects that can lie flat on a floor or hang flat on a wall."""

from __future__ import annotations

FLAT = frozenset((
    "art", "artwork", "bag", "banner", "blackboard", "blanket", "blind", "board", "book", "calendar", "carpet", "cloth",
    "clothes", "clock", "curtain", "display", "door", "doorframe", "folder", "frame", "handle", "keyboard", "knife",
    "laptop", "magazine", "map", "mat", "mirror", "monitor", "mouse", "newspaper", "outlet", "painting", "paper",
    "phone", "photo", "picture", "plate", "poster", "radiator", "remote", "rug", "scissors", "screen", "sign",
    "skateboard", "socket", "switch", "television", "tie", "towel", "tv", "whiteboard", "window",
))  # fmt: skip
"""Last words of class names in the singular."""


def is_flat(class_name: str) -> bool:
    """Return True if objects of a class can lie flat on a floor or a wall, by the last word of its name."""
    last = class_name.lower().replace("-", " ").replace("_", " ").rpartition(" ")[2]
    return last in FLAT or last.removesuffix("s") in FLAT
