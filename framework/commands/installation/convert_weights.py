"""`instancemap convert-weights IN OUT`: convert torchvision or detectron2 weights for `detector=mask_rcnn`.

OUT contains a description of the network, so `detector.weights=OUT` needs no other parameter. Code in IN is never
executed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.config.text_values import typed
from framework.errors import ConfigError


def main() -> None:
    """Run the command `instancemap convert-weights`."""
    parser = argparse.ArgumentParser(
        description="Convert Mask R-CNN weights of torchvision or detectron2 for detector=mask_rcnn."
    )
    parser.add_argument("source", metavar="IN", type=Path, help=".pth or .pkl file, or name of a published network")
    parser.add_argument("target", metavar="OUT", type=Path, help="output .safetensors file")
    parser.add_argument("--kind", choices=["torchvision", "detectron2"], help="format of IN; default: detected")
    classes = "comma-separated class names in network order; default: COCO classes"
    parser.add_argument("--classes", metavar="NAMES", help=classes)
    epsilon = "epsilon of batch normalization, torchvision only; default: 0, as in torchvision's COCO checkpoint"
    parser.add_argument("--norm-eps", metavar="EPS", type=float, default=0.0, help=epsilon)
    parser.add_argument("--half", action="store_true", help="store weights as float16, which halves the file size")
    parsed = arguments(parser)
    with one_line_errors():
        convert(parsed.source, parsed.target, parsed.kind, parsed.classes, parsed.norm_eps, parsed.half)


def convert(source: Path, target: Path, kind: str | None, classes: str | None, norm_eps: float, half: bool) -> None:
    """Convert a checkpoint to a safetensors file, and print a summary.

    Args:
        source: A .pth or .pkl file, or the name of a published network.
        target: Output file with the suffix .safetensors.
        kind: Format of the checkpoint, torchvision or detectron2; None = detected.
        classes: Comma-separated class names in network order; None = COCO classes.
        norm_eps: Epsilon of batch normalization, for torchvision only.
        half: Store the weights as float16.

    Raises:
        ConfigError: `target` has another suffix.
        DataError: The checkpoint is invalid.
    """
    if target.suffix != ".safetensors":
        raise ConfigError(f"OUT: expected a file name with the suffix .safetensors, got {target.name}")
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
        f" {target.stat().st_size / 1e6:.1f} MB; use the file with detector=mask_rcnn "
        f"{typed('detector.weights', target)}"
    )
