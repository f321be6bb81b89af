"""Tests of the LaTeX tables of a paper."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.errors import ConfigError
from framework.tables.experiment_tables import write_tables
from framework.tables.grid import TextTable
from framework.tables.latex_table import LatexTable, latex_file, latex_grid, latex_label
from framework.tables.metric_columns import Direction
from framework.tables.table_choice import TableChoice
from tests.support.latex import log_of_paper, requires_pdflatex
from tests.support.stored_experiments import AP50, experiment

GRID = TextTable(
    heads=["scene", "a_b", "x"],
    body=[["-1", "y|z", "-0.5 ± 0.1"], ["", "50%", "–"]],
    label_columns=2,
    bold=frozenset({(0, 2)}),
    groups=frozenset({1}),
    directions={2: Direction.LOWER},
)
SPECIAL = r"a_b & 50% of #1 $x {y} ~z ^2 \n <1> |2| ± – ×"


@pytest.mark.parametrize("name", ["*star", "[optional]"])
def test_latex_grid_protects_leading_star_and_bracket(name: str) -> None:
    """LaTeX interprets a star or bracket after a line break or a rule as its argument."""
    assert f"{{}}{name} & 1 \\\\" in latex_grid(TextTable(["row", "x"], [[name, "1"]]))


def test_latex_grid_replaces_line_breaks_in_cells() -> None:
    assert "a b & 1 \\\\" in latex_grid(TextTable(["row", "x"], [["a\nb", "1"]]))


def test_latex_grid_escapes_cells_and_separates_groups() -> None:
    assert latex_grid(GRID) == [
        "\\begin{tabular}{llr}",
        "\\toprule",
        "scene & a\\_b & x $\\downarrow$ \\\\",
        "\\midrule",
        "-1 & y\\textbar{}z & \\textbf{$-$0.5 $\\pm$ 0.1} \\\\",
        "\\midrule",
        " & 50\\% & -- \\\\",
        "\\bottomrule",
        "\\end{tabular}",
    ]


@pytest.mark.parametrize(
    ("page_columns", "columns", "environment"),
    [(1, 9, "table"), (2, 2, "table*"), (None, 5, "table"), (None, 6, "table*")],
)
def test_latex_table_environment_has_page_width(page_columns: int | None, columns: int, environment: str) -> None:
    table = LatexTable(TextTable(["x"] * columns, [["1"] * columns]), "c", "tab:l", page_columns)
    lines = table.lines()
    assert (lines[0], lines[-2]) == (f"\\begin{{{environment}}}", f"\\end{{{environment}}}")
    assert {"\\caption{c}", "\\label{tab:l}"} <= set(lines)


def test_latex_label_has_valid_characters() -> None:
    assert latex_label("Ablation of refiners, 50 %") == "tab:Ablation-of-refiners-50"


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"label": "tab:a b"}, "table.label: expected letters, digits, ':', '.', '_', '/' or '-', got 'tab:a b'"),
        ({"page_columns": 3}, "table.page_columns: expected 1, 2 or null, got 3"),
    ],
)
def test_table_choice_invalid_latex_settings_raise(setting: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        TableChoice.of_sweep(setting)
    assert str(caught.value).startswith(message)


@pytest.mark.integration
@requires_pdflatex
@pytest.mark.parametrize("page_columns", [1, 2])
def test_latex_table_compiles_within_page_columns(tmp_path: Path, page_columns: int) -> None:
    wide = TextTable([SPECIAL, *["metric (ms)"] * 12], [[SPECIAL * 2, *["1000.0 ± 10.0"] * 12]] * 3)
    tables = [LatexTable(GRID, "Short.", "tab:a", page_columns), LatexTable(wide, "Long.", "tab:b_c", page_columns)]
    log = log_of_paper(tmp_path, latex_file(tables, [SPECIAL]), "tab:a", "tab:b_c")
    assert "Overfull" not in log
    assert "undefined" not in log


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    root = experiment(tmp_path / "ablation_of_50%", {"chain": (0.5, 0.6, 1.0), "id_entity": (0.2, 0.4, 0.6)})
    for path in root.glob("*/metrics.json"):
        metrics = json.loads(path.read_text()) | {"environment.cpus": 2, "environment.processor": "Z80 & co"}
        path.write_text(json.dumps(metrics))
    return root


@pytest.mark.integration
@requires_pdflatex
@pytest.mark.parametrize("layout", [[], ["table.columns_by=refiner.kind"], ["table.group_by=dataset"]])
def test_write_tables_latex_compiles(sweep: Path, tmp_path: Path, layout: list[str]) -> None:
    write_tables(sweep, layout)
    log = log_of_paper(tmp_path, (sweep / "table.tex").read_text(), "tab:ablation_of_50")
    assert "Overfull" not in log
    assert "undefined" not in log


@pytest.mark.integration
def test_latex_caption_contains_constants_of_runs(sweep: Path) -> None:
    write_tables(sweep)
    lines = (sweep / "table.tex").read_text().splitlines()
    assert lines[0] == "% \\usepackage{booktabs} \\usepackage{graphicx}"
    assert [line for line in lines if line.startswith("\\label")] == [
        "\\label{tab:ablation_of_50}",
        "\\label{tab:ablation_of_50-differences}",
        "\\label{tab:ablation_of_50-statistics}",
    ]
    first, second, _ = (line for line in lines if line.startswith("\\caption"))
    assert first == (
        "\\caption{ablation\\_of\\_50\\%: mean $\\pm$ sample standard deviation over seed. Common to all runs: "
        "dataset=d, detector=seen; seeds 0, 1, 2; n = 3 runs per row; 2 cores of Z80 \\& co.}"
    )
    assert second.startswith("\\caption{Differences in ablation\\_of\\_50\\%, each row minus chain: mean $\\pm$")
    assert "row & runs & AP50 $\\uparrow$ & poses \\\\" in lines


@pytest.mark.integration
def test_write_tables_overrides_change_stored_settings(sweep: Path) -> None:
    text = write_tables(
        sweep, ["table.base=id_entity", "table.caption='Our \\textbf{results}.'", "table.label=tab:ours"]
    )
    assert "| minus id_entity | pairs |" in " ".join(text.split())
    latex = (sweep / "table.tex").read_text()
    assert "\\caption{Our \\textbf{results}.}\n\\label{tab:ours}" in latex
    stored = OmegaConf.load(sweep / "multirun.yaml").table
    assert stored == {"average_over": ["seed"], "columns": [AP50]}
    with pytest.raises(ConfigError, match=r"table\.columns=\[a: expected KEY=VALUE, got an error"):
        write_tables(sweep, ["table.columns=[a"])
    with pytest.raises(ConfigError, match=r"table\.columns=a,b: expected one value, got a sweep"):
        write_tables(sweep, ["table.columns=a,b"])


def test_latex_file_comments_are_single_lines() -> None:
    text = latex_file([], ["a\n\\input{x}\r\\input{y}\u2028\\input{z} \x1b"])
    assert text.splitlines()[1:] == [r"% a \input{x} \input{y} \input{z} \x1b"]
