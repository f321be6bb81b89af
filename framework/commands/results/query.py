"""`python -m framework query RUN "a red chair"`: which objects of a stored run are meant."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.queries.text_search import BY, WITH_EMBEDDINGS, Match, QueryResult


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Ranks the objects of a stored run by how well words fit them: by the embeddings of their pictures "
        f"where the run has any ({WITH_EMBEDDINGS}), else by class names and the colours of their surfaces.",
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="the directory of a run")
    parser.add_argument("text", metavar="WORDS", help='what is looked for: "a red chair"')
    parser.add_argument("--top", metavar="N", type=int, default=5, help="how many objects to list (default: 5)")
    parser.add_argument("--by", choices=BY, help="by what (default: embeddings where there are)")
    parser.add_argument("--model", help="that embeds the words (default: that of the run's detector)")
    parser.add_argument("--json", action="store_true", help="print it for programs")
    asked = arguments(parser)
    if asked.top < 1:
        parser.error(f"--top must be at least 1, found {asked.top}")
    with one_line_errors():
        from framework.api import query  # here: what is wrong with the arguments is said at once

        answer = query(asked.run, asked.text, asked.by, asked.model)
        shown = answer.objects[: asked.top]
        if asked.json:
            entries = [entry(one) for one in shown]
            space = answer.space or None
            print(json.dumps({"query": asked.text, "by": answer.by, "space": space, "objects": entries}, indent=1))
            return
        print(heading(answer, asked.by))
        if shown:
            print(table(shown, "similarity" if answer.by == "embeddings" else "match"))
        else:
            print(f"nothing in this map is {asked.text!r}")


def heading(answer: QueryResult, wanted: str | None) -> str:
    """By what it was answered, and why by names where nobody asked for them."""
    if answer.by == "embeddings":
        return f"by embeddings of {answer.space}"
    unasked = wanted is None and not answer.space
    why = f", for this run has no embeddings: run with {WITH_EMBEDDINGS}" if unasked else ""
    return f"by class names and colours{why}"


def table(found: Sequence[Match], measure: str) -> str:
    """For people: lengths in metres."""
    rows = [("id", "class", measure, "confidence", "colour", "position", "size")]
    for one in found:
        x, y, z = one.centroid
        size = " x ".join(f"{side:.2f}" for side in one.instance.obb.extent)
        rows.append(
            (str(one.instance.id), one.name, f"{one.similarity:.3f}", f"{one.instance.confidence:.2f}", one.color,
             f"({x:.2f}, {y:.2f}, {z:.2f})", size)
        )  # fmt: skip
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def entry(found: Match) -> dict[str, object]:
    """For programs: lengths in metres."""
    return {
        "id": found.instance.id,
        "class": found.name,
        "similarity": found.similarity,
        "confidence": float(found.instance.confidence),
        "color": found.color,
        "observations": int(found.instance.observations),
        "embedding_spread": found.instance.embedding_spread,
        "centroid": found.centroid.tolist(),
        "size": found.instance.obb.extent.tolist(),
    }
