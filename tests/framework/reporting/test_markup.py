"""Tests for the markup of pages. Values must be escaped, and scripts are restricted."""

from __future__ import annotations

import json
import re

from framework.reporting import markup

HOSTILE = "</script><script>alert(1)</script><!-- & \"'"


def hostile_page() -> str:
    context = {"heading": HOSTILE, "runs": [(HOSTILE, HOSTILE, HOSTILE)], "run_colors": 6, "notices": [HOSTILE]}
    context |= {"shown": [HOSTILE], "likely": 0.3, "tables": [], "paths": ""}
    return markup.page("comparison.html", HOSTILE, context, {"name": HOSTILE, "more": [1.5, None]}, ["H4sI"])


def test_page_escapes_malicious_values() -> None:
    page = hostile_page()
    assert page.count("<script>") == 1
    assert "<script>alert" not in page
    assert 'href="&lt;/script&gt;' in page
    assert "<title>&lt;/script&gt;" in page


def test_page_data_is_json_without_markup() -> None:
    [written] = re.findall(r'id="report-data">(.*?)</script>', hostile_page())
    assert not {"<", ">", "&"} & set(written)
    assert json.loads(written) == {"name": HOSTILE, "more": [1.5, None]}


def test_page_policy_allows_only_its_scripts() -> None:
    [policy] = re.findall(r'Content-Security-Policy" content="([^"]*)"', hostile_page())
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'sha256-")
    assert "unsafe" not in policy
    assert "http" not in policy
