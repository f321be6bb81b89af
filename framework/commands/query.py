"""`python -m framework query RUN "a red chair"`: which objects of a stored run are meant."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from framework.commands.command_line import arguments, one_line_errors
from framework.errors import DataError
from framework.files.whole_files import is_there
from framework.files.yaml_file import load_yaml
from framework.object_queries import Map
from framework.object_search import Found, by_embedding, by_names
from framework.records.stored_runs import CONFIG

LONGEST_QUERY = 1000  # characters
WITH_EMBEDDINGS = "detector=with_embeddings, or detector=room_words in synthetic rooms"


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Ranks the objects of a stored run by how well words fit them: by the embeddings of their pictures "
        f"where the run has any ({WITH_EMBEDDINGS}), else by class names and the colours of their surfaces.",
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="the directory of a run")
    parser.add_argument("text", metavar="WORDS", help='what is looked for: "a red chair"')
    parser.add_argument("--top", metavar="N", type=int, default=5, help="how many objects to list (default: 5)")
    parser.add_argument("--by", choices=("embeddings", "names"), help="by what (default: embeddings where there are)")
    parser.add_argument("--model", help="that embeds the words (default: that of the run's detector)")
    parser.add_argument("--json", action="store_true", help="print it for programs")
    asked = arguments(parser)
    if asked.top < 1:
        parser.error(f"--top must be at least 1, found {asked.top}")
    if asked.model and asked.by == "names":
        parser.error("--model is of embeddings, and --by names asks for none")
    if not 0 < len(asked.text.strip()) <= LONGEST_QUERY:
        parser.error(f"WORDS must be 1 to {LONGEST_QUERY} characters")
    with one_line_errors():
        from framework.api import scene_of  # here: what is wrong with the arguments is said at once

        scene = Map(scene_of("query", asked.run))
        space = scene.scene.embedding_space
        by = asked.by or ("embeddings" if space or asked.model else "names")
        found = by_names(scene, asked.text) if by == "names" else embedded(scene, asked.run, asked.text, asked.model)
        shown = found[: asked.top]
        if asked.json:
            entries = [entry(one) for one in shown]
            print(json.dumps({"query": asked.text, "by": by, "space": space or None, "objects": entries}, indent=1))
            return
        print(
            f"by {'class names and colours' if by == 'names' else f'embeddings of {space}'}{why(by, asked.by, space)}"
        )
        print(
            table(shown, "similarity" if by == "embeddings" else "match")
            if shown
            else f"nothing in this map is {asked.text!r}"
        )


def why(by: str, wanted: str | None, space: str) -> str:
    """Why names were taken, where nobody asked for them."""
    if by == "names" and wanted is None and not space:
        return f", for this run has no embeddings: run with {WITH_EMBEDDINGS}"
    return ""


def embedded(scene: Map, run: Path, text: str, model: str | None) -> list[Found]:
    """The objects by the model that their embeddings are of. Raises DataError where there is none or it is another."""
    from framework.detection.image_text import open_image_text

    space = scene.scene.embedding_space
    if not space:
        raise DataError(f"{run} has no embeddings: run with {WITH_EMBEDDINGS}, or ask with --by names")
    name, revision = model_of(run) if model is None else (model, "main")
    opened = open_image_text(name, revision, "cpu", half=False)
    if opened.space != space:
        raise DataError(
            f"the embeddings of {run} are of {space}, and {name} is {opened.space}; name the model by --model"
        )
    return by_embedding(scene, opened.embed_text(text))


def model_of(run: Path) -> tuple[str, str]:
    """The model and the revision that a run's detector was made with. Raises DataError where its config has none."""
    config = load_yaml(run / CONFIG) if is_there(run / CONFIG) else None
    node = OmegaConf.to_container(config.detector) if isinstance(config, DictConfig) and "detector" in config else None
    if isinstance(node, dict) and isinstance(node.get("model"), str):
        return node["model"], str(node.get("revision", "main"))
    raise DataError(f"{run / CONFIG} does not say of which model the embeddings are: name it by --model")


def table(found: list[Found], measure: str) -> str:
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


def entry(found: Found) -> dict[str, object]:
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
