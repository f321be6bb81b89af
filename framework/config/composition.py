"""Composition of configs as on the command line, with one-line error messages."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from difflib import get_close_matches
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, InterpolationResolutionError, OmegaConfBaseException

from framework.config import hydra_api
from framework.config.renamed_keys import replace_in_overrides
from framework.errors import ConfigError, DataError, printable
from framework.files.atomic_write import read_text
from framework.files.search_paths import CONF
from framework.files.yaml_file import LARGEST_FILE, check_yaml, yaml_errors

log = logging.getLogger(__name__)


def composed(*overrides: str) -> DictConfig:
    """Return the main config with overrides.

    Raises:
        ConfigError: A name is unknown or a value is invalid.
    """
    return composed_with_choices(*overrides)[0]


def composed_with_choices(*overrides: str) -> tuple[DictConfig, dict[str, str | None]]:
    """Return the main config with overrides, and the chosen option of each config group.

    Raises:
        ConfigError: A name is unknown or a value is invalid.
    """
    with config_errors(), config_loader() as loader:
        config = loader.load_configuration("config", replace_in_overrides(overrides), RunMode.RUN, from_shell=False)
        choices = {str(group): option for group, option in config.hydra.runtime.choices.items()}
        with open_dict(config):
            del config["hydra"]
        return config, choices


@contextmanager
def config_errors() -> Iterator[None]:
    """Convert errors of Hydra and OmegaConf in the `with` body to ConfigError."""
    try:
        yield
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # Hydra raises ValueError for some errors
        raise ConfigError(one_line(error)) from error


def resolved(config: DictConfig) -> dict[str, Any]:
    """Return the keys and values of a config, with resolved interpolations."""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


_added: list[Path] = []


def add_config_dir(folder: Path) -> None:
    """Add the config options in a folder for this process, as --config-dir does.

    Raises:
        ConfigError: The folder does not exist.
    """
    if not folder.is_dir():
        raise ConfigError(f"--config-dir: expected an existing folder, got {folder}; correct the path")
    _added.append(folder.resolve())


def remove_config_dir(folder: Path) -> None:
    """Remove the config options of add_config_dir."""
    _added.remove(folder.resolve())


def added_config_dirs() -> tuple[Path, ...]:
    """Return the folders of add_config_dir."""
    return tuple(_added)


@cache
def installed_config_dirs() -> dict[Path, str]:
    """Return the config folders of installed packages, with the names of the packages.

    A package registers a folder by an entry point in the group `instancemap.configs`. The value of the entry point is
    the dotted path of the folder. No package is imported.
    """
    folders = {}
    for entry in entry_points(group="instancemap.configs"):
        package, *parts = entry.value.split(".")
        spec = find_spec(package)
        places = [Path(place, *parts) for place in (spec and spec.submodule_search_locations) or ()]
        folder = next(filter(Path.is_dir, places), None)
        name = entry.dist.name if entry.dist else entry.name
        if folder is None:
            log.warning(
                "%s: expected the folder %s of its entry point instancemap.configs, got none", name, entry.value
            )
        else:
            folders[folder.resolve()] = name
    return folders


class InstalledConfigs(SearchPathPlugin):
    """Hydra search path plugin that adds the config folders of installed packages."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder, package in installed_config_dirs().items():
            search_path.append(provider=package, path=f"file://{folder}")


class FileConfigSource(hydra_api.FileConfigSource):
    """Config source for folders of YAML files that checks each file before Hydra reads it.

    The class has the name of Hydra's own class, because Hydra distinguishes sources by class name.
    """

    def load_config(self, config_path: str) -> ConfigResult:
        path = Path(self.path, self._normalize_file_name(config_path))
        if not path.is_file():
            return super().load_config(config_path)
        with yaml_errors(path):
            check_yaml(path, read_text(path, LARGEST_FILE))
            found = super().load_config(config_path)
        config: Any = found.config
        if not isinstance(config, DictConfig):
            raise DataError(f"{path}: expected keys and values, got a list")
        # Hydra does not check some types of defaults
        if "defaults" in config and not isinstance(config.get("defaults"), ListConfig):
            raise DataError(f"{path}: defaults: expected a list, got {config.get('defaults')!r:.40}")
        return found


class HydraNodes(hydra_api.StructuredConfigSource):
    """Config source with only the structured configs of Hydra.

    Hydra adds its basic launcher and sweeper to the global config store when it scans its plugins. This class adds them
    to its own store instead. The store of the host application does not change.
    """

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        self.store = object.__new__(ConfigStore)  # ConfigStore() would return the store of the host application
        self.store.repo = {"hydra": deepcopy(ConfigStore.instance().repo["hydra"])}
        for part in ("launcher", "sweeper"):
            if "basic.yaml" not in self.store.repo["hydra"].get(part, {}):
                self.store.store("basic", {}, f"hydra/{part}")


HydraNodes.__name__ = "StructuredConfigSource"  # Hydra finds the source of the schema by this name


class Repository(hydra_api.ConfigRepository):
    """Repository of configs in folders and packages, and of the structured configs of Hydra.

    It does not use the process-wide registries of Hydra.
    """

    def initialize_sources(self, config_search_path: ConfigSearchPath) -> None:
        kinds = (FileConfigSource, hydra_api.ImportlibResourcesConfigSource, HydraNodes)
        by_scheme = {kind.scheme(): kind for kind in kinds}
        self.sources = [
            by_scheme[self._get_scheme(str(element.path))](str(element.provider), str(element.path))
            for element in config_search_path.get_path()
        ]


