"""Models of huggingface.co: downloaded once, into the cache that all its programs share, and checked."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from framework.detection.mask_rcnn.published_weights import OFFLINE
from framework.detection.runtimes.onnx_network import one_line
from framework.errors import ConfigError, DataError, in_one_line
from framework.files.atomic_write import check_regular
from framework.files.hashing import path_hash
from framework.files.json_file import read_json
from framework.files.search_paths import expanded

HUB_OFFLINE = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")
"""Environment variables: set to 1, nothing is downloaded from huggingface.co."""

CONFIG, PREPROCESSING = "config.json", "preprocessor_config.json"
WHOLE, INDEX, PICKLED = "model.safetensors", "model.safetensors.index.json", "pytorch_model.bin"
TOKENIZER = ("tokenizer.json", "tokenizer_config.json")
OLDER_TOKENIZER = ("vocab.json", "merges.txt", "tokenizer_config.json")  # OWLv2's, as published

log = logging.getLogger(__name__)


def find_model(model: str, revision: str, more: Sequence[str] = ()) -> Path:
    """The folder of a model: `model` itself, or that of a model id in the cache, downloaded if need be.

    `more` are files that it needs beside its config, preprocessing and weights: those of its tokenizer.
    A model id that is in the cache is not asked for again. Needs huggingface_hub, which transformers brings. Raises
    DataError, with what to do, when there is no such model, it cannot be downloaded, or is not what was published.
    """
    folder = expanded(Path(model))
    if folder.is_dir():
        for file in filter(Path.exists, (folder / name for name in (CONFIG, PREPROCESSING, WHOLE, INDEX, PICKLED))):
            check_regular(file)  # transformers would wait for what a pipe says
        return folder
    cached = _cached(model, revision, more)
    if cached is None:
        _download(model, revision, more)
        cached = _cached(model, revision, more)
    if cached is None:
        raise DataError(f"detector.model: {model} was downloaded, and is not whole in the cache: try again")
    return cached


def _cached(model: str, revision: str, more: Sequence[str]) -> Path | None:
    """The folder of a model id in the cache, if what is needed of it is there."""
    from huggingface_hub import try_to_load_from_cache
    from huggingface_hub.errors import HFValidationError

    try:
        config = try_to_load_from_cache(model, CONFIG, revision=revision)
    except HFValidationError as error:
        raise DataError(f"detector.model: {model} is neither a folder nor a model id: {one_line(error)}") from error
    if not isinstance(config, str):
        return None
    folder = Path(config).parent
    names = {file.name for file in folder.iterdir() if file.exists()}
    weights = _weights(names)
    if INDEX in weights:
        weights = _listed(folder / INDEX)
    return folder if weights and {PREPROCESSING, *_published(more, names), *weights} <= names else None


def _listed(index: Path) -> list[str]:
    """The files that a model's weights are divided among."""
    try:
        return [*read_json(index)["weight_map"].values()]
    except (DataError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"detector.model: {index} is damaged: delete {index.parents[2]}, and run again") from error


def _weights(names: Collection[str]) -> list[str]:
    """The files with weights among a model's files, as transformers chooses them; none where there are none."""
    if WHOLE in names:
        return [WHOLE]
    if INDEX in names:
        return [INDEX, *sorted(n for n in names if n.startswith("model-") and n.endswith(".safetensors"))]
    return [PICKLED] if PICKLED in names else []


def _published(more: Sequence[str], names: Collection[str]) -> Sequence[str]:
    """`more`, with a tokenizer of the older form where a model's files are those."""
    older = more == TOKENIZER and TOKENIZER[0] not in names and {*OLDER_TOKENIZER} <= {*names}
    return OLDER_TOKENIZER if older else more


def _download(model: str, revision: str, more: Sequence[str]) -> None:
    """Fetches what is needed, with progress bars of huggingface_hub, each file whole or not at all."""
    if variable := forbidden_by():
        raise DataError(
            f"detector.model: {model} is no folder, and {variable} forbids to download it: unset that, or give a local"
            " folder"
        )
    from huggingface_hub import HfApi, constants

    hub = HfApi()
    try:
        info = hub.model_info(model, revision=revision, files_metadata=True)
        files = {file.rfilename: file for file in info.siblings or ()}
        wanted = [CONFIG, PREPROCESSING, *_published(more, files), *(_weights(files) or [WHOLE])]
        if missing := [name for name in wanted if name not in files]:
            raise DataError(f"detector.model: {model} on {constants.ENDPOINT} has no {' and no '.join(missing)}")
        size = sum(files[name].size or 0 for name in wanted)
        log.info("downloading %s, %.0f MB, licence %s, from %s into %s",
                 model, size / 1e6, _licence(info), constants.ENDPOINT, constants.HF_HUB_CACHE)  # fmt: skip
        paths = {name: Path(hub.hf_hub_download(model, name, revision=revision)) for name in wanted}
    except DataError:
        raise
    except Exception as error:  # the hub's client, and the library below it, each have errors of their own
        raise DataError(
            f"detector.model: {model} is no folder, and could not be downloaded from {constants.ENDPOINT}: check the"
            f" name and the network, or give a local folder; huggingface_hub says: {one_line(error)}"
        ) from error
    for name, path in paths.items():
        _check(path, files[name])


def forbidden_by() -> str:
    """The environment variable that forbids downloads; empty where none does."""
    forbidding = [name for name in HUB_OFFLINE if os.environ.get(name, "").upper() in ("1", "ON", "YES", "TRUE")]
    return (forbidding + [OFFLINE] * bool(os.environ.get(OFFLINE)) + [""])[0]


def _licence(info: Any) -> str:
    named = (tag.removeprefix("license:") for tag in info.tags or () if tag.startswith("license:"))
    return next(named, "not said")


def _check(path: Path, published: Any) -> None:
    """Raises DataError unless a large file has the SHA-256 that huggingface.co lists: its client checks the size."""
    if published.lfs is None or path_hash(path) == published.lfs.sha256:
        return
    path.resolve().unlink()  # the content, where the cache has links
    path.unlink(missing_ok=True)
    raise DataError(
        f"detector.model: {path.name} is not what was published: its sha256 is not {published.lfs.sha256}; it was"
        " deleted: try again"
    )


def imported_transformers() -> Any:
    """The library. Raises ConfigError, naming the extra, where it is not installed."""
    try:
        import transformers
    except ImportError as error:
        raise ConfigError("the package transformers is not installed: pip install instancemap[transformers]") from error
    return transformers


def read_part(parameter: str, folder: Path, what: str, auto_class: Any) -> Any:
    """A part of a model in a folder. Raises DataError, naming the parameter, for one that cannot be read."""
    try:
        return auto_class.from_pretrained(str(folder), local_files_only=True)
    except Exception as error:  # whatever transformers, tokenizers and safetensors raise on foreign files
        raise DataError(f"{parameter}: {what} could not be read from {folder}: {in_one_line(error)}") from error
