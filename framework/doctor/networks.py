"""The networks: which come with the project, and which are downloaded when they are first used."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from framework.doctor.finding import Finding, State, anonymous
from framework.files.search_paths import CONF, PROJECT_ROOT

SHIPPED = {"maskrcnn2go": "weights", "mask_rcnn_rooms": "weights"}  # option, and its parameter that names the place
HUGGING_FACE = {"rf_detr_seg": 134}  # option, and the MB that are downloaded


def shipped() -> Iterator[Finding]:
    """Those that come with the project."""
    for option, key in SHIPPED.items():
        path = PROJECT_ROOT / str(_option(option)[key])
        size = _size(path)
        if size:
            yield Finding(option, State.THERE, f"comes with the project, {size / 1e6:.1f} MB")
        else:
            remedy = "pip install --force-reinstall --no-deps instancemap"
            yield Finding(option, State.BROKEN, f"{anonymous(str(path))} is missing", remedy)


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
    home = Path(os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface")
    folder = Path(os.environ.get("HF_HUB_CACHE") or home / "hub")
    off = ", but HF_HUB_OFFLINE is set" if os.environ.get("HF_HUB_OFFLINE") else ""
    for option, megabytes in HUGGING_FACE.items():
        model = str(_option(option)["model"])
        size = _size(folder / f"models--{model.replace('/', '--')}" / "blobs")
        if size:
            yield Finding(option, State.THERE, f"{model}, {size / 1e6:.0f} MB in {anonymous(str(folder))}")
        else:
            yield Finding(
                option,
                State.OPTIONAL,
                f"{model} is not downloaded, {megabytes} MB{off}",
                f"instancemap detector={option}",
            )


def _option(name: str) -> dict[str, object]:
    import yaml

    found: dict[str, object] = yaml.safe_load((CONF / "detector" / f"{name}.yaml").read_text(encoding="utf-8"))
    return found


def _size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder; 0 = there is none."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
