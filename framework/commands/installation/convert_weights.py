"""`python -m framework convert-weights IN OUT`: a Mask R-CNN of torchvision or detectron2 for `detector=mask_rcnn`.

IN is a published network's name or a file (.pth, .pkl); OUT a .safetensors file, whose metadata say what network it is,
so that it needs no more than `detector.weights=OUT`. No code that IN may contain is run.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.errors import ConfigError


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Converts a Mask R-CNN of torchvision or detectron2 for detector=mask_rcnn.",
    )
    parser.add_argument("source", metavar="IN", type=Path, help="a published network's name, or a .pth or .pkl file")
    parser.add_argument("target", metavar="OUT", type=Path, help="the .safetensors file to write")
    parser.add_argument("--kind", choices=["torchvision", "detectron2"], help="whose IN is; else its names tell")
    parser.add_argument("--classes", help="comma-separated, in the network's order, where they are not COCO's")
    parser.add_argument(
        "--norm-eps", type=float, default=0.0, help="torchvision only: 0 for its COCO checkpoint (default)"
    )
    parser.add_argument("--half", action="store_true", help="store float16: half the size")
    asked = arguments(parser)
    with one_line_errors():
        convert(asked.source, asked.target, asked.kind, asked.classes, asked.norm_eps, asked.half)


def convert(source: Path, target: Path, kind: str | None, classes: str | None, norm_eps: float, half: bool) -> None:
    """Does what the command says, and prints what it did."""
    if target.suffix != ".safetensors":
        raise ConfigError(f"{target}: the converted network is a .safetensors file; give it such a name")
    from framework.detection.mask_rcnn.checkpoint import CheckpointKind, read_network
    from framework.detection.mask_rcnn.network_file import save_network
    from framework.detection.mask_rcnn.published_weights import find_network
    from framework.files.hashing import path_hash

    path = find_network(source)
    names = tuple(name.strip() for name in classes.split(",")) if classes else None
    network = read_network(path, CheckpointKind(kind) if kind else None, names, norm_eps)
    save_network(network, target, {"converted_from": path.name, "converted_from_sha256": path_hash(path)}, half)
    architecture = network.architecture
    print(
        f"{target}: {architecture.backbone.name}, {len(architecture.classes)} classes,"
        f" {target.stat().st_size / 1e6:.1f} MB; use it with detector=mask_rcnn detector.weights={target}"
    )
