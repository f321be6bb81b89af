"""HTML that nothing from a record can break out of."""

from __future__ import annotations

import json
import re

from framework.reporting import markup, svg

HOSTILE = "</script><script>alert(1)</script><!-- & \"'"


def test_text_and_attributes_are_escaped() -> None:
    written = markup.tag("p", markup.words(HOSTILE), data_name=HOSTILE, hidden=True, title=None)
    assert written.startswith("<p data-name=")
    assert " hidden>" in written
    assert "title" not in written
    assert "<script" not in written
    assert written.count("<") == 2
    assert svg.text(0, 0, HOSTILE).count("<") == 2


def test_json_in_a_page_ends_no_element() -> None:
    written = markup.json_text({"name": HOSTILE, "more": [1.5, None, True]})
    assert not {"<", ">", "&"} & set(written)
    assert json.loads(written) == {"name": HOSTILE, "more": [1.5, None, True]}


def test_the_policy_names_the_scripts_that_may_run_and_nothing_else() -> None:
    page = markup.page(HOSTILE, "<p>body</p>", {"name": HOSTILE}, ["H4sI"])
    assert page.count("<script>") == 1
    [policy] = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'sha256-")
    assert "unsafe" not in policy
    assert "http" not in policy
    assert "<title>&lt;/script&gt;" in page


def test_axes_have_round_numbers() -> None:
    assert svg.ticks(0, 1, 4) == [0.0, 0.5, 1.0]
    assert svg.ticks(0, 130, 4) == [0.0, 50.0, 100.0]
    assert svg.ticks(-0.25, 0.25, 5) == [-0.2, -0.1, 0.0, 0.1, 0.2]
    assert svg.round_step(0, 3) > 0
    assert svg.number(12345.0) == "12\u2009345"
