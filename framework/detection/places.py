"""Where a file that a parameter names is looked for."""

from __future__ import annotations

from pathlib import Path

PROJECT_ROOT = Path(__file__).resolve().parents[2]  # holds conf/


def places(path: Path) -> tuple[Path, ...]:
    """The path; of a relative one, where it would be in the working, then in the project folder."""
    return (path,) if path.is_absolute() else tuple(dict.fromkeys((Path.cwd() / path, PROJECT_ROOT / path)))
