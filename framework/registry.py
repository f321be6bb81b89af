"""Config nodes become checked plugins: the only place where a name in a config turns into code that runs."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Iterator, Mapping
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
from framework.config.renamed_keys import rename_hint
from framework.errors import ConfigError, InstanceMapError
from framework.files.search_paths import PROJECT_ROOT
from framework.interfaces import ClusterRefiner, Detector, MapFuser, PoseTracker, RGBDVideo, Viewer

STAGES: Mapping[str, type[Any]] = {
    "dataset": RGBDVideo,
    "detector": Detector,
    "tracker": PoseTracker,
    "refiner": ClusterRefiner,
    "fuser": MapFuser,
}
"""The config groups whose choice a result depends on, and the interface that their options implement."""

GROUPS: Mapping[str, type[Any]] = {**STAGES, "viewer": Viewer}
"""All config groups whose options are plugins."""

REGISTER = "; a class of your own needs a YAML {stage}/NAME.yaml in a folder that --config-dir names"

Plugin = TypeVar("Plugin")


def build(interface: type[Plugin], node: DictConfig | None) -> Plugin:
    """The plugin that a config node describes: `_target_` names the class, every other key is a parameter of it.

    The class must be one that an option of the stage names: those of this project, of installed packages and, in a run,
    of --config-dir; where no Hydra with our configs runs (from Python, or when a stored run is evaluated anew), also
    those of `framework.config.composition.add_config_dir`. Only then is its module imported. A class that is not a
    concrete dataclass implementing `interface` is rejected, so a config cannot run unregistered code. Interpolations
    in the node are resolved against the config that it belongs to.

    Raises:
        ConfigError: the class or a parameter is wrong; one line that names the stage, the plugin and what is wrong.
        InstanceMapError: what the plugin itself raises, with the stage and the plugin in front.
    """
    stage = stage_of(interface)
    if not isinstance(node, DictConfig) or OmegaConf.is_missing(node, "_target_") or not node.get("_target_"):
        raise ConfigError(
            f"{stage}: expected a plugin's config with a _target_, found {_shown(node)}; choose {stage}=NAME"
        )
    target = str(node["_target_"])
    with _options_loader() as loader:
        _refuse_unregistered(loader, stage, target)
    plugin_class = find_class(interface, target)
    where = f"{stage} {target}"
    arguments = parameters(where, plugin_class, node)
    try:
        return assemble(plugin_class, **arguments)
    except InstanceMapError as error:
        raise type(error)(f"{where}: {error}") from error
    except (ImportError, ValueError) as error:
        raise ConfigError(f"{where}: {_first_line(error)}") from error


def assemble(plugin_class: type[Plugin], /, **values: Any) -> Plugin:
    """The plugin with these parameters; those of its parts are given as if they were its own."""
    parts = {
        name: assemble(part, **{key: values.pop(key) for key in parameter_fields(part) if key in values})
        for name, (_, part) in _fields(plugin_class).items()
        if _is_part(part)
    }
    return plugin_class(**parts, **values)


def parameter_fields(plugin_class: type) -> dict[str, tuple[dataclasses.Field[Any], Any]]:
    """The parameters of a plugin by name, each its field and type; a part's parameters stand in its place.

    A part is a field whose type is a dataclass. Raises ConfigError when two parameters have one name.
    """
    found: dict[str, tuple[dataclasses.Field[Any], Any]] = {}
    for name, (field, kind) in _fields(plugin_class).items():
        more = parameter_fields(kind) if _is_part(kind) else {name: (field, kind)}
        if twice := found.keys() & more.keys():
            raise ConfigError(f"{plugin_class.__name__} has two parameters {', '.join(sorted(twice))}")
        found |= more
    return found


def _is_part(kind: object) -> TypeGuard[type[Any]]:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _fields(plugin_class: type) -> dict[str, tuple[dataclasses.Field[Any], Any]]:
    """The fields that a plugin or a part is made with, and their types."""
    hints = get_type_hints(plugin_class)
    return {field.name: (field, hints[field.name]) for field in dataclasses.fields(plugin_class) if field.init}


def stage_of(interface: type) -> str:
    """The config group whose options implement `interface`, or one that it is a kind of."""
    return next(stage for stage, of in GROUPS.items() if issubclass(interface, of))


def _refuse_unregistered(loader: Any, stage: str, target: str) -> None:
    if target not in _targets(loader, stage, target):
        hint = _did_you_mean(target, list(_targets(loader, stage, target))) or REGISTER.format(stage=stage)
        raise ConfigError(f"{stage} {target}: no registered option of {stage} has this _target_{hint}")


@contextmanager
def _options_loader() -> Iterator[Any]:
    """The loader of the Hydra that runs, where our configs are on its search path; else one for our configs."""
    running = running_loader()
    if running is not None:
        yield running
        return
    with config_loader() as loader:
        yield loader


def _targets(loader: Any, stage: str, sought: str) -> Iterator[str]:
    """The classes that the stage's options name, first of those options whose names `sought` has in it."""
    inheriting = []
    files: Any = CachingConfigRepository(loader.repository)
    for name in sorted(loader.get_group_options(stage), key=lambda name: name not in sought):
        own = files.load_config(f"{stage}/{name}").config
        if "_target_" in own:
            yield str(own["_target_"])
        else:
            inheriting.append(name)
    for name in inheriting:  # from another option, which was asked, or from what is none
        with suppress(HydraException):  # of an option that cannot be used
            for path, package in composition(files, stage, name).items():
                if package == stage:
                    yield str(files.load_config(path).config.get("_target_"))


