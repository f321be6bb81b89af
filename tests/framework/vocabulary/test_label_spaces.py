"""Tests for the label spaces and their conversion to COCO."""

import csv
from pathlib import Path

import numpy as np
import pytest

from framework.errors import ConfigError
from framework.vocabulary.label_spaces import (
    _SECTIONS,
    BENCHMARK_IDS,
    COCO,
    MEANINGS,
    SCENENN_TO_COCO,
    SPACES,
    ClassNames,
    label_space_of,
    read_labels,
    to_class_names,
    to_coco,
)


@pytest.mark.parametrize(
    ("space", "size", "first", "last"),
    [
        ("coco", 80, "person", "toothbrush"),
        ("nyu40", 40, "wall", "otherprop"),
        ("scenenn", 9, "bed", "bag"),
        ("ade20k", 150, "wall", "flag"),
        ("coco_panoptic", 133, "person", "rug-merged"),
        ("scannet20", 20, "wall", "otherfurniture"),
        ("scannet200", 200, "wall", "mattress"),
    ],
)
def test_label_spaces_are_complete(space, size, first, last):
    names = read_labels(space)
    assert len(set(names)) == len(names) == size
    assert (names[0], names[-1]) == (first, last)
    assert set(SPACES) == {"coco", "nyu40", "scenenn", "ade20k", "coco_panoptic", "scannet20", "scannet200"}


def test_label_order_matches_published_lists():
    assert [COCO.index(name) for name in ("chair", "couch", "bed", "tv", "book")] == [56, 57, 59, 62, 73]
    ade = read_labels("ade20k")
    assert [ade.index(name) for name in ("bed", "chair", "sofa", "toilet", "crt screen")] == [7, 19, 23, 65, 141]
    assert read_labels("coco_panoptic")[:81] == (*COCO, "banner")
    assert read_labels("nyu40").index("bag") == 36
    assert set(read_labels("scannet20")) < set(read_labels("nyu40"))
    scannet = read_labels("scannet200")
    assert [scannet.index(name) for name in ("floor", "couch", "paper towel dispenser", "object")] == [2, 5, 71, 172]


def test_label_meanings_are_consistent_coco_classes():
    for section, names in _SECTIONS.items():
        for name, coco in names.items():
            assert MEANINGS[name] == coco, f"{section}: {name}"
            assert name == name.strip().lower()
            assert "," not in name
            assert coco is None or coco in COCO
            assert name not in COCO or coco == name


def test_scenenn_labels_map_to_nine_coco_classes():
    assert SCENENN_TO_COCO["sofa"] == "couch"
    assert len(SCENENN_TO_COCO) == len(set(SCENENN_TO_COCO.values())) == 9
    assert set(to_coco(read_labels("scenenn")).classes) == set(SCENENN_TO_COCO.values())


def test_to_coco_of_coco_labels_is_identity():
    mapping = to_coco(COCO)
    assert mapping.classes == COCO
    np.testing.assert_array_equal(mapping.meaning, np.arange(80))
    assert to_coco(read_labels("coco_panoptic")).classes == COCO


def test_to_coco_sums_equal_classes_and_renormalizes():
    mapping = to_coco(["wall", "swivel chair", "sofa", "armchair", "person"])
    assert mapping.classes == ("person", "chair", "couch")
    rows = np.array([[0.5, 0.125, 0.125, 0.125, 0.125], [0, 0.3, 0.4, 0.3, 0], [0.2, 0.1, 0.5, 0.1, 0.1]], np.float32)
    found, known = mapping.apply(rows)
    np.testing.assert_allclose(
        found, [[0.25, 0.5, 0.25], [0, 0.6, 0.4], [1 / 8, 1 / 4, 5 / 8]], rtol=1e-6, err_msg="sums of columns"
    )
    assert found.dtype == np.float32
    np.testing.assert_array_equal(known, [False, True, True])


def test_to_coco_row_without_class_is_uniform_and_unknown():
    mapping = to_coco(["chair", "wall", "bed"])
    rows, known = mapping.apply(np.array([[0, 1, 0], [0, 0, 0]], np.float32))
    np.testing.assert_array_equal(rows, np.full((2, 2), 0.5))
    assert not known.any()


def test_to_coco_without_rows_is_empty():
    rows, known = to_coco(COCO).apply(np.zeros((0, 80), np.float32))
    assert (rows.shape, known.shape) == ((0, 80), (0,))


def test_to_coco_matches_loop_over_labels():
    labels = read_labels("ade20k")
    mapping = to_coco(labels)
    rows = np.random.default_rng(0).dirichlet(np.full(150, 0.1), 20).astype(np.float32)
    found, known = mapping.apply(rows)
    for row, new, is_known in zip(rows, found, known, strict=True):
        sums = dict.fromkeys(mapping.classes, 0.0)
        for label, p in zip(labels, row, strict=True):
            if (coco := _SECTIONS["ade20k"][label]) is not None:
                sums[coco] += float(p)
        np.testing.assert_allclose(new, np.array(list(sums.values())) / sum(sums.values()), rtol=1e-5, atol=1e-9)
        assert is_known == (_SECTIONS["ade20k"][labels[row.argmax()]] is not None)
    assert 0 < known.sum() < 20


def test_to_coco_accepts_published_spellings():
    assert to_coco(["Sofa, couch, lounge", "bed ", "N/A", "windowpane, window"]).classes == ("couch", "bed")
    assert to_coco(["tvmonitor", "plane"]).classes == ("airplane", "tv")


