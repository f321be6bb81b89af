"""`instancemap query RUN "a red chair"`: rank the objects of a stored run by a text query."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.datasets.frames.world_offset import origin_comments, stored_origin
from framework.queries.text_search import BY, WITH_EMBEDDINGS, Match, QueryResult
from framework.runs.stored_runs import has_metrics, read_metrics


def main() -> None:
    """Run the command `instancemap query`."""
    parser = argparse.ArgumentParser(
        description="Rank the objects of a stored run by a text query, using image embeddings if the run used "
        f"{WITH_EMBEDDINGS}, otherwise class names and surface colors."
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="run directory")
    parser.add_argument("text", metavar="QUERY", help='text query, such as "a red chair"')
    parser.add_argument("--top", metavar="N", type=int, default=5, help="number of listed objects; default: 5")
    parser.add_argument("--by", choices=BY, help="ranking method; default: embeddings if available")
    model = "embedding model for the query: id on huggingface.co or folder; default: model of the run's detector"
    parser.add_argument("--model", metavar="MODEL", help=model)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parsed = arguments(parser)
    if parsed.top < 1:
        parser.error(f"--top: expected at least 1, got {parsed.top}")
    with one_line_errors():
        from framework.api import query  # slow import: after the arguments are checked

        answer = query(parsed.run, parsed.text, parsed.by, parsed.model)
        shown = answer.objects[: parsed.top]
        if parsed.json:
            entries = [entry(one) for one in shown]
            space = answer.space or None
            print(json.dumps({"query": parsed.text, "by": answer.by, "space": space, "objects": entries}, indent=1))
            return
        print(heading(answer, parsed.by))
        if shown:
            print(table(shown, "similarity" if answer.by == "embeddings" else "match"))
            if has_metrics(parsed.run):  # otherwise, a directory with only a map
                for line in origin_comments(stored_origin(read_metrics(parsed.run))):
                    print(line)
        else:
            print(f"no object matches {parsed.text!r}")


def heading(answer: QueryResult, wanted: str | None) -> str:
    """Return a line with the ranking method. It suggests embeddings if the run has none."""
    if answer.by == "embeddings":
        return f"by embeddings of {answer.space}"
    unavailable = wanted is None and not answer.space
    reason = f", because this run has no embeddings; run it again with {WITH_EMBEDDINGS}" if unavailable else ""
    return f"by class names and colors{reason}"


def table(found: Sequence[Match], measure: str) -> str:
    """Return the objects as a text table, with lengths in meters."""
    rows = [("id", "class", measure, "confidence", "color", "position", "size")]
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
    """Return a matched object as a JSON object, with lengths in meters."""
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
