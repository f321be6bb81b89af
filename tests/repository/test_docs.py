"""Tests for the documentation and CITATION.cff.

The pages must build without warnings, and all links and names must exist.
"""

from __future__ import annotations

import html
import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

import instancemap
from framework import __version__
from framework.commands.installation.plugins import registered
from framework.config import composition
from framework.files.search_paths import CONF
from framework.importing.formats import FORMATS
from framework.registry import GROUPS
from framework.tables.table_choice import TableChoice
from tests.support.doc_pages import CHECKOUT, DOCS, PAGES

pytestmark = pytest.mark.integration

LINKING = {
    **PAGES,
    **{
        str(path.relative_to(CHECKOUT)): path.read_text()
        for folder in ("*.md", "data/**/*.md", "plugins/**/*.md")
        for path in sorted(CHECKOUT.glob(folder))
    },
}
CODE = re.compile(r"^(```|~~~).*?^\1|`[^`\n]+`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)")


def anchors(page: str) -> set[str]:
    """Return the anchors of the headings of a page, like those of code hosts and myst-parser."""
    titles = re.findall(r"^#+ (.*)", re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", LINKING)
def test_page_links_resolve(name: str) -> None:
    here = CHECKOUT / name
    for path, anchor in LINK.findall(CODE.sub("", LINKING[name])):
        target = (here.parent / path).resolve() if path else here
        assert target.is_relative_to(CHECKOUT), f"expected a link inside the project, got {path}"
        assert target.exists(), f"expected an existing file, got {path}"
        if anchor:
            assert anchor in anchors(target.read_text()), f"{path}: expected a heading #{anchor}, got none"


def option_names(stage: str) -> list[str]:
    return [path.stem for path in (CONF / stage).glob("*.yaml")]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the pages as HTML and return their folder."""
    missing = [name for name in ("sphinx", "furo", "myst_parser") if find_spec(name) is None]
    if missing:
        pytest.skip(f"requires {', '.join(missing)}: pip install --group docs")
    place = tmp_path_factory.mktemp("docs")
    command = ["-m", "sphinx", "-W", "--keep-going", "-n", "-q", "-d", str(place / "doctrees"), str(DOCS)]
    done = subprocess.run(
        [sys.executable, *command, str(place / "html")], capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return place / "html"


BROKEN = [
    ("![](there.png)", "alternative text"),
    ("```{figure} there.png\nCaption\n```", "alternative text"),
    ('<img src="there.png">', "alternative text"),
    ("![A map](missing.png)", "image.not_readable"),
    ("[Page](missing.md)", "missing.md"),
    ("[Section](#no-heading)", "no-heading"),
]
"""Content of pages with an error, and a part of the expected warning."""


def build_page(folder: Path, content: str) -> subprocess.CompletedProcess[str]:
    """Build a page with this content and the heading `Probe`."""
    pytest.importorskip("myst_parser", reason="myst_parser is missing: pip install --group docs")
    (folder / "there.png").write_bytes((DOCS / "floor_plan.png").read_bytes())
    (folder / "index.md").write_text(f"# Probe\n\n{content}\n")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "-n",
        "-q",
        "-C",
        "-b",
        "dummy",
        str(folder),
        str(folder / "built"),
    ]
    command += ["-D", "extensions=myst_parser,extensions.alt_texts", "-D", "myst_heading_anchors=3"]
    environment = {**os.environ, "PYTHONPATH": str(DOCS)}
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, env=environment)


@pytest.mark.parametrize(("content", "expected"), BROKEN)
def test_docs_build_broken_link_or_image_fails(tmp_path: Path, content: str, expected: str) -> None:
    built = build_page(tmp_path, content)
    assert built.returncode == 1
    assert expected in built.stderr


def test_docs_build_correct_links_and_images_pass(tmp_path: Path) -> None:
    built = build_page(tmp_path, '![A map](there.png) [Section](#probe) <img src="there.png" alt="A map">')
    assert built.returncode == 0, built.stderr


def test_api_reference_has_all_public_names(built: Path) -> None:
    page = (built / "api.html").read_text()
    assert not [name for name in instancemap.__all__ if f'id="instancemap.{name}"' not in page]
    assert "(H, W) m along z, 0 = no reading" in page  # comment of a field


def test_configuration_reference_has_all_parameters(built: Path) -> None:
    for stage in GROUPS:
        page = (built / "configuration" / f"{stage}.html").read_text()
        assert not [name for name in option_names(stage) if f'id="{stage}-{name.replace("_", "-")}"' not in page]
    page = html.unescape((built / "configuration" / "refiner.html").read_text())
    for option in registered("refiner"):
        assert option.parameters or option.name in ("identity", "ground_truth")
        for parameter in option.parameters:
            assert f"refiner.{parameter.name}</span>" in page
            assert parameter.comment in page
    assert "seed of all random numbers of a run" in (built / "configuration.html").read_text()


def test_configuration_reference_has_all_experiment_rows(built: Path) -> None:
    page = (built / "configuration.html").read_text()
    experiments = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
    assert experiments
    for name in experiments:
        rows = composition.composed(f"experiment={name}", "row=any").rows
        entry = page.partition(f">experiment={name}</span>")[2].partition("</dd>")[0]
        assert rows
        assert not [row for row in rows if f">{row}</span>" not in entry], name


def test_own_data_page_has_all_recording_formats(built: Path) -> None:
    page = (built / "tutorials" / "own_data.html").read_text()
    assert not [kind.name for kind in FORMATS if f">{kind.name}</span>" not in page]


OF_TUTORIALS = {"color_blobs", "nearby", "my_refiner", "nearest_points", "saturated_regions"}  # plugins of the reader


def test_page_plugins_and_parameters_exist(built: Path) -> None:
    """Options `fuser=NAME` and parameters `fuser.parameter` must be in the configuration reference."""
    text = "\n".join(PAGES.values())
    for stage in GROUPS:
        reference = (built / "configuration" / f"{stage}.html").read_text()
        chosen = set(re.findall(rf"(?<![\w.@]){stage}=([a-z]\w*)", text)) - OF_TUTORIALS
        assert len(chosen) > {"viewer": 0, "masking": 1, "backend": 0}.get(stage, 2)
        assert not [name for name in chosen if f'id="{stage}-{name.replace("_", "-")}"' not in reference]
        given = set(re.findall(rf"(?<![\w./:(]){stage}\.([a-z]\w*)\b(?![.(])", text)) - {"hue", "scene"}
        assert not [name for name in given if f"{stage}.{name}</span>" not in reference]


def test_pages_load_no_external_resources(built: Path) -> None:
    for page in built.rglob("*.html"):
        asked = re.findall(r'<(?:script|link|img|iframe)\b[^>]*?(?:src|href)="(?:https?:)?//[^"]*"', page.read_text())
        assert not asked, page.name
    assert "<math" in (built / "method.html").read_text()


@pytest.mark.parametrize(("command", "name"), [("edit", "guides/editing"), ("export", "exports")])
def test_argument_table_has_options_of_help(built: Path, command: str, name: str) -> None:
    words = [sys.executable, "-m", "framework", command, "--help"]
    helped = subprocess.run(words, cwd=CHECKOUT, capture_output=True, text=True, check=True, timeout=60).stdout
    options = set(re.findall(r"^  (--[a-z-]+)", helped, re.MULTILINE)) - {"--config-dir"}
    assert len(options) > 4
    page = re.sub(r"<[^>]+>", "", (built / f"{name}.html").read_text())
    assert not [option for option in options if option not in page]


def test_table_settings_are_documented(built: Path) -> None:
    page = re.sub(r"<[^>]+>", "", (built / "guides" / "comparing_runs.html").read_text())
    assert not [setting.name for setting in fields(TableChoice) if f"table.{setting.name}" not in page]
    assert "KEYs that define the pairs" in page  # comment on the line above the field


def test_project_files_are_pages_with_valid_links(built: Path) -> None:
    for name in ("changelog", "contributing", "security", "desk", "guides/maskrcnn2go"):
        page = (built / f"{name}.html").read_text()
        assert len(page) > 10_000
        for target in re.findall(r'<a class="reference (?:internal|download internal)"[^>]*? href="([^"#]+)', page):
            assert (built / name).parent.joinpath(target).resolve().exists(), (
                f"{name}: expected an existing file, got {target}"
            )


def test_citation_file_has_required_keys() -> None:
    """The keys are required by Citation File Format 1.2.0."""
    citation = yaml.safe_load((CHECKOUT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert str(citation["version"]) == __version__
    assert f"\n## {__version__} - {citation['date-released']}\n" in (CHECKOUT / "CHANGELOG.md").read_text()
    assert {"message", "title", "authors"} <= set(citation)
    for work in [citation, *citation["references"]]:
        assert {"title", "type", "authors"} <= set(work)
        assert all("name" in author or "family-names" in author for author in work["authors"])
    page = PAGES["docs/citing.md"]
    [paper] = citation["references"]
    for message in (__version__, str(paper["year"]), paper["journal"], str(paper["number"]), paper["url"]):
        assert message in page


def test_dockerfile_matches_project_files() -> None:
    """The image is not built. The copied files must exist, and the packages must be those of the Makefile."""
    dockerfile = (CHECKOUT / "docker" / "Dockerfile").read_text().replace("\\\n", " ")
    steps = re.findall(r"^([A-Z]+) (.*)", dockerfile, re.MULTILINE)
    copied = {source for step, words in steps if step == "COPY" for source in words.split()[:-1]}
    assert copied >= {"framework", "plugins", "conf", "pyproject.toml"}
    assert not [source for source in copied if not (CHECKOUT / source).exists()]
    sent = set(re.findall(r"^!(.*)", (CHECKOUT / ".dockerignore").read_text(), re.MULTILINE))
    assert copied == sent
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    assert {project["readme"], project["license-files"][0]} <= copied  # files that pip reads
    [(_, entrypoint)] = [step for step in steps if step[0] == "ENTRYPOINT"]
    assert set(json.loads(entrypoint)) <= set(project["scripts"])
    makefile = (CHECKOUT / "Makefile").read_text()
    libraries = set(re.findall(r"missing (lib[\w.-]+)", makefile))
    assert len(libraries) > 3
    assert libraries <= set(dockerfile.split())
    assert re.findall(r"torch==[\d.]+", makefile) == re.findall(r"torch==[\d.]+", dockerfile)
    # does not run as root
    assert [step for step, _ in steps].index("USER") < [step for step, _ in steps].index("ENTRYPOINT")
