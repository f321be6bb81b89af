"""Weights that the detectors' options name: included in the project, or downloaded on first use."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from framework.doctor.check_result import Check, Status, anonymous
from framework.files.search_paths import CONF, PROJECT_ROOT

INCLUDED = "plugins/"  # prefix of the paths of included weights
MODEL_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")  # on huggingface.co


def included() -> Iterator[Check]:
    choices = _content(CONF / "config.yaml")["defaults"]
    assert isinstance(choices, list)
    default = next(choice["detector"] for choice in choices if isinstance(choice, dict) and "detector" in choice)
    for name, value in _named():
        path = PROJECT_ROOT / value
        if not value.startswith(INCLUDED):
            continue
        if size := _size(path):
            yield Check(name, Status.OK, f"included, {size / 1e6:.1f} MB")
        else:
            status = Status.ERROR if name == default else Status.MISSING
            fix = "pip install --force-reinstall --no-deps instancemap"
            yield Check(name, status, f"{anonymous(str(path))} is missing", fix)


def published() -> Iterator[Check]:
    from framework.detection.mask_rcnn.published_weights import OFFLINE, PUBLISHED

    for name, network in PUBLISHED.items():
        if size := _size(network.file):
            yield Check(name, Status.OK, f"{size / 1e6:.0f} MB in {anonymous(str(network.file.parent))}")
        else:
            size_text = f", {network.megabytes} MB" if network.megabytes else ""
            offline = f", but {OFFLINE} is set" if os.environ.get(OFFLINE) else ""
            fix = f"instancemap detector=mask_rcnn detector.weights={name}"
            yield Check(name, Status.MISSING, f"not downloaded{size_text}, {network.licence}{offline}", fix)


def hugging_face() -> Iterator[Check]:
    """Check the cache of huggingface_hub for the model ids that options name."""
    from framework.detection.hub.hub_model import forbidden_by

    variable = forbidden_by()
    offline = f", but {variable} is set" if variable else ""
    for name, model in _named():
        if model.startswith(INCLUDED) or not MODEL_ID.fullmatch(model):
            continue
        folder = _hub_cache() / f"models--{model.replace('/', '--')}"
        if size := max(map(_complete_size, folder.glob("snapshots/*/")), default=0):
            yield Check(name, Status.OK, f"{model}, {size / 1e6:.0f} MB in {anonymous(str(folder.parent))}")
        else:
            state = "partly" if folder.exists() else "not"
            fix = f"instancemap detector={name.partition('.')[0]}"
            yield Check(name, Status.MISSING, f"{model} is {state} downloaded{offline}", fix)


def _named() -> Iterator[tuple[str, str]]:
    """Yield the weight paths and model ids of every option, by option, or by option.parameter if it has several."""
    for path in sorted((CONF / "detector").glob("*.yaml")):
        values = {key: str(value) for key, value in _content(path).items() if MODEL_ID.match(str(value))}
        values = {key: value for key, value in values.items() if isinstance(_content(path)[key], str)}
        for key, value in values.items():
            yield path.stem if len(values) == 1 else f"{path.stem}.{key}", value


def _content(path: Path) -> Mapping[str, object]:
    import yaml

    found: Mapping[str, object] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return found


def _hub_cache() -> Path:
    """Return the model folder of huggingface_hub, which reads these environment variables."""
    if given := os.environ.get("HF_HUB_CACHE") or os.environ.get("HUGGINGFACE_HUB_CACHE"):
        return Path(given)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("HF_HOME") or cache / "huggingface") / "hub"


def _complete_size(snapshot: Path) -> int:
    """Return the bytes of a complete download, 0 if its config or weights are missing."""
    names = {file.name for file in snapshot.iterdir() if file.exists()}
    complete = "config.json" in names and any(name.endswith((".safetensors", ".bin")) for name in names)
    return _size(snapshot) if complete else 0


def _size(path: Path) -> int:
    """Return the bytes of a file or of a folder's files, 0 if it is missing."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