def composition(files: Any, stage: str, name: str) -> dict[str, str]:
    """The configs that an option of a stage is made of, in order, and where each belongs: packages by path.

    They are looked for where a run would choose the option: one that overrides the choice of another stage, as a
    dataset may, composes nowhere else. `files` is a loader's repository, which Hydra would read anew for every option,
    and its own configs with it. Raises HydraException for an option that cannot be used.
    """
    own = files.load_config(f"{stage}/{name}")
    if not own.defaults_list and own.header.get("package") is None:  # it is itself, and Hydra would take 10 ms for that
        return {f"{stage}/{name}": stage}
    chosen = OverridesParser.create().parse_overrides([f"{stage}={name}"])
    entries: Any = create_defaults_list(files, "config", chosen, prepend_hydra=False, skip_missing=False).defaults
    return {entry.config_path: entry.package for entry in entries if entry.package.partition(".")[0] == stage}


def find_class(interface: type[Plugin], target: str) -> type[Plugin]:
    """The class that `target` ("package.module.Class") names.

    Raises ConfigError unless it can be imported and is a concrete dataclass that implements `interface`.
    """
    where = f"{stage_of(interface)} {target}"
    module_name, _, class_name = target.rpartition(".")
    if not module_name:
        raise ConfigError(f"{where}: _target_ must be package.module.Class")
    module = _import(where, module_name)
    found = getattr(module, class_name, None)
    if found is None:
        fitting = [name for name, value in vars(module).items() if _implements(value, interface)]
        raise ConfigError(f"{where}: module {module_name} has no {class_name}{_did_you_mean(class_name, fitting)}")
    if _implements(found, GROUPS[stage_of(interface)]) and not _implements(found, interface):
        what = (inspect.getdoc(interface) or "").partition("\n")[0].removesuffix(".")
        raise ConfigError(f"{where}: here it must be of the kind {interface.__name__} ({what})")
    if not _implements(found, interface):
        kind = "a class that does not" if isinstance(found, type) else f"a {type(found).__name__}"
        raise ConfigError(f"{where}: expected a class that implements {interface.__name__}, found {kind}")
    if "__dataclass_fields__" not in vars(found):
        raise ConfigError(f"{where}: a plugin must be a dataclass, and {class_name} is not decorated with @dataclass")
    if inspect.isabstract(found):
        missing = ", ".join(sorted(found.__abstractmethods__))
        raise ConfigError(f"{where}: {class_name} does not implement {missing} of {interface.__name__}")
    try:
        parameter_fields(found)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    plugin_class: type[Plugin] = found
    return plugin_class


