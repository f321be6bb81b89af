"""Arguments and errors of commands.

An error is printed as one line to stderr and sets the exit status. `debug=true` adds the traceback.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from itertools import pairwise
from pathlib import Path
from typing import Any

from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from framework.config.composition import FileConfigSource, InstalledConfigs, add_config_dir, one_line
from framework.config.hydra_api import replace_file_source
from framework.config.text_values import literal
from framework.errors import ConfigError, InstanceMapError, PartialRunError
from framework.registry import text_kind
from framework.runtime.plain_output import escape_log_records, plain
from framework.runtime.signals import Interrupted, raise_on_signals

log = logging.getLogger(__name__)

KNOWN_ERRORS = (InstanceMapError, HydraException, OmegaConfBaseException, OSError)
EXIT_FAILED = 1
EXIT_PARTIAL = 3  # a run ended early and wrote partial outputs
WITH_VALUE = ("--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn", "--package", "-p")
"""Options of Hydra with a value as the next argument."""
EXIT_SIGNAL = 128  # plus the signal's number, as in shells: 130 after Ctrl-C, 143 after SIGTERM


def directory_name(overrides: str) -> str:
    """Return a directory name of at most 200 characters, without separators, quotes, escapes, references and ++."""
    name = (
        re.sub(r"\\(.)|['\"]|(?<![^,])\++", r"\1", overrides).replace(os.sep, "_").replace("${", "$").replace("\\", "_")
        or "defaults"
    )
    return name if len(name) <= 200 else f"{name[:180]}_{hashlib.sha256(name.encode()).hexdigest()[:16]}"


replace_file_source(FileConfigSource)
OmegaConf.register_new_resolver("directory_name", directory_name, replace=True)


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Print a known error or a signal in the `with` body as one line, and exit with an error status."""
    raise_on_signals()
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra then raises its errors instead of printing them
    try:
        yield
    except KeyboardInterrupt as error:
        print(str(error) or "interrupted", file=sys.stderr)
        sys.exit(EXIT_SIGNAL + (error.number if isinstance(error, Interrupted) else signal.SIGINT))
    except (*KNOWN_ERRORS, ValueError) as error:  # Hydra raises ValueError for some invalid arguments
        print_error(error)
        sys.exit(EXIT_FAILED)


def print_error(error: BaseException, prefix: str = "error: ") -> None:
    """Print an error as one line to stderr. With `debug=true`, print its traceback first."""
    if "debug=true" in sys.argv:
        traceback.print_exception(error)
    tqdm.write(plain(f"{prefix}{one_line(error)}"), file=sys.stderr)  # above a progress bar


def arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the command line.

    The option --config-dir is added to the parser. The argument `debug=true` is also accepted.
    """
    for word in sys.argv[1:]:
        if word.startswith("debug=") and word not in ("debug=true", "debug=false"):
            parser.error(f"debug: expected true or false, got {word.partition('=')[2][:60]!r}")
    parser.add_argument("--config-dir", metavar="FOLDER", type=Path, help="folder with additional config options")
    parsed = parser.parse_intermixed_args([word for word in sys.argv[1:] if not word.startswith("debug=")])
    if parsed.config_dir is not None:
        try:
            add_config_dir(parsed.config_dir)
        except InstanceMapError as error:
            parser.error(str(error))
    return parsed


def print_for_directories(
    description: str, directory_help: str, block: str, write: Callable[[Path, Sequence[str]], str]
) -> None:
    """Run a command with arguments DIR... and BLOCK.KEY=VALUE..., and print the result of `write` for each directory.

    An error in one directory does not stop the others.

    Args:
        description: Description of the command.
        directory_help: Description of DIR.
        block: Block of the sweep's config that the overrides change, such as `table`.
        write: Function of a directory and the overrides.
    """
    parser = argparse.ArgumentParser(description=description, usage=f"%(prog)s DIR... [{block}.KEY=VALUE ...]")
    help_text = f"{directory_help}; {block}.KEY=VALUE changes a setting of the stored sweep"
    parser.add_argument("words", metavar="DIR", nargs="+", help=help_text)
    failed = False
    with one_line_errors():
        words = arguments(parser).words
        overrides = [word for word in words if word.startswith(f"{block}.") and "=" in word]
        directories = [Path(word) for word in words if word not in overrides]
        if not directories:
            parser.error("DIR: expected a folder, got only settings")
        for directory in directories:
            try:
                print(write(directory, overrides))
            except KNOWN_ERRORS as error:
                print_error(error)
                failed = True
    if failed:
        sys.exit(EXIT_FAILED)


@dataclass
class Jobs:
    """Error logging and exit status for the jobs of a run or sweep.

    An error does not stop the other jobs.
    """

    status: int = 0

    def reported(self, job: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
        """Return a job that logs its errors, one line per error.

        The traceback is added for unknown errors and with `debug=true`.
        """

        @wraps(job)
        def reported_job(config: DictConfig) -> Any:
            escape_log_records()  # in workers, too
            try:
                check_switches(config)
                return job(config)
            except Exception as error:
                partial = isinstance(error, PartialRunError)
                cause = error.__cause__ or error if partial else error
                known = isinstance(cause, KNOWN_ERRORS)
                _log_error(one_line(error), cause if config.get("debug") is True or not known else None)
                if _is_handled_by_sweep(config):
                    raise InstanceMapError(f"a run failed: {one_line(error)}") from None
                self.status = EXIT_PARTIAL if partial and not is_of_sweep(HydraConfig.get()) else EXIT_FAILED
                return None

        return reported_job

    def run(self, command: Callable[[], None]) -> None:
        """Run a Hydra command, and exit with an error status if a job has failed."""
        with one_line_errors():
            for folder in filter(Path.is_dir, _config_dirs(sys.argv[1:])):  # Hydra reports a missing folder
                add_config_dir(folder)  # for steps after Hydra has finished, such as the figure of a sweep
            Plugins.instance().register(InstalledConfigs)
            sys.argv[1:] = literal_arguments(sys.argv[1:])
            command()
        if self.status:
            sys.exit(self.status)


def literal_arguments(words: Sequence[str]) -> list[str]:
    """Return the arguments of a command of Hydra, with quoted text values in its overrides."""
    multirun = not {"-m", "--multirun"}.isdisjoint(words)
    given = [k for k, word in enumerate(words) if "=" in word and not word.startswith(("-", "~"))]
    given = [k for k in given if k == 0 or words[k - 1] not in WITH_VALUE]
    quoted = dict(zip(given, literal([words[k] for k in given], text_kind, multirun), strict=True))
    return [quoted.get(k, word) for k, word in enumerate(words)]


def check_switches(config: DictConfig) -> None:
    """Raise ConfigError for a switch that is not a boolean, such as `skip_completed=flase`."""
    for name in ("skip_completed", "debug"):
        if not isinstance(config.get(name, False), bool):
            raise ConfigError(f"{name}: expected true or false, got {config[name]!r}")


def is_of_sweep(hydra_config: HydraConf) -> bool:
    """Return True for a job of a sweep."""
    return not OmegaConf.is_missing(hydra_config.job, "num")


def _config_dirs(words: list[str]) -> list[Path]:
    """Return the folders given by --config-dir (or -cd) on the command line of Hydra."""
    folders = []
    for word, following in pairwise([*words, ""]):
        option, equals, value = word.partition("=")
        if option in ("--config-dir", "-cd"):
            folders.append(Path(value if equals else following))
    return folders


def _is_handled_by_sweep(config: DictConfig) -> bool:
    hydra_config = HydraConfig.get()
    # the process of the sweep receives only the error of a job that runs in a worker process
    with_workers = not str(hydra_config.launcher._target_).endswith(".BasicLauncher")
    # with an objective, the sweeper limits the number of failed jobs
    return is_of_sweep(hydra_config) and (with_workers or config.get("objective") is not None)


def _log_error(message: str, error: BaseException | None) -> None:
    """Log an error, or print it if logging is not configured."""
    if logging.getLogger().handlers and not log.disabled:
        log.error("%s", message, exc_info=error)
        return
    if error is not None:
        traceback.print_exception(error)
    print(f"error: {message}", file=sys.stderr)
