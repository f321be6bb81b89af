"""Bundles: a ZIP file with runs, their table, and the sources of third-party plugins."""

from __future__ import annotations

import sys
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from framework.config.composition import add_config_dir
from framework.errors import DataError
from framework.files.atomic_write import atomic_write
from framework.runs.manifest import MANIFEST, Manifest
from framework.runs.plugin_code import plugin_files, targets_of
from framework.runs.reproduction import COMPOSED, LARGE
from framework.runs.stored_runs import Record, find_records
from framework.runs.sweep_file import SWEEP

TABLES = (SWEEP, "table.md", "table.tex", "table.csv")
PLUGINS = "plugins"  # folder with the sources of third-party plugins
OPTIONS = "options"  # folder that registers these plugins, for the composition of configs
MAX_SIZE = 2**36  # maximum total size of an extracted bundle, bytes


def write_bundle(folder: Path, path: Path, with_maps: bool = False) -> int:
    """Write the completed runs below `folder`, their tables and their third-party plugins to a ZIP file.

    Returns the number of runs. Raises DataError if no run is complete, or if a run differs from its manifest.
    """
    records, _ = find_records(folder)
    if not records:
        raise DataError(f"{folder}: expected a completed run, got none")
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for record in records:
            if changed := Manifest.read(record.directory).changed_files(record.directory):
                raise DataError(f"{changed[0]}; repeat the run")
            _add_run(archive, record, folder, with_maps)
        for name in TABLES:
            if (folder / name).exists():
                archive.write(folder / name, name)
        targets = {pair for record in records for pair in targets_of(record.config)}
        for name, file in sorted({pair for _, target in targets for pair in plugin_files(target)}):
            archive.write(file, f"{PLUGINS}/{name}")
        for k, (stage, target) in enumerate(sorted(targets)):
            if plugin_files(target):
                archive.writestr(f"{OPTIONS}/{stage}/bundled_{k}.yaml", f"_target_: {target}\n")
    return len(records)


def _add_run(archive: zipfile.ZipFile, record: Record, folder: Path, with_maps: bool) -> None:
    inside = record.directory.relative_to(folder) if record.directory != folder else Path(record.directory.name)
    for name in (*Manifest.read(record.directory).files, MANIFEST, str(COMPOSED)):
        if (with_maps or name not in LARGE) and (record.directory / name).exists():
            archive.write(record.directory / name, (inside / name).as_posix())


@contextmanager
def opened_bundle(path: Path, trust_code: bool) -> Iterator[Path]:
    """Yield a temporary folder with the contents of a bundle, whose plugins can be imported inside the context.

    Raises DataError for an unreadable or too large file, and for a bundle with plugins unless `trust_code` is set.
    """
    try:
        archive = zipfile.ZipFile(path)
    except (OSError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: expected a bundle, got an error ({error})") from error
    with archive, tempfile.TemporaryDirectory(prefix="instancemap_bundle_") as temporary:
        if (size := sum(one.file_size for one in archive.infolist())) > MAX_SIZE:
            raise DataError(f"{path}: expected at most {MAX_SIZE} bytes, got {size}")
        has_code = any(name.startswith(f"{PLUGINS}/") for name in archive.namelist())
        if has_code and not trust_code:
            raise DataError(
                f"{path}: expected --trust-code for a bundle with plugin code, got none; inspect {PLUGINS}/ in the "
                "file first"
            )
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
