"""`instancemap verify FOLDER`: compare the files of runs with their manifests."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from framework.commands.command_line import EXIT_FAILED, arguments, one_line_errors, print_error
from framework.errors import ConfigError, DataError
from framework.files.folders.directory_lock import locked
from framework.files.manifest import MANIFEST, RUN_FILES, Manifest
from framework.runs.stored_runs import run_directories


def main() -> None:
    """Run the command `instancemap verify`."""
    parser = argparse.ArgumentParser(
        description="Compare the files of a run with the sizes and SHA-256 hashes in its manifest.json. Each changed, "
        "missing or additional file is reported, and sets the exit status 1."
    )
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="run directory or folder of runs")
    accepted = "file of a run that you changed or deleted on purpose; its new hash is written to manifest.json"
    parser.add_argument("--accept", metavar="FILE", nargs="+", default=[], help=accepted)
    parsed = arguments(parser)
    with one_line_errors():
        if not parsed.folder.is_dir():
            raise DataError(f"{parsed.folder}: expected a run directory or a folder of runs, got no folder")
        if parsed.accept:
            accept(parsed.folder, parsed.accept)
        runs = list(run_directories(parsed.folder))
        if not runs:
            raise DataError(f"{parsed.folder}: expected a run, got none")
        changed = [run for run in runs if not is_verified(run)]
        if changed:
            sys.exit(EXIT_FAILED)


def is_verified(directory: Path) -> bool:
    """Compare a run directory with its manifest, print the result, and return True if all files are unchanged."""
    try:
        manifest = Manifest.read(directory)
        changed = manifest.changed_files(directory)
    except DataError as error:
        print_error(error)
        return False
    for change in changed:
        print_error(DataError(change))
    count = len(changed)
    found = f"{count} of {len(manifest.files)} files changed" if count else f"{len(manifest.files)} files unchanged"
    print(f"{directory}: {manifest.status.name}, {found}")
    return not changed


def accept(directory: Path, names: Sequence[str]) -> None:
    """Write the current sizes and hashes of files to the manifest of a run.

    Raises:
        ConfigError: A name is not that of a listed file.
        DataError: The manifest is missing, damaged or not writable, or the directory is in use.
    """
    manifest = Manifest.read(directory)
    listed = {*manifest.files, *RUN_FILES}
    if unlisted := [name for name in names if name not in listed]:
        expected = f"expected files listed in {directory / MANIFEST}"
        raise ConfigError(f"--accept: {expected}, got {', '.join(unlisted)}; choose {', '.join(sorted(listed))}")
    with locked(directory):  # `evaluate` may replace the manifest at the same time
        Manifest.read(directory).with_files(directory, names).write(directory)