def test_to_coco_unknown_labels_raise_with_full_list():
    with pytest.raises(ConfigError, match=r"got unknown labels \(2 of 3\): 'chiar', 'Flux, capacitor'") as caught:
        to_coco(["chiar", "bed", "Flux, capacitor"])
    assert "\n" not in str(caught.value)


def test_to_coco_without_object_class_raises():
    with pytest.raises(ConfigError, match="expected at least one object class of COCO, got none in 2 labels"):
        to_coco(["wall", "floor"])
    with pytest.raises(ConfigError, match="expected at least one object class of COCO, got none in 0 labels"):
        to_coco([])


def test_class_names_of_known_labels_are_coco_by_default():
    assert to_class_names(["sofa", "wall"], ClassNames.AUTO).classes == ("couch",)
    assert to_class_names(["sofa", "wall"], ClassNames.OWN).classes == ("sofa", "wall")
    with pytest.raises(ConfigError, match=r"got unknown labels \(1 of 2\): 'pallet'; set detector.class_names=OWN"):
        to_class_names(["sofa", "pallet"], ClassNames.COCO)


def test_class_names_outside_of_label_spaces_are_kept(caplog):
    caplog.set_level("INFO")
    mapping = to_class_names(["n/a", "forklift", "sofa", "chiar", "forklift"], ClassNames.AUTO)
    assert mapping.classes == ("forklift", "sofa", "chiar")
    np.testing.assert_array_equal(mapping.meaning, [-1, 0, 1, 2, 0])
    expected = "because 3 of 5 are in no known label space: 'forklift', 'chiar' (similar to 'chair')"
    assert f"all names are kept, {expected}" in caplog.text
    assert to_class_names(["object", "wall"], ClassNames.AUTO).classes == ("object", "wall")
    with pytest.raises(ConfigError, match="expected at least one class, got none in 1 labels"):
        to_class_names(["n/a"], ClassNames.OWN)


def test_read_labels_from_text_file_checks_lines(tmp_path):
    path = tmp_path / "names.txt"
    path.write_text("chair\ndining table \n\n")
    assert read_labels(str(path)) == ("chair", "dining table")
    path.write_text("chair\n\nbed\n")
    with pytest.raises(ConfigError, match="line 2"):
        read_labels(str(path))
    path.write_text("\n")
    with pytest.raises(ConfigError, match="got an empty file"):
        read_labels(str(path))
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="coco, coco_panoptic, nyu40, scenenn, ade20k"):
        read_labels(str(path))
    with pytest.raises(ConfigError, match="got cocoo"):
        read_labels("cocoo")


@pytest.mark.parametrize(
    ("classes", "name"),
    [
        ((), "none"),
        (("object",), "agnostic"),
        (("chair", "couch"), "coco"),
        (("cabinet", "sofa"), "nyu40"),
        (("office chair", "couch"), "scannet200"),
        (("forklift", "chair"), "own classes"),
    ],
)
def test_label_space_of_map_is_first_with_its_classes(classes: tuple[str, ...], name: str) -> None:
    assert label_space_of(classes) == name


@pytest.mark.parametrize(
    ("label_space", "name", "number"),
    [("nyu40", "nyu40class", "nyu40id"), ("scannet20", "nyu40class", "nyu40id"), ("scannet200", "raw_category", "id")],
)
def test_benchmark_ids_equal_label_table_of_scannet(label_space: str, name: str, number: str) -> None:
    table = Path(__file__).resolve().parents[4] / "shared/data/scannet_scene0000/scannetv2-labels.combined.tsv"
    if not table.is_file():
        pytest.skip(f"{table} does not exist")
    with table.open(newline="") as file:
        ids = {row[name]: int(row[number]) for row in csv.DictReader(file, delimiter="\t")}
    assert BENCHMARK_IDS[label_space] == tuple(ids[name] for name in SPACES[label_space])


@pytest.mark.parametrize(
    ("content", "labels"),
    [
        ("__background__\nperson\nN/A\nchair\n", ("n/a", "person", "n/a", "chair")),  # torchvision's
        ("???\nperson\n???\nchair\n", ("n/a", "person", "n/a", "chair")),  # TensorFlow Lite's
        ("background\r\nforklift\r\n", ("n/a", "forklift")),
        ("3d printer\n2 door car\nchair\n", ("3d printer", "2 door car", "chair")),
        ("Gabelstapler\nPalette (groß)\n\n", ("Gabelstapler", "Palette (groß)")),
    ],
)
def test_read_labels_of_other_tools_gives_names(tmp_path: Path, content: str, labels: tuple[str, ...]) -> None:
    (tmp_path / "labels.txt").write_bytes(content.encode())
    assert read_labels(str(tmp_path / "labels.txt")) == labels


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("coco_labels.txt", "0  person\n1  bicycle\n", "numbers as well, such as '0  person'; remove the numbers"),
        ("labels.txt", "1: chair\n2: table\n", "numbers as well, such as '1: chair'"),
        ("data.yaml", "names:\n  0: forklift\n", "expected a text file with one name per line"),
        ("classes.json", '["forklift"]', "expected a text file with one name per line"),
        ("label_map.pbtxt", 'item { id: 1 name: "forklift" }', "expected a text file with one name per line"),
    ],
)
def test_read_labels_of_other_format_raises(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(ConfigError, match=message):
        read_labels(str(tmp_path / name))


def test_read_labels_agnostic_is_single_class() -> None:
    assert read_labels("agnostic") == ("object",)
