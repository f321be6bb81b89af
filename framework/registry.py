"""Construction of plugins from config nodes.

No other module runs code that is named in a config.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import pkgutil
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, TypeGuard, TypeVar, get_args, get_origin, get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.config.composition import config_loader, running_loader
from framework.config.hydra_api import CachingConfigRepository, create_defaults_list
from framework.config.renamed_keys import replace_deprecated
from framework.config.text_values import TextKind
from framework.config.validation import values_of, without_interpolation
from framework.errors import ConfigError, InstanceMapError, ParameterError, first_line
from framework.files.search_paths import PROJECT_ROOT, usable_path
from framework.interfaces import (
    BackEnd,
    ClusterRefiner,
    Detector,
    FrameMasking,
    MapFuser,
    PoseTracker,
    RGBDVideo,
    Viewer,
)

STAGES: Mapping[str, type[Any]] = {
    "dataset": RGBDVideo,
    "detector": Detector,
    "masking": FrameMasking,
    "tracker": PoseTracker,
    "refiner": ClusterRefiner,
    "fuser": MapFuser,
    "backend": BackEnd,
}
"""Interface of the options in each config group that affects results."""

GROUPS: Mapping[str, type[Any]] = {**STAGES, "viewer": Viewer}
"""Interface of the options in each config group of plugins."""

REGISTER = "; register your class with a file {stage}/NAME.yaml in a folder given by --config-dir"

Plugin = TypeVar("Plugin")


def build(interface: Callable[..., Plugin], node: DictConfig | None) -> Plugin:
    """Build the plugin of a config node.

    The key `_target_` of the node is the class name. All other keys are parameters. The class must be a concrete
    dataclass that implements `interface`. Interpolations are resolved against the config that contains the node.

    The class must also be the `_target_` of a registered option of the stage. This project, installed packages and the
    folders of --config-dir register options. Without a running Hydra application,
    `framework.config.composition.add_config_dir` adds a folder. Modules of other classes are not imported, so a config
    cannot run unregistered code.

    Args:
        interface: Interface of the plugin. It is not annotated as `type[Plugin]`, which excludes abstract classes.
        node: Config of the plugin.

    Raises:
        ConfigError: The class or a parameter is invalid. The message names the stage and the plugin.
        InstanceMapError: The constructor of the plugin raised this error. The message begins with the stage and the
            plugin.
    """
    stage = stage_of(interface)
    if not isinstance(node, DictConfig) or OmegaConf.is_missing(node, "_target_") or not node.get("_target_"):
        raise ConfigError(
            f"{stage}: expected a plugin's config with a _target_, got {_shown(node)}; choose {stage}=NAME"
        )
    target = str(node["_target_"])
    with _options_loader() as loader:
        if target not in _targets(loader, stage, target):
            hint = _did_you_mean(target, list(_targets(loader, stage, target))) or REGISTER.format(stage=stage)
            raise ConfigError(f"{stage}: expected the _target_ of a registered option of {stage}, got {target}{hint}")
    plugin_class = find_class(interface, target)
    where = f"{stage} {target}"
    arguments = parameters(where, plugin_class, node)
    for name, value in arguments.items():
        if isinstance(value, Path):
            usable_path(f"{stage}.{name}", value)
    try:
        with _errors_at(where, stage, stage, arguments):
            plugin: Plugin = assemble(plugin_class, **arguments)
    except (ImportError, ValueError) as error:
        raise ConfigError(f"{where}: expected a working constructor, got an error ({first_line(error)})") from error
    return plugin


def text_kind(config: DictConfig, key: str) -> TextKind | None:
    """Return the kind of the parameter of a plugin, or None for an unknown key.

    Args:
        config: A composed config of registered options.
        key: Dotted key, such as dataset.root.
    """
    group, *parts = key.split(".")
    if group not in GROUPS or not parts:
        return None
    node: Any = config.get(group)
    for part in parts[:-1]:
        node = node.get(part) if isinstance(node, DictConfig) else None
    if not isinstance(node, DictConfig) or not isinstance(target := node.get("_target_"), str):
        return None
    try:
        found = parameter_fields(find_class(GROUPS[group], target)).get(parts[-1])
    except ConfigError:  # an invalid class is reported when it is built
        return None
    return None if found is None else TextKind.of(found[1])


@contextmanager
def _errors_at(where: str, stage: str, key: str, names: Iterable[str]) -> Iterator[None]:
    """Prepend `where` to the message of an InstanceMapError in the `with` body, unless it begins with a parameter.

    In messages of a nested plugin, parameters such as "refiner.eps" become "refiner.links.dbscan.eps".

    Args:
        where: Stage and class name, and the parameter of a nested plugin.
        stage: Stage of the plugin.
        key: Config key of the plugin: the stage, or for example refiner.links.dbscan.
        names: Parameters of the plugin.
    """
    parameter = re.compile(rf"(?<![\w./-]){stage}\.(?=({'|'.join(names) or '$'})\b)")
    try:
        yield
    except ParameterError as error:
        raise ConfigError(f"{key}.{error.name}: {error.problem}") from error
    except InstanceMapError as error:
        message = parameter.sub(f"{key}.", str(error))
        raise type(error)(message if parameter.match(str(error)) else f"{where}: {message}") from error


def assemble(plugin_class: type[Plugin], /, **values: Any) -> Plugin:
    """Build a plugin from its parameters and the parameters of its parts.

    A part is a field with a dataclass as type.

    Args:
        plugin_class: Class of the plugin.
        values: Parameters by name.

    Returns:
        The plugin.
    """
    parts = {
        name: assemble(part, **{key: values.pop(key) for key in parameter_fields(part) if key in values})
        for name, (_, part) in _fields(plugin_class).items()
        if _is_part(part)
    }
    return plugin_class(**parts, **values)


def rebuilt(plugin: Plugin) -> Plugin:
    """Return a plugin with the parameters of another one, but without its state."""
    values = {
        name: rebuilt(getattr(plugin, name)) if _is_part(kind) else getattr(plugin, name)
        for name, (_, kind) in _fields(type(plugin)).items()
    }
    return type(plugin)(**values)


def parameter_fields(plugin_class: type) -> dict[str, tuple[dataclasses.Field[Any], Any]]:
    """Return the field and type of each parameter of a plugin, by name.

    A part (a field with a dataclass as type) is replaced by its own parameters.

    Raises:
        ConfigError: A name is not unique.
    """
    found: dict[str, tuple[dataclasses.Field[Any], Any]] = {}
    for name, (field, kind) in _fields(plugin_class).items():
        more = parameter_fields(kind) if _is_part(kind) else {name: (field, kind)}
        if twice := found.keys() & more.keys():
            raise ConfigError(
                f"{plugin_class.__name__}: expected unique parameter names, got {', '.join(sorted(twice))} twice; "
                "rename the fields"
            )
        found |= more
    return found


def _is_part(kind: object) -> TypeGuard[type[Any]]:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _fields(plugin_class: type) -> dict[str, tuple[dataclasses.Field[Any], Any]]:
    hints = get_type_hints(plugin_class)
    return {field.name: (field, hints[field.name]) for field in dataclasses.fields(plugin_class) if field.init}


def stage_of(interface: Callable[..., object]) -> str:
    """Return the config group of plugins that implement an interface, such as RGBDSequence."""
    assert isinstance(interface, type)
    return next(stage for stage, of in GROUPS.items() if issubclass(interface, of))


@contextmanager
def _options_loader() -> Iterator[Any]:
    """Yield a config loader that finds the configs of InstanceMap.

    The loader of the running Hydra application is preferred.
    """
    if (running := running_loader()) is not None:
        yield running
        return
    with config_loader() as loader:
        yield loader


def _targets(loader: Any, stage: str, sought: str) -> Iterator[str]:
    """Yield the class names in the options of a stage."""
    inheriting = []
    files: Any = CachingConfigRepository(loader.repository)
    # an option whose name occurs in the class name is most likely the right one
    for name in sorted(loader.get_group_options(stage), key=lambda name: name not in sought):
        own = files.load_config(f"{stage}/{name}").config
        if OmegaConf.is_interpolation(own, "_target_"):
            continue  # its value depends on other configs, so it names no class
        if "_target_" in own:
            yield str(own["_target_"])
        else:
            inheriting.append(name)
    for name in inheriting:
        with suppress(HydraException):  # broken option
            for path, package in composition(files, stage, name).items():
                if package == stage:
                    yield str(files.load_config(path).config.get("_target_"))


def composition(files: Any, stage: str, name: str) -> dict[str, str]:
    """Return the Hydra package of each config file of an option by path, in the order of composition.

    The option is composed as in a run, because it may override the choice of another stage.

    Args:
        files: Caching repository of a config loader.
        stage: Config group of the option.
        name: Name of the option.

    Raises:
        HydraException: The option is broken.
    """
    own = files.load_config(f"{stage}/{name}")
    if not own.defaults_list and own.header.get("package") is None:  # a single file: skip the composition (10 ms)
        return {f"{stage}/{name}": stage}
    chosen = OverridesParser.create().parse_overrides([f"{stage}={name}"])
    entries: Any = create_defaults_list(files, "config", chosen, prepend_hydra=False, skip_missing=False).defaults
    return {entry.config_path: entry.package for entry in entries if entry.package.partition(".")[0] == stage}


def find_class(interface: Callable[..., Plugin], target: str) -> type[Plugin]:
    """Import the class of a plugin.

    Args:
        interface: Interface of the plugin.
        target: Class name, as package.module.Class.

    Raises:
        ConfigError: The class is not a concrete dataclass that implements the interface.
    """
    assert isinstance(interface, type)
    stage = stage_of(interface)
    where = f"{stage} {target}"
    module_name, _, class_name = target.rpartition(".")
    if not module_name:
        raise ConfigError(f"{where}: _target_: expected package.module.Class, got {target}")
    module = _import(where, module_name)
    found = getattr(module, class_name, None)
    if found is None:
        fitting = [name for name, value in vars(module).items() if _implements(value, interface)]
        raise ConfigError(
            f"{where}: expected a class of the module {module_name}, got "
            f"{class_name}{_did_you_mean(class_name, fitting)}"
        )
    if not _implements(found, interface):
        kind = f"the class {class_name}" if isinstance(found, type) else f"a {type(found).__name__}"
        if _implements(found, GROUPS[stage]):
            what = (inspect.getdoc(interface) or "").partition("\n")[0].removesuffix(".")
            raise ConfigError(f"{where}: expected a subclass of {interface.__name__} ({what}), got {class_name}")
        raise ConfigError(f"{where}: expected a class that implements {interface.__name__}, got {kind}")
    if "__dataclass_fields__" not in vars(found):
        raise ConfigError(f"{where}: expected a dataclass, got {class_name} without @dataclass")
    if inspect.isabstract(found):
        missing = ", ".join(sorted(found.__abstractmethods__))
        raise ConfigError(
            f"{where}: expected all methods of {interface.__name__} in {class_name}, got none for: {missing}; "
            "implement them"
        )
    with _errors_at(where, where.split()[0], where.split()[0], ()):
        parameter_fields(found)
    plugin_class: type[Plugin] = found
    return plugin_class


def parameters(where: str, plugin_class: type, node: DictConfig) -> dict[str, Any]:
    """Return the keyword arguments for a plugin from its config node, with the types of its fields.

    Args:
        where: Stage and class name, for error messages.
        plugin_class: Class of the plugin. The metadata key `source` of a field describes how to obtain its value.
        node: Config of the plugin.

    Raises:
        ConfigError: A parameter is unknown or missing, or has a wrong type.
    """
    stages = plugin_fields(plugin_class)
    fields = parameter_fields(plugin_class)
    schema, plugins = _taken(where, plugin_class, node)
    missing = [name for name in fields if name not in stages and OmegaConf.is_missing(schema, name)]
    missing += [name for name in stages if name not in plugins]
    if missing:
        stage = where.split()[0]
        needed = " ".join(f"{stage}.{name}=..." for name in missing)
        hints = [str(fields[name][0].metadata["source"]) for name in missing if "source" in fields[name][0].metadata]
        raise ConfigError(
            f"{where}: expected a value for {', '.join(missing)}, got none; set {'; '.join([needed, *hints])}"
        )
    values = {name: plugins[name] if name in stages else schema[name] for name in fields}
    return {name: list(value) if isinstance(value, ListConfig) else value for name, value in values.items()}


def check_option(where: str, plugin_class: type, node: DictConfig) -> None:
    """Check the parameters of an option.

    Values that depend on other configs, and values that the user must set, are not checked.

    Raises:
        ConfigError: A parameter is unknown or has a wrong type.
    """
    plugins = plugin_fields(plugin_class)
    settled = [key for key in map(str, node) if key not in plugins and not OmegaConf.is_interpolation(node, key)]
    _taken(where, plugin_class, OmegaConf.masked_copy(node, settled))


def _taken(where: str, plugin_class: type, node: DictConfig) -> tuple[DictConfig, dict[str, Any]]:
    """Return the parameters of a plugin, including defaults, and its nested plugins by parameter."""
    stages = plugin_fields(plugin_class)
    fields = parameter_fields(plugin_class)
    typed = [
        (name, kind, dataclasses.field(default=field.default, default_factory=field.default_factory))
        for name, (field, kind) in fields.items()
        if name not in stages
    ]
    try:
        schema: DictConfig = OmegaConf.structured(dataclasses.make_dataclass(plugin_class.__name__, typed))
    except OmegaConfBaseException as error:
        field, kind = fields[str(error.full_key).partition("[")[0]]
        found = getattr(kind, "__name__", kind)
        found = found if field.default is dataclasses.MISSING else f"{found} with the default {field.default!r}"
        raise ConfigError(
            f"{where}: {field.name}: expected a parameter and default of type bool, int, float, str, Path, Enum or "
            f"list[str], got {found}"
        ) from error
    plugins: dict[str, Any] = {}
    stage = where.split()[0]
    for given in map(str, node):
        if given == "_target_" or OmegaConf.is_missing(node, given):
            continue
        key = given if given in fields else replace_deprecated(f"{stage}.{given}").removeprefix(f"{stage}.")
        if key not in fields:
            suggestion = _did_you_mean(key, list(fields))
            names = f"one of {', '.join(fields)}" if fields else "no parameters"
            expected = "a known parameter" if suggestion else names
            raise ConfigError(f"{where}: expected {expected}, got {key!r}{suggestion}")
        if key in stages:
            plugins[key] = _inner(where, key, stages[key], node[given], holds_one(plugin_class, key))
            continue
        try:
            value = node[given]
        except OmegaConfBaseException as error:  # interpolation of a missing key
            reason = first_line(error)
            raise ConfigError(f"{where}: {key}: expected a valid reference, got an error ({reason})") from error
        try:
            # a resolved value is not a reference
            schema[key] = without_interpolation(value) if isinstance(value, str) else value
        except (OmegaConfBaseException, OverflowError) as error:  # an integer beyond all floats overflows
            raise ConfigError(f"{where}: {key}: expected {values_of(fields[key][1])}, got {_shown(value)}") from error
    return schema, plugins


def plugin_fields(plugin_class: type) -> dict[str, type[Any]]:
    """Return the interface of each field that contains a plugin or a mapping of plugins, by name."""
    found = {}
    for name, hint in get_type_hints(plugin_class).items():
        of = get_args(hint)
        if hint in STAGES.values():
            found[name] = hint
        if get_origin(hint) is Mapping and len(of) == 2 and of[1] in STAGES.values():
            found[name] = of[1]
    return found


def holds_one(plugin_class: type, name: str) -> bool:
    """Return True if a field contains a single plugin, not a mapping of plugins."""
    return get_type_hints(plugin_class)[name] in STAGES.values()


def _inner(where: str, key: str, interface: type[Any], node: Any, one: bool) -> Any:
    """Return a nested plugin or a mapping of nested plugins by name, without null entries."""
    outer, stage = where.split()[0], stage_of(interface)
    if one:
        with _errors_at(f"{where}: {key}", stage, f"{outer}.{key}", map(str, node or ())):
            return build(interface, node)
    if not isinstance(node, DictConfig):
        raise ConfigError(f"{where}: {key}: expected plugins by name, got {_shown(node)}")
    found = {}
    for name in map(str, node):
        if node[name] is not None:
            with _errors_at(f"{where}: {key}.{name}", stage, f"{outer}.{key}.{name}", map(str, node[name])):
                found[name] = build(interface, node[name])
    return found


def _import(where: str, module_name: str) -> ModuleType:
    if module_name not in sys.modules:
        _check_module(where, module_name)
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{where}: {module_name}: expected an installed package {error.name!r}, got none; install it"
        ) from error
    except Exception as error:  # third-party code
        kind = type(error).__name__
        raise ConfigError(
            f"{where}: {module_name}: expected an importable module, got an error ({kind}: {first_line(error)})"
        ) from error


def _check_module(where: str, module_name: str) -> None:
    """Raise ConfigError if a module does not exist.

    Unlike importlib.util.find_spec, this function imports no packages.
    """
    package, *inner = module_name.split(".")
    name = package
    try:
        spec = importlib.util.find_spec(package)
    except ValueError:  # not a module name
        spec = None
    if package == "plugins" and spec is not None:
        _check_plugins_package(spec)
    for part in inner:
        if spec is None:
            break
        folders = list(spec.submodule_search_locations or [])
        name = f"{name}.{part}"
        specs = [finder.find_spec(name) for finder in map(pkgutil.get_importer, folders) if finder]
        spec = next((spec for spec in specs if spec and spec.loader), next(filter(None, specs), None))
        if spec is None:
            close = _did_you_mean(part, [module.name for module in pkgutil.iter_modules(folders)])
            raise ConfigError(f"{where}: expected an existing module, got {name}{close}")
    if spec is None:
        raise ConfigError(
            f"{where}: expected an existing module, got {name}; add --config-dir and start in the folder that contains "
            f"{package}, or install its package"
        )


def _check_plugins_package(plugins: ModuleSpec) -> None:
    """Raise InstanceMapError if another package named `plugins` is found before that of InstanceMap."""
    found = Path([*(plugins.submodule_search_locations or []), str(plugins.origin)][0]).resolve()
    if found != PROJECT_ROOT / "plugins":
        raise InstanceMapError(
            f"plugins: expected InstanceMap's package at {PROJECT_ROOT / 'plugins'}, got {found}; rename the other "
            "package or start Python in another folder"
        )


def _implements(found: Any, interface: type) -> bool:
    return isinstance(found, type) and issubclass(found, interface) and found is not interface


def _did_you_mean(name: str, known: list[str]) -> str:
    close = get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _shown(node: Any) -> str:
    return repr(OmegaConf.to_container(node) if OmegaConf.is_config(node) else node)
