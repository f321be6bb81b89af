"""Classes of objects that can be in the plane of a floor or a wall: flat objects, and furniture as high as a wall."""

from __future__ import annotations

FLAT = frozenset((
    "art", "artwork", "bag", "banner", "blackboard", "blanket", "blind", "board", "book", "bookcase", "bookshelf",
    "cabinet", "calendar", "carpet", "clock", "closet", "cloth", "clothes", "cupboard", "curtain", "display",
    "door", "doorframe", "folder", "frame", "freezer", "fridge", "handle", "keyboard", "knife", "laptop", "locker",
    "magazine", "map", "mat", "mirror", "monitor", "mouse", "newspaper", "outlet", "painting", "paper", "phone",
    "photo", "picture", "plate", "poster", "radiator", "refridgerator", "refrigerator", "remote", "rug", "scissors",
    "screen", "shelf", "sign", "skateboard", "socket", "switch", "television", "tie", "towel", "tv", "wardrobe",
    "whiteboard", "window",
))  # fmt: skip
"""Last words of class names in the singular, including the spelling of ScanNet's label space."""


def is_flat(class_name: str) -> bool:
    """Return True if an object of a class can be in the plane of a floor or a wall, by the last word of its name."""
    last = class_name.lower().replace("-", " ").replace("_", " ").rpartition(" ")[2]
    return last in FLAT or last.removesuffix("s") in FLAT