class ConfigLoader(hydra_api.ConfigLoaderImpl):
    """Loader of the configs of InstanceMap and of added folders.

    It does not use the process-wide state of Hydra.
    """

    def __init__(self) -> None:
        path = hydra_api.ConfigSearchPathImpl()
        path.append("hydra", "pkg://hydra.conf")
        path.append("main", f"file://{CONF}")
        for plugin in hydra_api.search_path_plugins():
            plugin().manipulate_search_path(path)
        known = {element.path for element in path.get_path()}
        for folder, provider in (installed_config_dirs() | dict.fromkeys(_added, "command-line")).items():
            if f"file://{folder}" not in known:
                path.append(provider, f"file://{folder}")
        path.append("schema", "structured://")  # Hydra expects it last
        self.config_search_path = path
        self.repository = Repository(path)

    def compose(self, overrides: list[str]) -> DictConfig:
        """Return the main config with overrides, without the node `hydra`.

        Raises:
            HydraException: An override is invalid.
        """
        config = self.load_configuration("config", overrides, RunMode.RUN, from_shell=False)
        with open_dict(config):
            del config["hydra"]
        return config


@contextmanager
def config_loader() -> Iterator[ConfigLoader]:
    """Yield a config loader. In the `with` body, the version base of Hydra is 1.3."""
    with hydra_api.version_base("1.3"):
        yield ConfigLoader()


def running_loader() -> Any | None:
    """Return the config loader of the running Hydra application, or None without an application.

    The result is also None if the application does not search the configs of InstanceMap.
    """
    hydra = hydra_api.running()
    if hydra is None:
        return None
    paths = [str(element.path).removeprefix("file://") for element in hydra.config_loader.get_search_path().get_path()]
    return hydra.config_loader if str(CONF) in paths else None


def one_line(error: BaseException) -> str:
    """Return the message of an error on one line.

    Some messages of Hydra and OmegaConf are rewritten to include the fix.
    """
    return printable(_message_of(error))


def _message_of(error: BaseException) -> str:
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _no_such_option(error)
    if isinstance(error, OverrideParseException):
        return f"override: expected KEY=VALUE, got {error.override!r}; quote values with special characters"
    if isinstance(error, HydraException) and isinstance(error.__cause__, ConfigAttributeError | ConfigKeyError):
        prefix = "" if str(error).startswith("Could not override") else f"{_joined(str(error))} "
        return f"{prefix}{_known_keys(error.__cause__)}"
    if isinstance(error, HydraException) and isinstance(error.__cause__, OmegaConfBaseException):
        return _joined(f"{error} {error.__cause__}")
    if isinstance(error, InterpolationResolutionError):  # the first line ends with the message of the resolver
        return _joined(
            str(error).partition("\n")[0].partition(" raised while resolving interpolation: ")[2] or str(error)
        )
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return _joined(str(error)) or type(error).__name__


_EXTRAS = {
    "hydra/launcher/joblib": ("launcher=joblib", "joblib"),
    "hydra/launcher/submitit_slurm": ("launcher=slurm", "slurm"),
    "hydra/launcher/ray": ("launcher=ray", "ray"),
    "hydra/sweeper/optuna": ("hydra/sweeper=optuna", "sweepers"),
}
"""The override and the required extra for each config of Hydra that may be missing."""

_OLD_SWEEPERS = ("ax", "nevergrad")
"""Sweepers whose latest release fails with Python 3.11: hydra-ax-sweeper 1.2 and hydra-nevergrad-sweeper 1.2."""


def _no_such_option(error: MissingConfigException) -> str:
    group, _, name = str(error.missing_cfg_file).rpartition("/")
    if not group:
        return _joined(str(error))
    if str(error.missing_cfg_file) in _EXTRAS:
        override, extra = _EXTRAS[str(error.missing_cfg_file)]
        return f"{override}: expected the installed extra {extra}, got none; run pip install 'instancemap[{extra}]'"
    options = list(error.options or ())
    if group == "hydra/sweeper" and name in _OLD_SWEEPERS:
        return (
            f"{group}: expected a sweeper for Python 3.11 and later, got {name}; set hydra/sweeper=optuna and run "
            "pip install 'instancemap[sweepers]'"
        )
    close = get_close_matches(name, options, n=1)
    suggestion = f"; did you mean {close[0]}?" if close else ""
    return f"{group}: expected one of {', '.join(options) or 'none'}, got {name}{suggestion}"


def _known_keys(error: OmegaConfBaseException) -> str:
    """Return the error message for an unknown key, with the most likely correct key or all known keys."""
    keys = [str(key) for key in error.parent_node] if isinstance(error.parent_node, DictConfig) else []
    close = get_close_matches(str(error.key), keys, n=1)
    path = str(error.full_key or error.key)
    if path == "table" or path.startswith("table.where."):  # new keys of a sweep
        key = f"+{path}.KEY" if path == "table" else f"+{path}"
        return f"{path}: expected a prefix + for a new key, got none; set {key}=VALUE"
    if close:
        return f"{path}: expected a known key, got {error.key}; did you mean {path[: -len(str(error.key))]}{close[0]}?"
    return f"{path}: expected one of {', '.join(keys) or 'none'}, got {error.key}"


def _joined(text: str) -> str:
    return " ".join(text.split())