def parameters(where: str, plugin_class: type, node: DictConfig) -> dict[str, Any]:
    """The keyword arguments that `node` gives to `plugin_class`, each with the type of its dataclass field.

    Raises ConfigError, starting with `where`, for an unknown parameter, a wrong type or a missing mandatory value: a
    field's metadata may say `where` such a value is to be had.
    """
    stages = plugin_fields(plugin_class)
    fields = parameter_fields(plugin_class)
    schema, plugins = _taken(where, plugin_class, node)
    missing = [name for name in fields if name not in stages and OmegaConf.is_missing(schema, name)]
    missing += [name for name in stages if name not in plugins]
    if missing:
        stage = where.split()[0]
        needed = " ".join(f"{stage}.{name}=..." for name in missing)
        hints = [str(fields[name][0].metadata["where"]) for name in missing if "where" in fields[name][0].metadata]
        raise ConfigError(f"{where}: {', '.join(missing)} must be given: {'; '.join([needed, *hints])}")
    return {name: plugins[name] if name in stages else _plain(schema[name]) for name in fields}


def check_option(where: str, plugin_class: type, node: DictConfig) -> None:
    """Raises ConfigError where an option, by itself, gives a parameter that there is not, or a value of a wrong type.

    What depends on other configs, and what only a user has, is left out.
    """
    plugins = plugin_fields(plugin_class)
    settled = [key for key in map(str, node) if key not in plugins and not OmegaConf.is_interpolation(node, key)]
    _taken(where, plugin_class, OmegaConf.masked_copy(node, settled))


def _taken(where: str, plugin_class: type, node: DictConfig) -> tuple[DictConfig, dict[str, Any]]:
    """A plugin's parameters and, where it holds others, those: what `node` gives, defaults for the rest."""
    stages = plugin_fields(plugin_class)
    fields = parameter_fields(plugin_class)
    try:
        schema = _schema(plugin_class.__name__, {name: of for name, of in fields.items() if name not in stages})
    except OmegaConfBaseException as error:
        raise ConfigError(
            f"{where}: parameters must be bool, int, float, str, Path, Enum or list[str]: {_first_line(error)}"
        ) from error
    names = list(fields)
    plugins: dict[str, Any] = {}
    for key in node:
        if key == "_target_" or OmegaConf.is_missing(node, key):
            continue
        if key not in names:
            hint = rename_hint(f"{where.split()[0]}.{key!s}")
            suggestion = f"; {hint}" if hint else _did_you_mean(str(key), names, "it has")
            raise ConfigError(f"{where}: there is no parameter {str(key)!r}{suggestion}")
        if key in stages:
            given = _plugin if holds_one(plugin_class, str(key)) else _plugins
            plugins[str(key)] = given(f"{where}: {key}", stages[str(key)], node[key])
            continue
        try:
            schema[key] = node[key]
        except OmegaConfBaseException as error:
            raise ConfigError(f"{where}: {key}: {_first_line(error)}") from error
    return schema, plugins


def _plain(value: Any) -> Any:
    """A list as Python has it."""
    return list(value) if isinstance(value, ListConfig) else value


def plugin_fields(plugin_class: type) -> dict[str, type[Any]]:
    """The fields that hold another plugin, or several by name (Mapping[str, interface]), and their interfaces."""
    found = {}
    for name, hint in get_type_hints(plugin_class).items():
        of = get_args(hint)
        if hint in STAGES.values():
            found[name] = hint
        if get_origin(hint) is Mapping and len(of) == 2 and of[1] in STAGES.values():
            found[name] = of[1]
    return found


