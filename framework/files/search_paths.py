"""Where a file that a parameter names is looked for, and where the configs are."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
PROJECT_ROOT = _PACKAGE.parent  # in a checkout, what holds conf/
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else PROJECT_ROOT / "conf"
"""The configs: inside the package where it was installed from a wheel, beside it in a checkout."""


def candidates(path: Path) -> tuple[Path, ...]:
    """The path, `~` resolved; of a relative one, where it would be in the working, then in the project folder."""
    path = expanded(path)
    if path.is_absolute():
        return (path,)
    packaged = [_PACKAGE.joinpath(*path.parts[1:])] if path.parts[:1] == ("data",) else []  # a wheel's framework/desk
    return tuple(dict.fromkeys((Path.cwd() / path, PROJECT_ROOT / path, *packaged)))


def folder_of(path: Path) -> Path:
    """The first of these places that is a folder; the path itself where none is."""
    return next((place for place in candidates(path) if place.is_dir()), expanded(path))


def expanded(path: Path) -> Path:
    """The path with its `~` resolved; as it is where nobody has that name."""
    try:
        return path.expanduser()
    except RuntimeError:
        return path
