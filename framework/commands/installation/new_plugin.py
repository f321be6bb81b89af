"""`instancemap new-plugin STAGE NAME`: create a package with a working plugin.

framework/templates contains a folder of templates for each stage, and one for all stages.
"""

from __future__ import annotations

import argparse
import inspect
import keyword
import os
import re
import tempfile
from pathlib import Path
from string import Template

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import framework
from framework.commands.command_line import arguments, one_line_errors
from framework.commands.installation.plugins import options_of
from framework.data import Camera, Detections, Frame, Instance, PointClusters, Pose, SurfaceView
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import make_folder, sync_file, sync_folder
from framework.interfaces import SubmapChange
from framework.registry import GROUPS

TEMPLATES = Path(framework.__file__).with_name("templates")
PLACES = {  # path of each template in the new package; templates of the stage take precedence
    "plugin.py": "$package/$name.py",
    "option.yaml": "$package/conf/$stage/$name.yaml",
    "test.py": "tests/test_$name.py",
    "init.py": "$package/__init__.py",
    "pyproject.toml": "pyproject.toml",
    "README.md": "README.md",
    "LICENSE": "LICENSE",
    "gitignore": ".gitignore",
    "test.yml": ".github/workflows/test.yml",
}
LONGEST_NAME = 30  # maximum number of characters of a name; keeps lines of generated files within 120 characters
FOLDERS = ("conf", "tests")  # names of generated folders, not allowed as plugin names
SMALL = "dataset=synthetic dataset.frames=30 dataset.width=320 dataset.height=240"
FIRST = "hydra.sweep.dir=outputs/first_sweep"
# by stage: command that compares the new plugin with an existing one (dataset: two refiners on it; viewer: a single
# run)
TRIES = {
    "detector": f"instancemap -m detector=mask_rcnn_rooms,$name {SMALL} {FIRST}",
    "masking": f"instancemap -m masking=none,$name detector=simulated {SMALL} {FIRST}",
    "tracker": f"instancemap -m tracker=voxel_hashing_icp,$name detector=simulated {SMALL} {FIRST}",
    "refiner": f"instancemap -m refiner=gmm_em,$name detector=simulated {SMALL} {FIRST}",
    "fuser": f"instancemap -m fuser=bayesian_tsdf,$name detector=simulated {SMALL} {FIRST}",
    "backend": f"instancemap -m backend=none,$name detector=simulated {SMALL} {FIRST}",
    "dataset": f"instancemap -m refiner=identity,gmm_em dataset=$name dataset.root=DIR {FIRST}",
    "viewer": f"instancemap viewer=$name detector=simulated {SMALL} hydra.run.dir=outputs/first_run",
}
READ = "runs a sweep and prints `outputs/first_sweep/table.md`; `overview.png` of each run shows its map."
SWEPT = f"{READ} For a comparison, omit\n`dataset.frames`, `dataset.width` and `dataset.height`."
WATCHED = """\
maps thirty frames of a synthetic scene with it: `outputs/first_run/frames.jsonl` has a line for each frame.
`instancemap dataset=desk viewer=$name` maps a real sequence."""
DATA: dict[str, tuple[type, ...]] = {  # by stage: data types of its arguments and results, shown in the README
    "detector": (Frame, Camera, Detections),
    "masking": (Frame, Camera, Detections),
    "tracker": (Frame, Camera, SurfaceView, Pose),
    "refiner": (PointClusters, Frame, Camera),
    "fuser": (Frame, Camera, Pose, PointClusters, Instance),
    "backend": (Frame, Camera, Pose, SubmapChange),
    "dataset": (Frame, Camera),
    "viewer": (Frame, Camera, Detections, Pose, Instance),
}
VARIANTS = {  # by stage: changed parameter of the example variant in the README
    "detector": "tolerance: 30",
    "masking": "min_score: 0.6",
    "tracker": "max_distance: 0.2",
    "refiner": "reach: 0.6",
    "fuser": "least: 0.3",
    "backend": "length: 4.0",
    "dataset": "stride: 2",
    "viewer": "min_score: 0.6",
}


def main() -> None:
    """Run the command `instancemap new-plugin`."""
    parser = argparse.ArgumentParser(
        description="Create a package with a working plugin: code, config option, tests and CI."
    )
    parser.add_argument("stage", metavar="STAGE", choices=GROUPS, help=f"stage of the plugin: {', '.join(GROUPS)}")
    parser.add_argument("name", metavar="NAME", help="name of the plugin, such as my_refiner for refiner=my_refiner")
    parser.add_argument(
        "--in",
        dest="folder",
        metavar="DIR",
        type=Path,
        default=Path(),
        help="parent folder of the repository; default: working directory",
    )
    parsed = arguments(parser)
    with one_line_errors():
        made = write_repository(parsed.stage, parsed.name, parsed.folder)
        names = names_of(parsed.stage, parsed.name)
        print(f"written: {made}; the method is in {names['package']}/{parsed.name}.py")
        print(f"  cd {made} && pip install -e '.[test]' && pytest")
        print(f"  {names['try']}")