def holds_one(plugin_class: type, name: str) -> bool:
    """Whether a field that holds plugins holds one, and not several by name."""
    return get_type_hints(plugin_class)[name] in STAGES.values()


def _schema(name: str, fields: Mapping[str, tuple[dataclasses.Field[Any], Any]]) -> DictConfig:
    """A config that takes what fits these fields, with their defaults."""
    kept = [
        (key, hint, dataclasses.field(default=field.default, default_factory=field.default_factory))
        for key, (field, hint) in fields.items()
    ]
    schema: DictConfig = OmegaConf.structured(dataclasses.make_dataclass(name, kept))
    return schema


def _plugin(where: str, interface: type[Plugin], node: Any) -> Plugin:
    """The plugin that a config in another one's describes."""
    try:
        return build(interface, node)
    except InstanceMapError as error:
        raise type(error)(f"{where}: {error}") from error


def _plugins(where: str, interface: type[Plugin], node: Any) -> dict[str, Plugin]:
    """The plugins that a mapping of configs describes, in its order; what is null is left out."""
    if not isinstance(node, DictConfig):
        raise ConfigError(f"{where}: expected plugins by name, found {_shown(node)}")
    found = {}
    for name in map(str, node):
        if node[name] is not None:
            try:
                found[name] = build(interface, node[name])
            except InstanceMapError as error:
                raise type(error)(f"{where}.{name}: {error}") from error
    return found


def _import(where: str, module_name: str) -> ModuleType:
    if module_name not in sys.modules:
        _found(where, module_name)
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ConfigError(f"{where}: {module_name} needs the package {error.name!r}, which is not installed") from error
    except Exception as error:  # whatever a third party's module does at import
        kind = type(error).__name__
        raise ConfigError(f"{where}: {module_name} cannot be imported: {kind}: {_first_line(error)}") from error


def _found(where: str, module_name: str) -> ModuleSpec:
    """Where a module is. Nothing is imported for it, as importlib.util.find_spec would its packages."""
    package, *inner = module_name.split(".")
    try:
        spec, name = importlib.util.find_spec(package), package
    except ValueError:  # no name, or one that is taken by what is no module
        spec, name = None, package
    if package == "plugins" and spec is not None:
        _refuse_another(spec)
    for part in inner:
        if spec is None:
            break
        beside = list(spec.submodule_search_locations or [])
        name = f"{name}.{part}"
        specs = [finder.find_spec(name) for finder in map(pkgutil.get_importer, beside) if finder]
        spec = next((spec for spec in specs if spec and spec.loader), next(filter(None, specs), None))
        if spec is None:
            close = _did_you_mean(part, [module.name for module in pkgutil.iter_modules(beside)])
            raise ConfigError(f"{where}: there is no module {name}{close}")
    if spec is None:
        raise ConfigError(f"{where}: there is no module {name}")
    return spec


def _refuse_another(plugins: ModuleSpec) -> None:
    """Raises InstanceMapError when the user has a package called `plugins`, and Python finds it before ours."""
    found = Path([*(plugins.submodule_search_locations or []), str(plugins.origin)][0]).resolve()
    if found != PROJECT_ROOT / "plugins":
        raise InstanceMapError(
            f"the package 'plugins' at {found} stands in the way of InstanceMap's own at {PROJECT_ROOT / 'plugins'}: "
            "rename it or start elsewhere"
        )


def _implements(found: Any, interface: type) -> bool:
    return isinstance(found, type) and issubclass(found, interface) and found is not interface


def _did_you_mean(name: str, known: list[str], otherwise: str = "") -> str:
    close = get_close_matches(name, known, n=1)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; {otherwise} {', '.join(known) or 'none'}" if otherwise else ""


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0] or type(error).__name__


def _shown(node: Any) -> str:
    return repr(OmegaConf.to_container(node) if OmegaConf.is_config(node) else node)
