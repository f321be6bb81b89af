"""Folder that receives the outputs of a run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from framework.errors import DataError
from framework.files.atomic_write import make_folder, path_exists, sync_folder
from framework.files.folders.directory_lock import new_directory
from framework.files.folders.staged_files import StagedFiles

RESCUED = "rescued"  # suffix of the folder for outputs that cannot be written to the run directory


@dataclass(frozen=True)
class OutputFolder:
    """The run directory, or a folder that replaces it.

    If a run reads files of an earlier run in its own directory, its outputs are staged, and replace the earlier run
    when all are written. If the run directory cannot be written, the outputs are written next to it.
    """

    directory: Path  # run directory
    path: Path  # folder to which the files are written
    staged: StagedFiles | None = None  # None = the files are not staged
    error: DataError | None = None  # reason why the run directory cannot be written

    @classmethod
    def open(cls, directory: Path, keep_earlier: bool) -> OutputFolder:
        """Create the folder.

        Args:
            directory: The run directory.
            keep_earlier: Keep the files of the earlier run in the directory until all new files are written.

        Raises:
            DataError: No folder can be created.
        """
        try:
            if keep_earlier:
                staged = StagedFiles.begin(directory)
                return cls(directory, staged.folder, staged)
            _check_writable(directory)
            return cls(directory, directory)
        except DataError as error:
            return cls(directory, _rescue_folder(directory), error=error)

    def close(self, complete: bool, listed: Iterable[str]) -> tuple[Path, DataError | None]:
        """Return the final folder of the outputs, and the error if this is not the run directory.

        Args:
            complete: All outputs were written. Otherwise, staged files do not replace the earlier run.
            listed: The names of all possible outputs. Old files without a successor are removed.
        """
        if self.staged is None:
            return self.path, self.error
        error: DataError | None = None
        if complete:
            try:
                self.staged.replace(listed)
                return self.directory, None
            except DataError as failure:
                if not path_exists(self.path):  # the next reader completes the replacement
                    return self.directory, failure
                error = failure
        try:
            return self._rescued(), error
        except DataError as failure:
            return self.path, error or failure

    def _rescued(self) -> Path:
        """Move the staged files to a new folder, and return it."""
        reason: OSError | DataError | None = None
        for wanted in (_next_to(self.directory), self.directory / RESCUED):  # the first may be on another disk
            try:
                folder = Path(new_directory(str(wanted)))
                folder.rmdir()  # Windows cannot replace a folder
                self.path.rename(folder)
                sync_folder(folder.parent)
                return folder
            except (OSError, DataError) as error:
                reason = error
        raise DataError(f"{self.path}: expected a folder that can be moved, got an error ({reason})") from reason


def reads_results_in(directory: Path, settings: Iterable[object], names: Iterable[str]) -> bool:
    """Return True if a setting is the path of a directory, or of a named file in this directory.

    Examples are DIR, also through links, and DIR/trajectory.txt.
    """
    results = {_identity(str(path)) for path in (directory, *(directory / name for name in names))} - {None}
    return any(isinstance(value, str) and value != "" and _identity(value) in results for value in settings)


def _identity(path: str) -> tuple[int, int] | None:
    """Return the device and the number of a file or folder, or None if it does not exist."""
    try:
        found = Path(path).expanduser().stat()
    except (OSError, ValueError, RuntimeError):  # the text of a setting may be no path
        return None
    return found.st_dev, found.st_ino


def _next_to(directory: Path) -> Path:
    absolute = directory.absolute()
    return absolute.with_name(f"{absolute.name}_{RESCUED}")


def _rescue_folder(directory: Path) -> Path:
    """Create a folder next to a directory or, if impossible, in the folder for temporary files."""
    preferred = _next_to(directory)
    with suppress(DataError):
        return Path(new_directory(str(preferred)))
    return Path(new_directory(str(Path(tempfile.gettempdir()) / preferred.name)))


def _check_writable(directory: Path) -> None:
    try:
        make_folder(directory)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise DataError(f"{directory}: expected a writable folder, got an error ({error.strerror})") from error
