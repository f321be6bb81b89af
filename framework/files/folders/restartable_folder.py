"""Output folders of commands that can start again after an interruption.

While a command writes its folder, the folder contains a marker with the name of the command. The same command replaces
its unfinished files. Readers refuse the folder.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from framework.errors import DataError
from framework.files.atomic_write import atomic_write, is_temporary, path_exists, read_text, sync_folder
from framework.files.folders.directory_lock import HOLDER, LOCK, holder, is_locked, locked
from framework.files.folders.staged_files import STAGED

UNFINISHED = ".unfinished"  # marker file with the name of the command


def check_new(directory: Path) -> None:
    """Raise DataError if the path exists and is not an empty folder."""
    if directory.is_dir() and not _contents(directory):
        return
    if path_exists(directory):
        found = "got a file or non-empty folder; remove it or set another folder"
        raise DataError(f"{directory}: expected a new or empty folder, {found}")


def check_startable(directory: Path, command: str, check: Callable[[Path], None] = check_new) -> None:
    """Raise DataError unless `check` accepts the folder, or the same command was interrupted in it."""
    if interrupted_command(directory) != command:
        check(directory)


@contextmanager
def restartable_folder(
    directory: Path, command: str, own: re.Pattern[str], check: Callable[[Path], None] = check_new
) -> Iterator[None]:
    """Lock and mark a folder while its files are written in the `with` body.

    If the same command was interrupted in the folder, its files are removed first. After an exception, the folder stays
    unfinished, unless it has no files.

    Args:
        directory: The folder, which is created if it is missing.
        command: Name of the command.
        own: Pattern of the files that the command writes, relative to the folder, with slashes. Other files are kept.
        check: Function that raises DataError if the folder contains files of others.

    Raises:
        DataError: The folder is in use, not writable or refused by `check`.
    """
    check_startable(directory, command, check)
    existed, marker = directory.is_dir(), directory / UNFINISHED
    try:
        with locked(directory):
            check_startable(directory, command, check)  # another process may have finished it
            for path in _files(directory):
                if is_temporary(path.name) or own.fullmatch(path.relative_to(directory).as_posix()):
                    path.unlink()
            with atomic_write(marker) as temporary:
                temporary.write_text(f"{command}\n")
            try:
                yield
            except BaseException:
                if not any(own.fullmatch(path.relative_to(directory).as_posix()) for path in _files(directory)):
                    marker.unlink(missing_ok=True)
                raise
            for folder in {path.parent for path in _files(directory)}:
                sync_folder(folder)
            marker.unlink()
            sync_folder(directory)
    finally:
        if directory.is_dir() and not path_exists(marker) and not is_locked(directory):
            with suppress(OSError):
                for name in (LOCK, HOLDER):
                    (directory / name).unlink(missing_ok=True)
                if not existed:
                    directory.rmdir()  # if it is empty


def interrupted_command(directory: Path) -> str | None:
    """Return the name of the command that is writing the folder or was interrupted, None for other folders."""
    if not path_exists(directory / UNFINISHED):
        return None
    return read_text(directory / UNFINISHED).strip()


def check_finished(directory: Path) -> None:
    """Raise DataError if a command is writing the folder or was interrupted."""
    command = interrupted_command(directory)
    if command is None:
        return
    if is_locked(directory):
        owner = holder(directory) or "another process"
        raise DataError(f"{directory}: expected complete data, got a folder in use by {owner}; wait for it to exit")
    raise DataError(f"{directory}: expected complete data, got an unfinished {command}; repeat `instancemap {command}`")


def _contents(directory: Path) -> list[str]:
    """Return the names of the files and folders, except for locks and the files of killed processes."""
    names = [path.name for path in directory.iterdir()]
    return [name for name in names if name not in (LOCK, HOLDER, STAGED) and not is_temporary(name)]


def _files(directory: Path) -> list[Path]:
    return [path for path in directory.rglob("*") if path.is_symlink() or not path.is_dir()]
