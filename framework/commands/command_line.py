"""How the commands answer faults: one line on stderr and an exit status; the traceback only where it is asked for."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path

from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.config.composition import FileConfigSource, InstalledConfigs, add_config_dir, one_line
from framework.config.hydra_api import replace_file_source
from framework.errors import ConfigError, InstanceMapError, PartialRunError
from framework.runtime.signals import Interrupted

log = logging.getLogger(__name__)

KNOWN_ERRORS = (InstanceMapError, HydraException, OmegaConfBaseException, OSError)
EXIT_FAILED = 1
EXIT_PARTIAL = 3  # a run ended early, and what it had mapped is written
EXIT_SIGNAL = 128  # and the signal's number, as shells report it: 130 after Ctrl-C, 143 after SIGTERM


def directory_name(overrides: str) -> str:
    """Overrides as the name of one directory: no separators, and short enough for every file system."""
    name = overrides.replace(os.sep, "_") or "defaults"
    if len(name) <= 200:
        return name
    import hashlib

    return f"{name[:180]}_{hashlib.sha256(name.encode()).hexdigest()[:16]}"


replace_file_source(FileConfigSource)
OmegaConf.register_new_resolver("directory_name", directory_name, replace=True)


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Ends the process with one line on stderr and a status when a known error, or Ctrl-C, comes out of the body."""
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra then raises its errors in place of printing them
    try:
        yield
    except KeyboardInterrupt as error:
        print(str(error) or "interrupted", file=sys.stderr)
        sys.exit(EXIT_SIGNAL + (error.number if isinstance(error, Interrupted) else signal.SIGINT))
    except (*KNOWN_ERRORS, ValueError) as error:  # Hydra answers some faults on its command line with ValueError
        show_traceback(error)
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(EXIT_FAILED)


def show_traceback(error: BaseException) -> None:
    """Where an error comes from, for whoever asks with `debug=true`; it precedes the line that says what is wrong."""
    if "debug=true" in sys.argv:
        traceback.print_exception(error)


def arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """What the command line asks for; `debug=true`, which all commands understand, is not for the parser.

    They all take --config-dir, too: what is registered there counts as registered, as in a run.
    """
    for word in sys.argv[1:]:
        if word.startswith("debug=") and word not in ("debug=true", "debug=false"):
            parser.error(f"debug must be true or false, found {word.partition('=')[2][:60]!r}")
    parser.add_argument("--config-dir", metavar="FOLDER", type=Path, help="of options of your own, as in a run")
    asked = parser.parse_intermixed_args([word for word in sys.argv[1:] if not word.startswith("debug=")])
    if asked.config_dir is not None:
        try:
            add_config_dir(asked.config_dir)
        except InstanceMapError as error:
            parser.error(str(error))
    return asked


def print_for_directories(description: str, place: str, write: Callable[[Path], str]) -> None:
    """A command whose arguments are DIR...: prints what `write` returns for each directory, which is a `place`.

    One that is refused does not stop the others.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("directory", metavar="DIR", nargs="+", type=Path, help=place)
    asked = arguments(parser)
    refused = 0
    with one_line_errors():
        for directory in asked.directory:
            try:
                print(write(directory))
            except KNOWN_ERRORS as error:
                show_traceback(error)
                print(f"error: {one_line(error)}", file=sys.stderr)
                refused += 1
    if refused:
        sys.exit(EXIT_FAILED)


@dataclass
class Jobs:
    """Reports each job's fault where it happens, so that the other jobs of a sweep still run, and keeps the status."""

    status: int = 0

    def reported(self, job: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
        """`job`, with its faults in the log: one line for a known error, the traceback for others and with `debug`."""

        @wraps(job)
        def reported_job(config: DictConfig) -> None:
            try:
                check_switches(config)
                job(config)
            except Exception as error:
                partial = isinstance(error, PartialRunError)
                fault = error.__cause__ or error if partial else error
                known = isinstance(fault, KNOWN_ERRORS)
                _log_error(one_line(error), fault if config.get("debug") is True or not known else None)
                if _in_worker():  # Hydra carries the error, if it can be pickled, to where the sweep was started
                    raise InstanceMapError(f"a run failed: {one_line(error)}") from None
                self.status = EXIT_PARTIAL if partial and not is_of_sweep(HydraConfig.get()) else EXIT_FAILED

        return reported_job

    def run(self, command: Callable[[], None]) -> None:
        """Runs Hydra's command for a reported job, and ends the process with a status when one has failed."""
        with one_line_errors():
            for folder in filter(Path.is_dir, _config_dirs(sys.argv[1:])):  # Hydra says where one is missing
                add_config_dir(folder)  # for what is done when Hydra has ended, such as a sweep's figure
            Plugins.instance().register(InstalledConfigs)
            command()
        if self.status:
            sys.exit(self.status)


def check_switches(config: DictConfig) -> None:
    """Raise ConfigError for a switch that is neither true nor false, such as `skip_completed=flase`."""
    for name in ("skip_completed", "debug"):
        if not isinstance(config.get(name, False), bool):
            raise ConfigError(f"{name} must be true or false, found {config[name]!r}")


def is_of_sweep(own: HydraConf) -> bool:
    """Whether a job is one of a sweep's."""
    return not OmegaConf.is_missing(own.job, "num")


def _config_dirs(words: list[str]) -> list[Path]:
    """The folders that --config-dir names on Hydra's command line."""
    folders = []
    for word, following in zip(words, [*words[1:], ""], strict=True):
        option, equals, value = word.partition("=")
        if option in ("--config-dir", "-cd"):
            folders.append(Path(value if equals else following))
    return folders


def _in_worker() -> bool:
    """Whether a job runs in another process than the sweep: in one of a launcher that is not Hydra's own."""
    own = HydraConfig.get()
    return is_of_sweep(own) and not str(own.launcher._target_).endswith(".BasicLauncher")


def _log_error(message: str, error: BaseException | None) -> None:
    """Through the log, which also keeps it beside the job's other files; to stderr where there is no log."""
    if logging.getLogger().handlers and not log.disabled:
        log.error("%s", message, exc_info=error)
        return
    if error is not None:
        traceback.print_exception(error)
    print(f"error: {message}", file=sys.stderr)
