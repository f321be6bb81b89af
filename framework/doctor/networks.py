"""The networks that the detectors' options name: which come with the project, and which are downloaded when first used.

Whatever an option of conf/detector gives as a path of the project, a published network or a model id is listed: a new
option needs no line here.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from framework.doctor.check_result import Finding, State, anonymous
from framework.files.search_paths import CONF, PROJECT_ROOT

SHIPPED = "plugins/"  # how the paths of what comes with the project begin
MODEL_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")  # on huggingface.co
MEGABYTES = {
    "Roboflow/rf-detr-seg-nano": 134,
    "facebook/mask2former-swin-tiny-coco-instance": 190,
    "facebook/sam2.1-hiera-tiny": 156,
    "google/owlv2-base-patch16-ensemble": 620,
    "google/siglip2-base-patch16-224": 1500,
}
"""What is downloaded of a model id: its weights, as huggingface.co lists them."""


def shipped() -> Iterator[Finding]:
    """Those that come with the project."""
    default = _default()
    for name, value in _named():
        if not value.startswith(SHIPPED):
            continue
        path = PROJECT_ROOT / value
        if size := _size(path):
            yield Finding(name, State.THERE, f"comes with the project, {size / 1e6:.1f} MB")
        else:
            state = State.BROKEN if name == default else State.OPTIONAL
            remedy = "pip install --force-reinstall --no-deps instancemap"
            yield Finding(name, state, f"{anonymous(str(path))} is missing", remedy)


def downloaded() -> Iterator[Finding]:
    """Those that download themselves, once."""
    from framework.detection.mask_rcnn.published_weights import OFFLINE, PUBLISHED

    off = f", but {OFFLINE} is set" if os.environ.get(OFFLINE) else ""
    for name, network in PUBLISHED.items():
        command = f"instancemap detector=mask_rcnn detector.weights={name}"
        if size := _size(network.file):
            yield Finding(name, State.THERE, f"{size / 1e6:.0f} MB in {anonymous(str(network.file.parent))}")
        else:
            size_of_it = f", {network.megabytes} MB" if network.megabytes else ""
            yield Finding(name, State.OPTIONAL, f"not downloaded{size_of_it}, {network.licence}{off}", command)


def from_hugging_face() -> Iterator[Finding]:
    """Those that huggingface.co's own client keeps."""
    from framework.detection.hub.hub_model import forbidden_by

    folder = _hub_cache()
    variable = forbidden_by()
    off = f", but {variable} is set" if variable else ""
    for name, model in _named():
        if model.startswith(SHIPPED) or not MODEL_ID.fullmatch(model):
            continue
        kept = folder / f"models--{model.replace('/', '--')}"
        if size := max(map(_whole_size, kept.glob("snapshots/*/")), default=0):
            yield Finding(name, State.THERE, f"{model}, {size / 1e6:.0f} MB in {anonymous(str(folder))}")
        else:
            size_of_it = f", {MEGABYTES[model]} MB" if model in MEGABYTES else ""
            yield Finding(
                name,
                State.OPTIONAL,
                f"{model} is {'only in part' if kept.exists() else 'not'} downloaded{size_of_it}{off}",
                f"instancemap detector={name.partition('.')[0]}",
            )


def _named() -> Iterator[tuple[str, str]]:
    """The paths and model ids of every option, under its name; with the parameter's behind it where it has several."""
    for path in sorted((CONF / "detector").glob("*.yaml")):
        texts = {key: value for key, value in _content(path).items() if isinstance(value, str)}
        places = {key: value for key, value in texts.items() if MODEL_ID.match(value)}
        for key, value in places.items():
            yield path.stem if len(places) == 1 else f"{path.stem}.{key}", value


def _default() -> str:
    """The detector of a run that names none."""
    choices = _content(CONF / "config.yaml")["defaults"]
    assert isinstance(choices, list)
    return next(str(choice["detector"]) for choice in choices if isinstance(choice, dict) and "detector" in choice)


def _content(path: Path) -> Mapping[str, object]:
    import yaml

    found: Mapping[str, object] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return found


def _hub_cache() -> Path:
    """Where huggingface_hub keeps models, by the environment variables that it reads."""
    if given := os.environ.get("HF_HUB_CACHE") or os.environ.get("HUGGINGFACE_HUB_CACHE"):
        return Path(given)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("HF_HOME") or cache / "huggingface") / "hub"


def _whole_size(snapshot: Path) -> int:
    """Bytes of a model that was downloaded to its end; 0 where its config or weights are not there."""
    names = {file.name for file in snapshot.iterdir() if file.exists()}
    whole = "config.json" in names and any(name.endswith((".safetensors", ".bin")) for name in names)
    return _size(snapshot) if whole else 0


def _size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder; 0 = there is none."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
