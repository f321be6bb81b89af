"""Search paths of files in parameters, and the config folder."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
PROJECT_ROOT = _PACKAGE.parent  # in a checkout, the parent of conf/
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else PROJECT_ROOT / "conf"
"""The config folder: in the package if installed from a wheel, next to it in a checkout."""


def candidates(path: Path) -> tuple[Path, ...]:
    """Return the path with `~` expanded; a relative one in the working folder, then in the project folder."""
    path = expanded(path)
    if path.is_absolute():
        return (path,)
    packaged = [_PACKAGE.joinpath(*path.parts[1:])] if path.parts[:1] == ("data",) else []  # a wheel's framework/desk
    return tuple(dict.fromkeys((Path.cwd() / path, PROJECT_ROOT / path, *packaged)))


def folder_of(path: Path) -> Path:
    """Return the first candidate that is a folder, else the path itself."""
    return next((place for place in candidates(path) if place.is_dir()), expanded(path))


def expanded(path: Path) -> Path:
    """Return the path with `~` expanded; unchanged for an unknown user."""
    try:
        return path.expanduser()
    except RuntimeError:
        return path
