"""Bundles: ZIP files with runs, their tables and the code of third-party plugins."""

from __future__ import annotations

import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from framework.config.composition import add_config_dir, remove_config_dir
from framework.errors import DataError, reason_of
from framework.files.atomic_write import atomic_write
from framework.files.manifest import MANIFEST, Manifest
from framework.runs.plugin_code import plugin_files, targets_of
from framework.runs.reproduction import LARGE
from framework.runs.stored_runs import completed_runs
from framework.runs.sweep_file import SWEEP

SWEEP_FILES = (SWEEP, "table.md", "table.tex", "table.csv", "table.yaml")
PLUGINS = "plugins"  # folder with the code of third-party plugins
OPTIONS = "options"  # config folder with an option for each of these plugins
MAX_SIZE = 2**36  # maximum total size of an extracted bundle, bytes


def write_bundle(folder: Path, path: Path, with_maps: bool = False) -> int:
    """Write a bundle of the completed runs in a folder and its subfolders.

    Args:
        folder: The folder of the runs and their tables.
        path: The ZIP file.
        with_maps: Include the maps, meshes and keyframes.

    Returns:
        The number of runs.

    Raises:
        DataError: No run is complete, or a file has changed since its run.
    """
    records, _ = completed_runs(folder)
    targets = {pair for record in records for pair in targets_of(record.config)}
    sources = {(stage, target): files for stage, target in sorted(targets) if (files := plugin_files(target))}
    with (
        atomic_write(path) as temporary,
        # ZIP files have no times before 1980 and after 2107
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, strict_timestamps=False) as archive,
    ):
        for record in records:
            manifest = Manifest.read(record.directory)
            if changed := manifest.changed_files(record.directory):
                raise DataError(f"{changed[0]}; repeat the run")
            names = [name for name in manifest.files if with_maps or name not in LARGE]
            of_run = record.directory.relative_to(folder) if record.directory != folder else record.directory.name
            _add_files(archive, record.directory, [*names, MANIFEST], Path(of_run))
        _add_files(archive, folder, SWEEP_FILES, Path())
        for name, file in sorted({pair for files in sources.values() for pair in files}):
            archive.write(file, f"{PLUGINS}/{name}")
        for k, (stage, target) in enumerate(sources):
            archive.writestr(f"{OPTIONS}/{stage}/bundled_{k}.yaml", f"_target_: {target}\n")
    return len(records)


def _add_files(archive: zipfile.ZipFile, folder: Path, names: Iterable[str], inside: Path) -> None:
    """Copy the existing files of a folder to the folder `inside` of the archive."""
    for name in names:
        if (folder / name).exists():
            archive.write(folder / name, (inside / name).as_posix())


@contextmanager
def opened_bundle(path: Path, trust_code: bool) -> Iterator[Path]:
    """Extract a bundle to a temporary folder, and yield the folder.

    The plugins of the bundle can be imported inside the context.

    Args:
        path: The ZIP file.
        trust_code: Accept a bundle with plugin code.

    Raises:
        DataError: The file is not a ZIP file, is damaged or too large, or contains plugin code without `trust_code`.
    """
    with _zip_errors(path):
        archive = zipfile.ZipFile(path)
    with archive, tempfile.TemporaryDirectory(prefix="instancemap_bundle_") as temporary:
        if (size := sum(one.file_size for one in archive.infolist())) > MAX_SIZE:
            raise DataError(f"{path}: expected at most {MAX_SIZE} bytes, got {size}")
        has_code = any(name.startswith(f"{PLUGINS}/") for name in archive.namelist())
        if has_code and not trust_code:
            raise DataError(
                f"{path}: expected --trust-code for a bundle with plugin code, got none; inspect {PLUGINS}/ in the "
                "file, then set --trust-code"
            )
        with _zip_errors(path):
            archive.extractall(temporary)
        folder = Path(temporary)
        if has_code:
            sys.path.insert(0, str(folder / PLUGINS))
            add_config_dir(folder / OPTIONS)
        try:
            yield folder
        finally:
            if has_code:
                sys.path.remove(str(folder / PLUGINS))
                remove_config_dir(folder / OPTIONS)


@contextmanager
def _zip_errors(path: Path) -> Iterator[None]:
    """Raise DataError for an error of a ZIP file in the `with` body."""
    try:
        yield
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError) as error:
        raise DataError(f"{path}: expected an undamaged bundle, got an error ({reason_of(error)})") from error