def write_repository(stage: str, name: str, folder: Path) -> Path:
    """Create the repository of a plugin atomically, and return its path.

    Args:
        stage: Stage of the plugin.
        name: Name of the plugin.
        folder: Parent folder of the repository.

    Raises:
        ConfigError: The name is invalid or exists, or the folder is missing.
        DataError: The folder is not writable.
    """
    check_name(stage, name)
    if not folder.is_dir():
        raise ConfigError(f"--in: expected an existing folder, got {folder}; create it")
    place = folder / names_of(stage, name)["distribution"]
    if os.path.lexists(place):
        raise ConfigError(
            f"{place}: expected a missing path, got an existing one; choose another NAME or another folder with --in"
        )
    try:
        with tempfile.TemporaryDirectory(prefix=".new-plugin-", dir=folder) as temporary:
            half = Path(temporary, "repository")
            for path, text in files_of(stage, name).items():
                make_folder((half / path).parent)
                (half / path).write_text(text, encoding="utf-8", newline="\n")
                sync_file(half / path)
                sync_folder((half / path).parent)
            half.rename(place)
            sync_folder(folder)
    except OSError as error:
        raise DataError(
            f"{place}: expected a writable folder, got an error ({error.strerror or error}); choose another "
            "folder with --in"
        ) from error
    return place


def check_name(stage: str, name: str) -> None:
    """Raise ConfigError unless a name is valid for a module and for a new option of a stage."""
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) or len(name) > LONGEST_NAME:
        raise ConfigError(
            f"NAME: expected at most {LONGEST_NAME} characters a-z, 0-9 or single _, with a letter first, got "
            f"{name!r}; choose a name such as my_{stage}"
        )
    if is_value(name):
        raise ConfigError(
            f"NAME: expected a name that YAML reads as a string, got {name} (null, a boolean or a number); choose "
            f"another name such as my_{name}"
        )
    if keyword.iskeyword(name) or name in FOLDERS:
        raise ConfigError(
            f"NAME: expected a name other than a Python keyword, {' or '.join(sorted(FOLDERS))}, got {name}; choose "
            f"another name such as my_{name}"
        )
    if name in options_of(stage):
        raise ConfigError(
            f"NAME: expected a new name, got the existing option {stage}={name}; choose another name such as my_{name}"
        )
    class_name = names_of(stage, name)["class_name"]
    if any(re.search(rf"\b{class_name}\b", _template(stage, template)) for template in ("plugin.py", "test.py")):
        raise ConfigError(
            f"NAME: expected a name whose class name is not used in the template, got {name} (class "
            f"{class_name}); choose another name such as my_{name}"
        )


def is_value(name: str) -> bool:
    """Return True if Hydra or YAML parses `name` as null, a boolean or a number."""
    on_a_line = OverridesParser.create().parse_override(f"option={name}").value()
    return not (isinstance(on_a_line, str) and isinstance(OmegaConf.create(f"option: {name}").option, str))


def names_of(stage: str, name: str) -> dict[str, str]:
    """Return the values of the template placeholders by name."""
    own = {
        "stage": stage,
        "name": name,
        "class_name": "".join(map(str.capitalize, name.split("_"))),
        "package": f"instancemap_{name}",
        "distribution": f"instancemap-{name.replace('_', '-')}",
        "version": framework.__version__,
        "variant": VARIANTS[stage],
        "data": "\n\n\n".join(map(fields_of, DATA[stage])),
    }
    texts = {"try": TRIES[stage], "outcome": {"viewer": WATCHED, "dataset": READ}.get(stage, SWEPT)}
    return own | {key: Template(text).substitute(own) for key, text in texts.items()}


def fields_of(data: type) -> str:
    """Return the source lines of a dataclass with its name and its fields."""
    body = inspect.getsource(data).partition("\n    def ")[0]
    return "\n".join([f"class {data.__name__}:", *re.findall(r"^    \w+: .*", body, re.MULTILINE)])


def files_of(stage: str, name: str) -> dict[str, str]:
    """Return the text of each file of the new repository, by relative path."""
    names = names_of(stage, name)
    return {
        Template(place).substitute(names): Template(_template(stage, template)).substitute(names)
        for template, place in PLACES.items()
    }


def _template(stage: str, name: str) -> str:
    own = TEMPLATES / stage / f"{name}.template"
    return (own if own.exists() else TEMPLATES / "every_stage" / own.name).read_text(encoding="utf-8")
