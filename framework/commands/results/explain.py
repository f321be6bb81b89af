"""`instancemap explain RUN...`: explain the lost and the false objects of runs."""

from __future__ import annotations

import argparse
import logging
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from framework.commands.command_line import arguments, one_line_errors
from framework.errors import ConfigError, DataError
from framework.runs.stored_runs import Record, check_resolved, completed_runs

if TYPE_CHECKING:
    from framework.explanation.contributions import Contributions, Stage
    from framework.explanation.replay import Explanation
    from framework.pipeline import Pipeline

log = logging.getLogger(__name__)

DIFFERENCE = 1e-6  # difference of the metric between a run and its replay above which a warning is logged

GROUPS = {"detection": "detector", "tracking": "tracker", "refinement": "refiner"}  # config group by stage
TRUE_ASSOCIATION = "GROUND_TRUTH"


def main() -> None:
    """Run the command `instancemap explain`."""
    parser = argparse.ArgumentParser(
        description="List the stage that lost each missed, wrong or split object of a run, and the stage that caused "
        "each false instance. Also list how much each stage contributes to the loss. The sequence is mapped again, up "
        "to 16 times, with stages replaced by the ground truth. Networks run once. The frames need ground-truth "
        "instances."
    )
    parser.add_argument("run", metavar="RUN", nargs="+", type=Path, help="run directory, or folder of run directories")
    metric = "metric of which 1 - METRIC is the loss, a key of metrics.json; default: instances.ap50"
    parser.add_argument("--metric", metavar="METRIC", default="instances.ap50", help=metric)
    parser.add_argument("--all", action="store_true", help="also list found objects and ignored objects")
    once = "map the sequence once: list causes, but no contributions of the stages"
    parser.add_argument("--causes-only", action="store_true", help=once)
    figure = "figure of the contributions with one bar per run; written with the suffixes .png and .pdf"
    parser.add_argument("--figure", metavar="FILE", type=Path, help=figure)
    parsed = arguments(parser)
    if parsed.figure is not None and parsed.causes_only:
        parser.error("--figure: expected contributions of the stages, got --causes-only; omit one of the options")
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        from framework.explanation.contributions import Contributions

        records = [record for root in parsed.run for record in completed_runs(root)[0]]
        found: dict[str, Contributions] = {}
        for record in records:
            explanation = explain_run(record, parsed.metric, not parsed.causes_only)
            print(f"{record.directory}:")
            print("\n".join(lines(explanation, parsed.all)), flush=True)
            if explanation.contributions is not None:
                name = record.directory.name
                found[str(record.directory) if name in found else name] = explanation.contributions
        if len(found) > 1:
            print(
                "\n".join((f"mean of {len(found)} runs:", *contribution_lines(Contributions.mean([*found.values()]))))
            )
        if parsed.figure is not None and found:
            from framework.figures.contribution_figure import contribution_figure

            print(*contribution_figure(found).write(parsed.figure), sep="\n")


def explain_run(record: Record, metric: str = "instances.ap50", with_contributions: bool = True) -> Explanation:
    """Replay a stored run, write its explanation to explanation.json and return it.

    Raises:
        InstanceMapError: The run cannot be replayed, or its sequence has no instance ground truth.
    """
    from framework.evaluation.compared_classes import ComparedClasses
    from framework.explanation.replay import Replays
    from framework.explanation.stored_explanation import write_explanation
    from framework.interfaces import RGBDSequence, RGBDVideo
    from framework.registry import build
    from framework.runtime.process_settings import Settings

    if record.is_imported or record.derived:
        found = record.derived or "an imported map"
        raise DataError(f"{record.directory}: expected a mapped sequence, got {found}; explain the original run")
    check_resolved({**record.config, "dataset": record.dataset})  # with the ground truth named in metrics.json
    video = build(RGBDVideo, OmegaConf.create(dict(record.dataset)))
    if not isinstance(video, RGBDSequence):
        raise ConfigError(f"{record.directory}: expected a run of a sequence, got live video")
    settings = Settings.of(OmegaConf.create(dict(record.config)))
    settings.apply()
    with tempfile.TemporaryDirectory(prefix="instancemap_") as cache, tqdm(unit=" replays", disable=None) as bar:
        factory = partial(pipeline_of, record.config, cache)
        classes, given = ComparedClasses.of(record.config), given_stages(record.config)
        replays = Replays(video, factory, classes, metric, given, bar.update)
        bar.total = replays.count if with_contributions else 1
        explanation = replays.explain(with_contributions)
    stored, value = record.metrics.get(metric), replays.values[frozenset()]
    if stored is None or abs(stored - value) > DIFFERENCE:
        message = "%s: expected %s = %s (as in the run) in the replay, got %s; run `instancemap reproduce`"
        log.warning(message, record.directory, metric, stored, value)
    write_explanation(record.directory, explanation)
    return explanation


