"""Search paths of files, and the config folder."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from framework.errors import DataError

_PACKAGE = Path(__file__).resolve().parents[1]
PROJECT_ROOT = _PACKAGE.parent  # parent of conf/ in a checkout
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else PROJECT_ROOT / "conf"
"""Config folder: inside the package if installed from a wheel, next to the package in a checkout."""


def usable_path(name: str, value: object) -> Path:
    """Return an argument as a path that the operating system accepts. The file need not exist.

    Raises:
        DataError: The value is not a nonempty path, contains NUL or has a too long name. The message begins with
            `name`.
    """
    if not isinstance(value, str | Path) or value == "":
        raise DataError(f"{name}: expected a path, got {value!r:.60}")
    try:
        os.lstat(value)
    except ValueError as error:  # NUL, or characters that the encoding of file names lacks
        raise DataError(f"{name}: expected a path, got {str(value)!r:.60} ({error})") from error
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise DataError(
                f"{name}: expected a path with shorter names, got {len(str(value))} characters ({error.strerror})"
            ) from error
    return Path(value)


def candidates(path: Path) -> tuple[Path, ...]:
    """Return the paths at which a file is searched.

    A relative path is searched in the working directory, then in the project directory. `~` is expanded.
    """
    path = expanded(path)
    if path.is_absolute():
        return (path,)
    # in a wheel, data/desk is framework/desk
    packaged = [_PACKAGE.joinpath(*path.parts[1:])] if path.parts[:1] == ("data",) else []
    return tuple(dict.fromkeys((Path.cwd() / path, PROJECT_ROOT / path, *packaged)))


def folder_of(path: Path) -> Path:
    """Return the first existing folder among the search paths.

    Args:
        path: The path of a folder, absolute or relative. `~` is expanded.

    Returns:
        The folder, or the expanded path if there is no such folder.
    """
    return next((place for place in candidates(path) if place.is_dir()), expanded(path))


def expanded(path: Path) -> Path:
    """Expand `~` in a path.

    For an unknown user, the path is unchanged.
    """
    try:
        return path.expanduser()
    except RuntimeError:
        return path
