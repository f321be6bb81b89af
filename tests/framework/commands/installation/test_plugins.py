"""Tests for the listing of plugins, with a third-party package installed by pip."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from framework.commands.installation.plugins import Option, Parameter, describe, registered
from framework.config import composition
from framework.registry import GROUPS, STAGES

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[4]

PACKAGE = {
    "pyproject.toml": """
        [build-system]
        requires = ["setuptools"]
        build-backend = "setuptools.build_meta"
        [project]
        name = "acme-detectors"
        version = "1.0"
        [project.entry-points."instancemap.configs"]
        acme = "acme.conf"
        [tool.setuptools]
        packages = ["acme"]
        [tool.setuptools.package-data]
        acme = ["conf/**/*.yaml"]
    """,
    "acme/__init__.py": "",
    "acme/everything.py": '''
        from dataclasses import dataclass
        import numpy as np
        from instancemap import ConfigError, Detections, Detector, Frame

        @dataclass
        class Everything(Detector):
            """The whole image is one object.

            This paragraph is omitted from the listing.
            """

            score: float = 0.5

            def __post_init__(self) -> None:
                if not 0 <= self.score <= 1:
                    raise ConfigError(f"score: expected a value in [0, 1], got {self.score}")
                self.classes = ("chair",)

            def detect(self, frame: Frame) -> Detections:
                height, width = frame.camera.shape
                return Detections(
                    masks=np.ones((1, height, width), np.bool_),
                    boxes=np.array([[0, 0, width, height]], np.float32),
                    scores=np.array([self.score], np.float32),
                    class_probabilities=np.ones((1, 1), np.float32),
                    classes=self.classes,
                )
    ''',
    "acme/another.py": """
        from dataclasses import dataclass
        from acme.everything import Everything

        @dataclass
        class Another(Everything):
            pass
    """,
    "acme/conf/parts/acme_another.yaml": """
        _target_: acme.another.Another
    """,
    "acme/conf/detector/acme_by_part.yaml": """
        defaults: ["/parts/acme_another@_here_", _self_]
        score: 0.5
    """,
    "acme/conf/detector/acme_everything.yaml": """
        _target_: acme.everything.Everything
        score: 0.75 # score of the object, in [0, 1]
    """,
    "acme/conf/detector/acme_certain.yaml": """
        # acme_everything with a score of 1
        defaults: [acme_everything, _self_]
        score: 1.0
    """,
    "acme/conf/detector/acme_broken.yaml": """
        _target_: acme.missing.Detector
    """,
    "acme/conf/detector/acme_orphan.yaml": """
        defaults: [acme_nobody, _self_]
    """,
}


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the environment variables with which the installed package can be imported."""
    import textwrap

    source, site = tmp_path_factory.mktemp("acme"), tmp_path_factory.mktemp("site")
    for name, text in PACKAGE.items():
        path = source / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text).strip() + "\n")
    install = "-m pip install --quiet --no-deps --no-build-isolation --no-index --target"
    subprocess.run([sys.executable, *install.split(), str(site), str(source)], check=True, timeout=120)
    clean = {key: value for key, value in os.environ.items() if key != "HYDRA_FULL_ERROR"}
    return clean | {"PYTHONPATH": f"{CHECKOUT}:{site}"}


