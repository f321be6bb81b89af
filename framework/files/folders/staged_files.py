"""Replacement of several files of a directory at once.

The new files are written to the subfolder `.staged`. When all are on disk, the subfolder is renamed to `.replacing`,
and its files are moved over the old ones. After a crash, all old files or all new files are there: readers complete an
interrupted move with `finish_replacement`, and the next writer discards unfinished new files.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from framework.errors import DataError
from framework.files.atomic_write import make_folder, path_exists, remove_left_over, sync_file, sync_folder

STAGED, REPLACING = ".staged", ".replacing"
REMOVED = ".removed"  # suffix of an empty file in the subfolder: the replacement removes the file of this name


@dataclass(frozen=True)
class StagedFiles:
    """New files that replace the files of the same names in a directory."""

    directory: Path

    @classmethod
    def begin(cls, directory: Path) -> StagedFiles:
        """Create the folder of the new files, and discard the unfinished files of a killed process.

        No other process may write to the directory.

        Raises:
            DataError: The directory cannot be written.
        """
        finish_replacement(directory)
        staged = cls(directory)
        try:
            make_folder(directory)
            for path in (staged.folder, directory / REPLACING):  # the second only if it is no folder of this module
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
            staged.folder.mkdir()
        except OSError as error:
            raise _not_writable(directory, error) from error
        return staged

    @property
    def folder(self) -> Path:
        """Folder to which the caller writes the new files."""
        return self.directory / STAGED

    def replace(self, removed: Iterable[str] = ()) -> None:
        """Move the new files over the old files. A symbolic link is replaced, not its target.

        Args:
            removed: The names of old files that are removed, except those that have new files.

        Raises:
            DataError: The directory cannot be written. While `folder` exists, all old files are unchanged. Without it,
                `finish_replacement` completes the replacement.
        """
        try:
            remove_left_over(self.folder)
            new = sorted(self.folder.iterdir())
            old = [self.directory / name for name in sorted({*removed} - {path.name for path in new})]
            old = [path for path in old if path_exists(path)]
            for path in [*(self.directory / path.name for path in new), *old]:
                if path.is_dir() and not path.is_symlink():
                    raise DataError(f"{path}: expected a regular file, got a folder")
            for path in old:
                (self.folder / f"{path.name}{REMOVED}").touch()
            for path in new:
                sync_file(path)
            sync_folder(self.folder)
            self.folder.rename(self.directory / REPLACING)
        except OSError as error:
            raise _not_writable(self.directory, error) from error
        finish_replacement(self.directory)

    def discard(self) -> None:
        """Remove the new files."""
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def staged_files(directory: Path) -> Iterator[Path]:
    """Yield a folder for new files, and replace the files of a directory at the end of the `with` body.

    After an error, the directory is unchanged. No other process may write to the directory.

    Raises:
        DataError: The directory cannot be written.
    """
    staged = StagedFiles.begin(directory)
    try:
        yield staged.folder
        staged.replace()
    finally:
        staged.discard()


def finish_replacement(directory: Path) -> None:
    """Complete the replacement of files in a directory if it was interrupted.

    Several processes may do this at the same time. A symbolic link is ignored, because the files of its target are not
    those of an interrupted replacement.

    Raises:
        DataError: The replacement cannot be completed, for example in a read-only folder.
    """
    replacing = directory / REPLACING
    while replacing.is_dir() and not replacing.is_symlink():
        try:
            _finish(directory, replacing)
        except FileNotFoundError:  # completed by another process
            return
        except OSError as error:
            if error.errno == errno.ENOTEMPTY:  # another process has begun the next replacement
                continue
            raise DataError(
                f"{replacing}: expected a writable folder to complete an interrupted replacement, got an error "
                f"({error.strerror}); open the directory once with write permission"
            ) from error


def _finish(directory: Path, replacing: Path) -> None:
    sync_folder(directory)
    for path in sorted(replacing.iterdir()):
        with suppress(FileNotFoundError):  # moved by another process
            if path.suffix == REMOVED:
                (directory / path.stem).unlink(missing_ok=True)
                path.unlink()
            else:
                path.replace(directory / path.name)
    sync_folder(directory)
    replacing.rmdir()
    sync_folder(directory)


def _not_writable(directory: Path, error: OSError) -> DataError:
    return DataError(f"{directory}: expected a writable folder, got an error ({error.strerror or error})")
