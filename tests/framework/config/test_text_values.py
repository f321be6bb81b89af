"""Tests for text and path values in overrides, which Hydra would reject or convert."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from framework.api import open_dataset
from framework.commands.command_line import directory_name, literal_arguments
from framework.config.composition import composed
from framework.config.text_values import literal, literal_in_block, typed, value_in
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import InstanceMapError, printable
from framework.interfaces import RGBDSequence
from framework.registry import build, text_kind

FOLDERS = [
    *("Küche", "部屋", "room (2)", "a=b", "room#1", "kitchen, old", "it's", '"big"', "[a]", "{b}", "a&b", "trailing "),
    *("2024_01_05", "1e3", "1.10", "true", "null", "0x10", "50%", "${x}", "back\\slash", "a$b", "~tilde"),
    *("été\t1", "a: b", "-m", "choice(a,b)", "[x,y]", "'", "a'b\"c", "*", "a;b|c", "x\\", "1_000", "NaN", "off"),
]


SCENES = [
    "2024_01_05",
    "47333462_1",
    "1e3",
    "1.10",
    "true",
    "null",
    "2024-01-05",
    "12:30",
    "0x10",
    "nan",
    "inf",
    "on",
    "1_0",
]


def values(key: str, *words: str) -> object:
    return OmegaConf.select(composed(*literal(words, text_kind)), key)


@pytest.mark.parametrize("name", FOLDERS)
def test_path_with_special_characters_is_literal(name: str) -> None:
    config = composed(
        *literal(["dataset=rgbd_folder", f"dataset.root=/scans/{name}", f"dataset.scene=x{name}"], text_kind)
    )
    assert (config.dataset.root, config.dataset.scene) == (f"/scans/{name}", f"x{name}")


@pytest.mark.parametrize("name", SCENES)
def test_scene_name_that_looks_like_number_is_text(name: str) -> None:
    assert str(values("dataset.scene", "dataset=rgbd_folder", "dataset.root=x", f"dataset.scene={name}")) == name


@pytest.mark.parametrize("name", FOLDERS)
def test_special_folder_is_opened_from_python(tmp_path: Path, name: str) -> None:
    with pytest.raises(InstanceMapError) as raised:
        open_dataset("rgbd_folder", root=tmp_path / name)
    assert printable(str(tmp_path / name)) in str(raised.value)


@pytest.mark.parametrize("name", [name for name in FOLDERS if name != '"big"'])
def test_special_key_of_main_config_is_literal(name: str) -> None:
    expected = None if name == "null" else name
    assert values("resume_from", f"resume_from={name}") == expected


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("'kitchen, old'", "kitchen, old"),
        ('"a=b"', "a=b"),
        (r"'it\'s'", "it's"),
        ("'null'", "null"),
        ("'1e3'", "1e3"),
    ],
)
def test_quoted_value_keeps_its_meaning(value: str, expected: str) -> None:
    assert values("dataset.root", "dataset=rgbd_folder", f"dataset.root={value}") == expected


def test_null_of_optional_parameter_is_none() -> None:
    assert values("dataset.ground_truth", "dataset=rgbd_folder", "dataset.root=x", "dataset.ground_truth=null") is None


def test_reference_to_resolver_is_resolved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCANS", "/my scans")
    root = "dataset.root=${oc.env:SCANS}/Küche"
    assert values("dataset.root", "dataset=rgbd_folder", root) == "/my scans/Küche"


def test_numbers_and_lists_keep_their_types() -> None:
    config = composed("fuser.voxel_size=0.02", "dataset.stride=2", "detector=none", "dataset.max_depth=1e1")
    assert (config.fuser.voxel_size, config.dataset.stride, config.dataset.max_depth) == (0.02, 2, 10.0)


def test_list_of_names_with_umlauts_is_a_list() -> None:
    words = ["detector=open_vocabulary", "detector.text_queries=[Tür,red chair,'a,b']"]
    assert values("detector.text_queries", *words) == ["Tür", "red chair", "a,b"]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("a,b", "a,b"),
        ("Küche,room (2)", "'Küche','room (2)'"),
        ("'kitchen, old',b", "'kitchen, old',b"),
        (r"kitchen\, old,b", "'kitchen, old',b"),
        ("2024_01_05,1e3", "'2024_01_05','1e3'"),
        ("choice(a,b)", "choice(a,b)"),
        ("it's,b", r"'it\'s',b"),
    ],
)
def test_commas_separate_values_in_sweep(value: str, expected: str) -> None:
    words = ["dataset=rgbd_folder", f"dataset.root={value}"]
    assert literal(words, text_kind, multirun=True)[1] == f"dataset.root={expected}"
    assert literal_arguments(["-m", *words])[2] == f"dataset.root={expected}"


def test_commas_separate_values_in_experiment() -> None:
    words = ["experiment=ablation_refiner", "dataset=rgbd_folder", "dataset.root=Küche,b"]
    assert literal(words, text_kind)[2] == "dataset.root='Küche',b"


def test_parameter_of_second_swept_option_is_literal() -> None:
    words = ["detector=none,precomputed", "detector.path=Küche,b"]
    assert literal(words, text_kind, multirun=True)[1] == "++detector.path='Küche',b"


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("detector.label_space=own.txt", "++detector.label_space=own.txt"),
        ("detector.weights=a.onnx", "detector.weights=a.onnx"),  # also of the default detector
        ("detector.lable_space=own.txt", "detector.lable_space=own.txt"),  # of no detector
        ("++detector.label_space=own.txt", "++detector.label_space=own.txt"),
        ("detector.box_format=CENTER,CORNER", "++detector.box_format=CENTER,CORNER"),  # of the second detector only
        ("fuser.voxel_size=0.02", "fuser.voxel_size=0.02"),
    ],
)
def test_key_of_swept_options_is_added(word: str, expected: str) -> None:
    words = ["detector=onnx_boxes,onnx_segmentation", word]
    assert literal(words, text_kind, multirun=True)[1] == expected


def test_arguments_of_hydra_options_are_unchanged() -> None:
    words = ["--config-dir", "a=Küche", "dataset=rgbd_folder", "dataset.root=Küche", "~viewer"]
    assert literal_arguments(words) == [*words[:3], "dataset.root='Küche'", "~viewer"]


@pytest.mark.parametrize("name", FOLDERS)
def test_printed_override_can_be_pasted(name: str) -> None:
    [word] = shlex.split(typed("dataset.root", Path("/scans", name)))
    assert values("dataset.root", "dataset=rgbd_folder", word) == f"/scans/{name}".rstrip("/")


@pytest.mark.parametrize("name", FOLDERS)
def test_value_in_stored_config_is_literal(name: str) -> None:
    config = composed("dataset=rgbd_folder")
    assert value_in(config, f"dataset.root=/{name}", text_kind) == ("dataset.root", f"/{name}")
    assert value_in(config, "fuser.voxel_size=0.02", text_kind) == ("fuser.voxel_size", 0.02)


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("table.caption=AP50, all scenes (Küche)", "table.caption='AP50, all scenes (Küche)'"),
        ("table.where.dataset.scene=2024_01_05", "table.where.dataset.scene=[2024_01_05,'2024_01_05']"),
        ("table.where.dataset.scene=[1e3,a]", "table.where.dataset.scene=[1e3,'1e3',a]"),
        ("table.where.dataset.scene=room (2)", "table.where.dataset.scene='room (2)'"),
        ("table.where.seed=2", "table.where.seed=2"),
        ("table.where.dataset.scene=[Küche,b]", "table.where.dataset.scene=['Küche',b]"),
        ("table.names.a=our's", r"table.names.a='our\'s'"),
        ("table.columns=[fps]", "table.columns=[fps]"),
        ("table.page_columns=2", "table.page_columns=2"),
    ],
)
def test_settings_of_table_are_literal(word: str, expected: str) -> None:
    from typing import get_type_hints

    from framework.tables.table_choice import TableChoice

    assert literal_in_block("table", get_type_hints(TableChoice), [word]) == [expected]


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        (r"detector.words=[mug,red\ chair],seed=1", "detector.words=[mug,red chair],seed=1"),
        (r"dataset.root='it\'s'", "dataset.root=its"),
        ("dataset.root='Küche (2)'", "dataset.root=Küche (2)"),
        ("seed=1,++detector.label_space=own.txt,+a=2", "seed=1,detector.label_space=own.txt,a=2"),
    ],
)
def test_directory_name_has_no_escapes(overrides: str, name: str) -> None:
    assert "\\" not in directory_name(overrides)
    assert directory_name(overrides).replace("'", "") == name


def test_folder_with_reference_in_its_name_is_opened(tmp_path: Path) -> None:
    (tmp_path / "${x}").mkdir()
    config = composed(*literal(["dataset=rgbd_folder", f"dataset.root={tmp_path}/${{x}}"], text_kind))
    with pytest.raises(InstanceMapError, match=r"camera\.json"):
        build(RGBDSequence, config.dataset)
    assert RgbdFolder.__name__ in str(config.dataset._target_)