def pipeline_of(config: Mapping[str, Any], cache: str, replaced: frozenset[Stage]) -> Pipeline:
    """Build the stages of a run, some of them replaced by the ground truth.

    Args:
        config: The config of the run.
        cache: A folder for detections that several replays share, if the run has no cache.
        replaced: The replaced stages.
    """
    from framework.api import begin

    chosen = with_truth(config, replaced)
    if chosen.detection_cache in (False, "off"):
        chosen.detection_cache, chosen.detection_cache_dir = "read_write", cache
    return begin(chosen)


def with_truth(config: Mapping[str, Any], replaced: frozenset[Stage]) -> DictConfig:
    """Return the config of a run without viewer, in which the ground truth replaces stages.

    The refiner also processes the masks of the true detector, so that its errors are not attributed to the detector.
    """
    from framework.config.composition import composed
    from framework.explanation.contributions import Stage

    groups = [GROUPS[stage] for stage in GROUPS if Stage(stage) in replaced]
    truth = composed("viewer=none", *(f"{group}=ground_truth" for group in groups))
    chosen = OmegaConf.create(dict(config) | {group: truth[group] for group in ("viewer", *groups)})
    if Stage.DETECTION in replaced:
        chosen.detector.exact = False
    if Stage.ASSOCIATION in replaced:
        chosen.fuser.association = TRUE_ASSOCIATION
    return chosen


def given_stages(config: Mapping[str, Any]) -> frozenset[Stage]:
    """Return the stages of a run that are the ground truth."""
    from framework.explanation.contributions import Stage

    truth = with_truth(config, frozenset(Stage))
    given = {Stage(stage) for stage, group in GROUPS.items() if config[group]["_target_"] == truth[group]["_target_"]}
    if config["fuser"].get("association") == TRUE_ASSOCIATION:
        given.add(Stage.ASSOCIATION)
    return frozenset(given)


def lines(explanation: Explanation, with_found: bool) -> list[str]:
    """Return the explanation of a run as lines of text."""
    shown = [one for one in explanation.objects if with_found or one.cause is not None]
    rows = [
        (one.state.value, one.class_name, one.id, one.cause.value if one.cause else "", one.reason) for one in shown
    ]
    rows += [("false", one.class_name, one.id, one.cause.value, one.reason) for one in explanation.false_instances]
    width = max((len(row[1]) for row in rows), default=0)
    text = [f"  {state:<11}  {name:<{width}}  {key:>4}  {cause:<11}  {why}" for state, name, key, cause, why in rows]
    if not text:
        text = ["  no lost object and no false instance"]
    return text + ([] if explanation.contributions is None else contribution_lines(explanation.contributions))


def contribution_lines(contributions: Contributions) -> list[str]:
    """Return contributions to the loss as lines of text."""
    named: Sequence[tuple[str, float]] = list(contributions.named().items())
    width = max(len(name) for name, _ in named)
    head = f"  loss (1 - {contributions.metric})"
    return [f"{head:<{width + 4}}  {contributions.loss:6.3f}", *(f"    {name:<{width}}  {v:6.3f}" for name, v in named)]
