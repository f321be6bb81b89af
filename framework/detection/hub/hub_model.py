"""Models from huggingface.co.

Models are downloaded once into the cache of huggingface_hub. Their hashes are verified.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from framework.detection.mask_rcnn.published_weights import OFFLINE
from framework.errors import DataError, import_optional, in_one_line
from framework.files.atomic_write import check_regular
from framework.files.hashing import path_hash
from framework.files.json_file import read_json
from framework.files.search_paths import expanded

HUB_OFFLINE = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")
"""Environment variables that disable downloads from huggingface.co if set to 1."""

CONFIG, PREPROCESSING = "config.json", "preprocessor_config.json"
WHOLE, INDEX, PICKLED = "model.safetensors", "model.safetensors.index.json", "pytorch_model.bin"
TOKENIZER = ("tokenizer.json", "tokenizer_config.json")
OLDER_TOKENIZER = ("vocab.json", "merges.txt", "tokenizer_config.json")  # as published for OWLv2

log = logging.getLogger(__name__)


def find_model(model: str, revision: str, more: Sequence[str] = ()) -> Path:
    """Return the folder of a model, and download the model if necessary.

    Cached models are used without a network request.

    Args:
        model: A local folder, or a model id on huggingface.co.
        revision: The branch, tag or commit of the model.
        more: Required files in addition to config, preprocessing and weights, such as the tokenizer files.

    Raises:
        DataError: The model does not exist, cannot be downloaded, or has a wrong hash.
    """
    folder = expanded(Path(model))
    if folder.is_dir():
        for file in filter(Path.exists, (folder / name for name in (CONFIG, PREPROCESSING, WHOLE, INDEX, PICKLED))):
            check_regular(file)  # transformers would block on a named pipe
        return folder
    cached = _cached(model, revision, more)
    if cached is None:
        _download(model, revision, more)
        cached = _cached(model, revision, more)
    if cached is None:
        raise DataError(
            f"detector.model: expected a complete cache after the download of {model}, got an incomplete cache; run "
            "the command again"
        )
    return cached


def commit_of(folder: Path) -> str:
    """Return the commit hash of a downloaded model, or "" for a local folder."""
    return folder.name if folder.parent.name == "snapshots" else ""


def _cached(model: str, revision: str, more: Sequence[str]) -> Path | None:
    """Return the cached folder of a model id, or None if a required file is missing."""
    from huggingface_hub import try_to_load_from_cache
    from huggingface_hub.errors import HFValidationError

    try:
        config = try_to_load_from_cache(model, CONFIG, revision=revision)
    except HFValidationError as error:
        raise DataError(
            f"detector.model: expected a folder or a model id, got {model} ({in_one_line(error)})"
        ) from error
    if not isinstance(config, str):
        return None
    folder = Path(config).parent
    names = {file.name for file in folder.iterdir() if file.exists()}
    weights = _weights(names)
    if INDEX in weights:
        weights = _listed(folder / INDEX)
    return folder if weights and {PREPROCESSING, *_published(more, names), *weights} <= names else None


def _listed(index: Path) -> list[str]:
    """Return the names of the weight files in an index file."""
    try:
        return [*read_json(index)["weight_map"].values()]
    except (DataError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"detector.model: expected an index of weight files, got a damaged file {index}; delete "
            f"{index.parents[2]} and run again"
        ) from error


def _weights(names: Collection[str]) -> list[str]:
    """Return the names of the weight files that transformers would load."""
    if WHOLE in names:
        return [WHOLE]
    if INDEX in names:
        return [INDEX, *sorted(n for n in names if n.startswith("model-") and n.endswith(".safetensors"))]
    return [PICKLED] if PICKLED in names else []


def _published(more: Sequence[str], names: Collection[str]) -> Sequence[str]:
    """Return the names of additional files, with older tokenizer files if the model has only those."""
    older = more == TOKENIZER and TOKENIZER[0] not in names and {*OLDER_TOKENIZER} <= {*names}
    return OLDER_TOKENIZER if older else more


def _download(model: str, revision: str, more: Sequence[str]) -> None:
    """Download the required files of a model into the cache."""
    if variable := forbidden_by():
        raise DataError(
            f"detector.model: expected a local folder while {variable} disables downloads, got {model}; unset "
            f"{variable} or set a folder"
        )
    from huggingface_hub import HfApi, constants

    hub = HfApi()
    try:
        info = hub.model_info(model, revision=revision, files_metadata=True)
        files = {file.rfilename: file for file in info.siblings or ()}
        wanted = [CONFIG, PREPROCESSING, *_published(more, files), *(_weights(files) or [WHOLE])]
        if missing := [name for name in wanted if name not in files]:
            raise DataError(
                f"detector.model: expected {' and '.join(missing)} in {model} on {constants.ENDPOINT}, got no such "
                "file; choose another model"
            )
        size = sum(files[name].size or 0 for name in wanted)
        license_ = next((t.removeprefix("license:") for t in info.tags or () if t.startswith("license:")), "unknown")
        log.info("downloading %s, %.0f MB, license %s, from %s into %s",
                 model, size / 1e6, license_, constants.ENDPOINT, constants.HF_HUB_CACHE)  # fmt: skip
        paths = {name: Path(hub.hf_hub_download(model, name, revision=revision)) for name in wanted}
    except DataError:
        raise
    except Exception as error:  # huggingface_hub and its HTTP library have no common base class of errors
        raise DataError(
            f"detector.model: expected a local folder or a download of {model} from {constants.ENDPOINT}, "
            f"got an error ({in_one_line(error)}); check the name and the network, or set a local folder"
        ) from error
    for name, path in paths.items():
        _check(path, files[name])


def forbidden_by() -> str:
    """Return the name of the environment variable that disables downloads, or "" if downloads are enabled."""
    forbidding = [name for name in HUB_OFFLINE if os.environ.get(name, "").upper() in ("1", "ON", "YES", "TRUE")]
    return (forbidding + [OFFLINE] * bool(os.environ.get(OFFLINE)) + [""])[0]


def _check(path: Path, published: Any) -> None:
    """Delete a downloaded file and raise DataError if it does not have the published SHA-256."""
    # huggingface_hub checks only the size of large files (Git LFS)
    if published.lfs is None or (found := path_hash(path)) == published.lfs.sha256:
        return
    path.resolve().unlink()  # the content, if the cache uses symbolic links
    path.unlink(missing_ok=True)
    raise DataError(
        f"detector.model: expected sha256 {published.lfs.sha256} for {path.name}, got {found}; run again to "
        "download the file again"
    )


def imported_transformers() -> Any:
    """Import transformers.

    Raises:
        ConfigError: transformers is not installed.
    """
    return import_optional("transformers", "loads models from huggingface.co", "transformers")


def read_part(parameter: str, folder: Path, what: str, auto_class: Any, **options: Any) -> Any:
    """Load a part of a model, such as the tokenizer, with a class of transformers.

    Args:
        parameter: The config key, for messages.
        folder: The folder of the model.
        what: A noun for the part, for messages.
        auto_class: The class of transformers.
        **options: Further arguments of `from_pretrained`.

    Raises:
        DataError: The part cannot be loaded.
    """
    try:
        return auto_class.from_pretrained(str(folder), local_files_only=True, **options)
    except Exception as error:  # transformers, tokenizers and safetensors raise many types for invalid files
        raise DataError(
            f"{parameter}: expected {what} in {folder}, got an unreadable file: {in_one_line(error)}"
        ) from error
