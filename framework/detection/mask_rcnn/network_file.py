"""Network files in safetensors format.

The metadata contain:

    architecture     the Architecture as JSON
    card             the model card as JSON: data, steps, AP, limits, ...; `domain`: the image domain of the training
    tensors_sha256   hash of all names, types, shapes and values, to detect damage
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import save_file
from torch import Tensor

from framework.detection.mask_rcnn.network import Architecture, MaskRCNN
from framework.errors import DataError, in_one_line
from framework.files.atomic_write import atomic_write
from framework.files.json_file import parse_json

Fact = str | int | float | bool | None
COUNTERS = ".num_batches_tracked"  # suffix of the counters of batch normalization, used only in training


@dataclass(frozen=True)
class NetworkDescription:
    """Metadata of a network file."""

    architecture: Architecture
    card: Mapping[str, Fact]


def save_network(network: MaskRCNN, path: Path, card: Mapping[str, Fact], half: bool = False) -> None:
    """Write a network to a file.

    Args:
        network: The network.
        path: The output file.
        card: The model card.
        half: True = store weight matrices and kernels in half precision.

    Raises:
        DataError: A weight is not finite, or the file cannot be written.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in _stored(network).items()}
    if half:  # biases and statistics remain float32, because variances may exceed the range of float16
        tensors = {name: tensor.half() if tensor.ndim >= 2 else tensor for name, tensor in tensors.items()}
    _check_finite(tensors, str(path))
    metadata = {
        "architecture": json.dumps(dataclasses.asdict(network.architecture)),
        "card": json.dumps(dict(card)),
        "tensors_sha256": _digest(tensors),
    }
    with atomic_write(path) as temporary:
        try:
            save_file(tensors, temporary, metadata)
        except safetensors.SafetensorError as error:
            raise DataError(f"{path}: expected a writable file, got an error ({in_one_line(error)})") from error


def load_network(path: Path) -> MaskRCNN:
    """Load a network in float32 and inference mode.

    Raises:
        DataError: The file is not a valid network file.
    """
    with _opened(path) as file:
        description = _description(file.metadata(), path)
        names = file.keys()
        tensors = {name: file.get_tensor(name) for name in names}
        expected, found = file.metadata().get("tensors_sha256"), _digest(tensors)
        if expected != found:
            raise DataError(
                f"{path}: expected tensors with sha256 {expected}, got {found}; restore or download the file again"
            )
    return filled(description.architecture, tensors, str(path))


def describe_network(path: Path) -> NetworkDescription:
    """Read the metadata of a network file without loading the weights."""
    with _opened(path) as file:
        return _description(file.metadata(), path)


def filled(architecture: Architecture, tensors: Mapping[str, Tensor], where: str) -> MaskRCNN:
    """Build a network with the given weights, in float32 and inference mode.

    Args:
        architecture: The architecture.
        tensors: The weights by name.
        where: The source of the weights, for messages.

    Raises:
        DataError: The weights do not match the architecture.
    """
    try:
        with torch.device("meta"):  # saves memory and random initialization of weights that are replaced below
            network = MaskRCNN(architecture)
    except (KeyError, ValueError, RuntimeError) as error:
        raise DataError(f"{where}: expected a known architecture, got an error ({in_one_line(error)})") from error
    expected = _stored(network)
    given = {name: tensor for name, tensor in tensors.items() if not name.endswith(COUNTERS)}
    _check_names(expected.keys(), given.keys(), where)
    for name, tensor in given.items():
        if tensor.shape != expected[name].shape:
            wanted, found = (" x ".join(map(str, shape)) for shape in (expected[name].shape, tensor.shape))
            raise DataError(f"{where}: {name}: expected shape {wanted}, got {found}")
    _check_finite(given, where)
    counters = {name: torch.tensor(0) for name in network.state_dict() if name.endswith(COUNTERS)}
    network.load_state_dict({name: tensor.float() for name, tensor in given.items()} | counters, assign=True)
    return network.eval()


def required(tensors: Mapping[str, Tensor], name: str, where: str) -> Tensor:
    """Return the tensor with a given name.

    Raises:
        DataError: There is no such tensor. The message contains the source `where`.
    """
    if name not in tensors:
        raise DataError(f"{where}: expected the weights {name} of a Mask R-CNN with a feature pyramid, got none")
    return tensors[name]


def _stored(network: MaskRCNN) -> dict[str, Tensor]:
    return {name: tensor for name, tensor in network.state_dict().items() if not name.endswith(COUNTERS)}


def _check_names(expected: typing.AbstractSet[str], found: typing.AbstractSet[str], where: str) -> None:
    if missing := expected - found:
        raise DataError(f"{where}: expected the weights {_first_of(missing)}, got none")
    if unknown := found - expected:
        raise DataError(f"{where}: expected only the weights of this network, got {_first_of(unknown)}")


def _first_of(names: typing.AbstractSet[str]) -> str:
    """Format one of the names and the number of the others, for messages."""
    return f"{min(names)} and {len(names) - 1} more" if len(names) > 1 else min(names)


def _check_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    for name, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            raise DataError(f"{where}: {name}: expected finite weights, got NaN or infinity")


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 hash of the names, types, shapes and values."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _opened(path: Path) -> Any:
    if not path.is_file():
        raise DataError(f"{path}: expected a network file, got none")
    try:
        return safetensors.safe_open(path, framework="pt")
    except (safetensors.SafetensorError, OSError) as error:
        raise DataError(
            f"{path}: expected a safetensors file, got a damaged or unsupported file: {in_one_line(error)}"
        ) from error


def _description(metadata: Mapping[str, str] | None, path: Path) -> NetworkDescription:
    if not metadata or "architecture" not in metadata:
        raise DataError(f"{path}: expected an architecture in the metadata, got none; choose a network of InstanceMap")
    try:
        card = parse_json(path, metadata.get("card", "{}"))
        architecture = parse_json(path, metadata["architecture"])
        return NetworkDescription(_parsed(Architecture, architecture, "architecture"), card)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def _parsed(kind: Any, value: Any, name: str) -> Any:
    """Convert a JSON value to an annotated type."""
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise ValueError(f"{name}: expected a JSON object, got {value!r}")
        kinds = typing.get_type_hints(kind)
        if unknown := sorted(value.keys() - kinds.keys()):
            raise ValueError(f"{name}: expected known fields, got {unknown[0]!r}; update InstanceMap for newer files")
        fields = {field: _parsed(kinds[field], part, f"{name}.{field}") for field, part in value.items()}
        no_value = dataclasses.MISSING
        required = [f.name for f in dataclasses.fields(kind) if f.default is no_value is f.default_factory]
        if missing := [field for field in required if field not in fields]:
            raise ValueError(f"{name}: expected all required fields, got none for: {', '.join(missing)}")
        return typing.cast(Any, kind)(**fields)
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise ValueError(f"{name}: expected a list, got {value!r}")
        kinds_of_parts = typing.get_args(kind)
        if kinds_of_parts[-1] is Ellipsis:
            kinds_of_parts = kinds_of_parts[:1] * len(value)
        if len(kinds_of_parts) != len(value):
            raise ValueError(f"{name}: expected {len(kinds_of_parts)} values, got {len(value)}")
        return tuple(_parsed(part, v, name) for part, v in zip(kinds_of_parts, value, strict=True))
    accepted = (int, float) if kind is float else kind
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{name}: expected a value of type {kind.__name__}, got {value!r}")
    return kind(value)
