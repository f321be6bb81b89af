"""`python -m framework doctor`: what of the things that InstanceMap can use is there, and what gets the rest.

Imports nothing but the standard library and framework.doctor: whatever else is broken, this is to say so.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict

from framework.doctor.check_result import Section, State
from framework.doctor.examination import examined

LEGEND = "ok: there; --: not there, and optional; !!: a run with the default stages needs it"


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Says what is there of what InstanceMap can use, and gives the line that gets what is not."
        " What it prints can be pasted into an issue: the user's name and home are left out. The status is 1 where a"
        " run with the default stages cannot work.",
    )
    parser.add_argument("--json", action="store_true", help="as JSON, for programs")
    asked = parser.parse_args([word for word in sys.argv[1:] if not word.startswith("debug=")])
    sections = examined()
    broken = [finding for section in sections for finding in section.findings if finding.state is State.BROKEN]
    print(as_json(sections) if asked.json else as_text(sections), flush=True)
    if broken:
        sys.exit(1)


def as_text(sections: list[Section]) -> str:
    """A line a finding, and beneath it the line that gets what is missing."""
    lines = []
    broken = 0
    for section in sections:
        lines.append(section.title)
        width = max((len(finding.name) for finding in section.findings), default=0)
        for finding in section.findings:
            lines.append(f"  {finding.state.value}  {finding.name:<{width}}  {finding.detail}".rstrip())
            if finding.remedy:
                lines.append(f"      {'':<{width}}  > {finding.remedy}")
            broken += finding.state is State.BROKEN
        lines.append("")
    lines.append(LEGEND)
    lines.append(
        f"{broken} of what the default stages need {'is' if broken == 1 else 'are'} not as it must be: see !! above"
        if broken
        else "All that the default stages need is there."
    )
    return "\n".join(lines).encode("ascii", "backslashreplace").decode()


def as_json(sections: list[Section]) -> str:
    """[{"title", "findings": [{"name", "state", "detail", "remedy"}]}]"""
    listed = [
        {"title": of.title, "findings": [asdict(one) | {"state": one.state.name.lower()} for one in of.findings]}
        for of in sections
    ]
    return json.dumps(listed, indent=2)
