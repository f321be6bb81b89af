"""Fuzz tests for option YAML files. An option must be built or rejected with a one-line error.

`INSTANCEMAP_FUZZ=2000 pytest tests/framework/config/test_config_fuzzing.py` tries 1000 cases.
"""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings

from framework.config import composition
from framework.config.composition import composed
from framework.errors import DataError, InstanceMapError
from framework.interfaces import Detector
from framework.registry import build
from tests.support.recordings.damaged_files import EXAMPLES, damaged

pytestmark = pytest.mark.integration

OPTION = b"""\
defaults:
  - _self_
_target_: plugins.detectors.precomputed.Precomputed
path: /nowhere/results.json # of a program
label_space: coco
category_ids: FROM_ONE
score_threshold: 0.1
class_spread: 1.0
"""
TOKENS = (
    *(
        b"\t",
        b"\n\t- a",
        b": ",
        b"- ",
        b"? ",
        b"!!python/object/apply:os.abort []",
        b"!!binary x",
        b"---\n",
        b"%YAML 9\n",
    ),
    *(b"&a ", b"*a", b"<<: *a\n", b"{" * 200, b"[" * 200, b"${", b"${seed}", b"${oc.env:HOME}", b"${" * 50, b"\x00"),
    *(b"${oc.decode:x}", b"${a:${b:c}}", b"1e999", b"9" * 5000, b"2001-99-99", b"\xff\xfe", b"_target_: os.abort\n"),
    *(
        b"defaults: [/nowhere]\n",
        b"defaults: 3\n",
        b"  - /detector: none\n",
        b"hydra: {}\n",
        b"# @package a.b\n",
        b"~: 1\n",
    ),
)
SLOWEST = 5.0  # s, maximum CPU time; wall time would depend on other processes
BOMB = "a0: &a0 [x]\n" + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12))


@pytest.fixture
def option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "detector").mkdir()
    monkeypatch.setattr(composition, "_added", [tmp_path])
    return tmp_path / "detector" / "mine.yaml"


def line_of(option: Path, content: bytes) -> str:
    """Return the error line of the option, or "" if the option was built. Fail for any other outcome."""
    option.write_bytes(content)
    began = time.process_time()
    try:
        build(Detector, composed("~dataset", "detector=mine").get("detector"))
    except InstanceMapError as error:
        line = str(error)
    else:
        line = ""
    assert time.process_time() - began < SLOWEST
    assert line.isprintable()
    assert len(line) < 1000
    return line


def test_config_option_undamaged_is_composed(option: Path) -> None:
    assert "/nowhere/results.json: expected a readable file" in line_of(option, OPTION)


@settings(max_examples=EXAMPLES // 2, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
@given(content=damaged(OPTION, TOKENS))
def test_config_option_damaged_builds_or_raises_one_line_error(content: bytes, option: Path) -> None:
    line_of(option, content)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("_target_: a.B\n\tpath: b\n", "found a tab character"),
        (BOMB, "expected at most 200000 keys and values"),
        ("a: &a [*a]\n", "expected a complete anchor &a before its alias"),
        ("a: " + "[" * 1000 + "]" * 1000, "expected at most 50 nested mappings and lists"),
        ("a: " + "[" * 100_000, "expected at most 50 nested mappings and lists"),
        ("a: !!python/object/apply:os.abort []", "could not determine a constructor"),
        ("x" * (2**22 + 1), "expected at most 4194304 bytes"),
        ("\udcff", "expected UTF-8 text"),
    ],
    ids=range(8),
)
def test_config_option_invalid_file_error_is_one_line_with_path(content: str, message: str, option: Path) -> None:
    line = line_of(option, content.encode(errors="surrogateescape"))
    assert message in line
    assert line.startswith(str(option))


def test_config_option_interpolated_target_raises_one_line_error(option: Path) -> None:
    assert "expected the _target_ of a registered option" in line_of(option, b"_target_: ${seed}plugins.X\n")


def test_config_option_linked_to_device_raises(option: Path) -> None:
    option.symlink_to("/dev/zero")
    with pytest.raises(InstanceMapError, match="detector: expected one of"):
        composed("~dataset", "detector=mine")


def test_stored_config_with_nested_aliases_raises(tmp_path: Path) -> None:
    from framework.runs.stored_runs import read_yaml

    (tmp_path / "config.yaml").write_text(BOMB)
    with pytest.raises(DataError, match=r"config\.yaml: expected at most"):
        read_yaml(tmp_path / "config.yaml")