def run(environment: dict[str, str], directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", *arguments]
    return subprocess.run(line, cwd=directory, env=environment, capture_output=True, text=True, timeout=120)


def test_plugins_lists_options_of_installed_package(environment: dict[str, str], tmp_path: Path) -> None:
    done = run(environment, tmp_path, "framework", "plugins", "detector")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    at = lines.index("  acme_everything  [from acme-detectors]")
    assert lines[at + 1 : at + 4] == [
        "      The whole image is one object.",
        "      score: float = 0.75  # score of the object, in [0, 1]",
        "",
    ]
    at = lines.index("  acme_certain  [from acme-detectors]")
    assert lines[at + 1 : at + 4] == [
        "      The whole image is one object. Here: acme_everything with a score of 1.",
        "      score: float = 1.0  # score of the object, in [0, 1]",
        "",
    ]
    assert "unusable: detector acme.missing.Detector: expected an existing module, got acme.missing" in done.stdout
    at = lines.index("  acme_orphan  [from acme-detectors]")
    assert lines[at + 1].startswith("      unusable:")
    assert "acme_nobody" in lines[at + 1]


def test_installed_package_option_runs(environment: dict[str, str], tmp_path: Path) -> None:
    fakes = [f"{stage}=fake" for stage in STAGES if stage not in ("detector", "masking", "backend")]
    places = ["--config-dir", str(CHECKOUT / "tests" / "support" / "fake_conf"), "hydra.run.dir=run"]
    done = run(environment, tmp_path, "framework", *places, *fakes, "detector=acme_everything", "dataset.frames=1")
    assert done.returncode == 0, done.stderr
    assert '"instances.count": 1' in (tmp_path / "run" / "metrics.json").read_text()
    unregistered = run(environment, tmp_path, "framework", *places, *fakes, "detector._target_=acme.another.Anothr")
    assert (
        "detector: expected the _target_ of a registered option of detector, got acme.another.Anothr; did you mean"
        in unregistered.stderr
    )
    typo = run(environment, tmp_path, "framework", *places, *fakes, "detector=acme_everthing")
    assert "did you mean acme_everything?" in typo.stderr
    wrong = run(environment, tmp_path, "framework", *places, *fakes, "detector=acme_by_part", "detector.score=2")
    assert "score: expected a value in [0, 1], got 2.0" in wrong.stderr
    assert len(wrong.stderr.splitlines()) == 1


def test_plugins_unknown_option_error_is_one_line(environment: dict[str, str], tmp_path: Path) -> None:
    done = run(environment, tmp_path, "framework", "plugins", "detector", "acme_nothing")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: detector: expected one of acme_")
    assert len(done.stderr.splitlines()) == 1


def test_describe_option_formats_parameters_like_yaml() -> None:
    parameters = (Parameter("n", "int", "3", "px, size"), Parameter("longer", "str", "x", ""))
    option = Option("detector", "own", "a.b.C", "main", "Finds things.", parameters)
    assert describe(option).splitlines() == [
        "  own",
        "      Finds things.",
        "      n: int = 3       # px, size",
        "      longer: str = x",
    ]


FAULTY_OPTIONS = {
    "no_yaml": ("a: [1,\n", "no_yaml.yaml: expected valid YAML, got "),
    "list": ("- 1\n", "list.yaml: expected keys and values, got a list"),
    "no_text": ("\udcff", "no_text.yaml: expected UTF-8 text, got "),
    "no_class": ("_target_: plugins.detectors.none.NoDetection\n", "got NoDetection; did you mean 'NoDetections'?"),
    "a_refiner": ("_target_: plugins.refiners.identity.Identity\n", "expected a class that implements Detector"),
    "no_key": ("_target_: plugins.detectors.none.NoDetections\nscore: 1\n", "expected no parameters, got 'score'"),
    "no_number": (
        "_target_: plugins.detectors.simulated.SimulatedDetector\nmin_pixels: many\nseed: ${seed}\n",
        "min_pixels: expected an integer, got 'many'",
    ),
    "no_option": ("defaults: [unregistered, _self_]\n", "detector: expected one of"),
}


def test_plugins_faulty_options_are_listed_with_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    group = tmp_path / "detector"
    group.mkdir()
    for name, (text, _) in FAULTY_OPTIONS.items():
        (group / f"{name}.yaml").write_bytes(text.encode(errors="surrogateescape"))
    (group / "own.yaml").write_text("_target_: plugins.detectors.none.NoDetections\n")
    monkeypatch.setattr(composition, "_added", [tmp_path])
    found = {option.name: option for option in registered("detector")}
    for name, (_, message) in FAULTY_OPTIONS.items():
        assert found[name].documentation.startswith("unusable:")
        assert message in found[name].documentation
        assert "\n" not in found[name].documentation
    assert found["own"].provider == "command-line"
    assert found["own"].documentation == found["none"].documentation
    assert len(found["maskrcnn2go"].parameters) > 3


def test_describe_option_accepts_every_registered_option() -> None:
    options = registered(*GROUPS)
    assert {option.stage for option in options} == set(GROUPS)
    for option in options:
        assert option.name in describe(option)
        assert option.provider == "main"
        assert not option.documentation.startswith("unusable")


def test_plugins_listing_does_not_import_open3d(tmp_path: Path) -> None:
    """Importing Open3D takes 0.5 s and 170 MB, and the default stages do not need it."""
    code = (
        "import sys; from framework.commands.installation.plugins import *; "
        "registered(*GROUPS); print('open3d' in sys.modules)"
    )
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT)}
    line = [sys.executable, "-c", code]
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout == "False\n"
