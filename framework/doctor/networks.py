"""Checks of detector weights, which are included in the project or downloaded on first use."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from framework.doctor.check_result import Check, anonymous
from framework.files.search_paths import CONF, PROJECT_ROOT

INCLUDED = "plugins/"  # prefix of the paths of weights that the project includes
MODEL_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")  # id of a model on huggingface.co


def included_and_hub() -> Iterator[Check]:
    """Check the weights included in the project, and the weights downloaded from huggingface.co."""
    from framework.detection.hub.hub_model import forbidden_by

    choices = _content(CONF / "config.yaml")["defaults"]
    default = next(choice["detector"] for choice in choices if isinstance(choice, dict) and "detector" in choice)
    offline = f", but {forbidden_by()} is set" if forbidden_by() else ""
    for name, value in _named():
        if value.startswith(INCLUDED):
            size = _size(PROJECT_ROOT / value)
            detail = f"included, {size / 1e6:.1f} MB" if size else f"{anonymous(PROJECT_ROOT / value)} is missing"
            fix = "pip install --force-reinstall --no-deps instancemap (in a checkout: git checkout -- plugins)"
            yield Check.of(name, size > 0, detail, fix, required=name == default)
        elif MODEL_ID.fullmatch(value):
            folder = _hub_cache() / f"models--{value.replace('/', '--')}"
            size = max(map(_complete_size, folder.glob("snapshots/*/")), default=0)
            detail = f"{value} is {'partly' if folder.exists() else 'not'} downloaded{offline}"
            if size:
                detail = f"{value}, {size / 1e6:.0f} MB in {anonymous(folder.parent)}"
            yield Check.of(name, size > 0, detail, f"instancemap detector={name.partition('.')[0]}")


def published() -> Iterator[Check]:
    """Check the downloaded weights of detector=mask_rcnn."""
    from framework.detection.mask_rcnn.published_weights import OFFLINE, PUBLISHED

    offline = f", but {OFFLINE} is set" if os.environ.get(OFFLINE) else ""
    for name, network in PUBLISHED.items():
        size = _size(network.file)
        expected = f", {network.megabytes} MB" if network.megabytes else ""
        detail = f"not downloaded{expected}, {network.license}{offline}"
        if size:
            detail = f"{size / 1e6:.0f} MB in {anonymous(network.file.parent)}"
        yield Check.of(name, size > 0, detail, f"instancemap detector=mask_rcnn detector.weights={name}")


def _named() -> Iterator[tuple[str, str]]:
    """Yield the name and the path or model id of the weights of each detector option."""
    for path in sorted((CONF / "detector").glob("*.yaml")):
        content = _content(path).items()
        values = {key: value for key, value in content if isinstance(value, str) and MODEL_ID.match(value)}
        for key, value in values.items():  # OPTION, or OPTION.PARAMETER if the option has several weights
            yield path.stem if len(values) == 1 else f"{path.stem}.{key}", value


def _content(path: Path) -> dict[str, Any]:
    return dict(yaml.safe_load(path.read_text(encoding="utf-8")))


def _hub_cache() -> Path:
    """Return the model folder of huggingface_hub."""
    if given := os.environ.get("HF_HUB_CACHE") or os.environ.get("HUGGINGFACE_HUB_CACHE"):
        return Path(given)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("HF_HOME") or cache / "huggingface") / "hub"


def _complete_size(snapshot: Path) -> int:
    """Return the size of a complete download in bytes, or 0 if its config or weights are missing."""
    names = {file.name for file in snapshot.iterdir() if file.exists()}
    complete = "config.json" in names and any(name.endswith((".safetensors", ".bin")) for name in names)
    return _size(snapshot) if complete else 0


def _size(path: Path) -> int:
    """Return the size of a file or folder in bytes, or 0 if it is missing."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
