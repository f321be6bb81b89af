"""Private APIs of Hydra. All other modules import them from here.

TESTED lists the tested versions. They must match `hydra-core>=1.3.8,<1.4` in pyproject.toml.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.config_search_path_impl import ConfigSearchPathImpl
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.core_plugins.importlib_resources_config_source import ImportlibResourcesConfigSource
from hydra._internal.core_plugins.structured_config_source import StructuredConfigSource
from hydra._internal.defaults_list import create_defaults_list
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.version import VersionBase, setbase

__all__ = [
    "CachingConfigRepository",
    "ConfigLoaderImpl",
    "ConfigRepository",
    "ConfigSearchPathImpl",
    "FileConfigSource",
    "ImportlibResourcesConfigSource",
    "StructuredConfigSource",
    "create_defaults_list",
]

TESTED = ("1.3.8",)

_composing = RLock()


@contextmanager
def version_base(version: str) -> Iterator[None]:
    """Set the version base of Hydra in the `with` body.

    The value of the host application is restored afterward.
    """
    with _composing:
        before = Singleton._instances.pop(VersionBase, None)
        setbase(version)
        try:
            yield
        finally:
            del Singleton._instances[VersionBase]
            if before is not None:
                Singleton._instances[VersionBase] = before


def running() -> Any | None:
    """Return the Hydra application of this process, or None without an application.

    Unlike GlobalHydra.instance(), this function does not create an application.
    """
    return getattr(Singleton._instances.get(GlobalHydra), "hydra", None)


def search_path_plugins() -> list[Any]:
    """Return the search path plugins that Hydra has loaded in this process."""
    plugins: Any = Singleton._instances.get(Plugins)
    return [] if plugins is None else list(plugins.discover(SearchPathPlugin))


def replace_file_source(source: type[FileConfigSource]) -> None:
    """Replace the class with which Hydra reads YAML files in this process.

    Only command-line processes may call this function.
    """
    Plugins.instance()  # registers Hydra's own sources
    SourcesRegistry.instance().types[source.scheme()] = source
