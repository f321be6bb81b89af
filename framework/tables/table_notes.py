"""Notes below a table: computation of the metrics, provenance, and missing runs."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from framework.evaluation.instances import MAX_DISTANCE
from framework.registry import STAGES
from framework.runs.metrics import LABEL_SPACE, ignored_names, is_evaluation
from framework.runs.plugin_code import CODE
from framework.runs.run_rows import DATA, Run, RunRow, dependent_keys
from framework.runs.stored_runs import Record, is_number
from framework.tables.comparison import ComparisonTable, as_text
from framework.tables.metric_columns import Direction, direction, head
from framework.tables.statistics import ALPHA

OF_RESULTS = (
    "instances.",
    "panoptic.",
    "semantic.",
    "trajectory.",
    "map.",
    "frames",
)  # prefixes of metrics that do not depend on the machine
UNCHANGED = "names unchanged"  # evaluation without conversion of names
MOST_NAMES = 12  # maximum number of sequences that a note names


def notes(comparison: ComparisonTable) -> Iterator[str]:
    """Yield the notes, one line each."""
    for note in _notes(comparison):
        yield " ".join(note.split())


def _notes(comparison: ComparisonTable) -> Iterator[str]:
    yield from _averaging(comparison)
    yield from _comparing(comparison)
    yield from comparison.statistics.notes()
    yield from _identical(comparison)
    yield from _winners(comparison)
    if comparison.left_out:
        yield f"Omitted columns without values: {_with_needs(comparison.left_out)}."
    if comparison.overrides:
        changes = (f"{name}: {' '.join(changes) or 'none'}" for name, changes in comparison.overrides.items())
        yield f"Overrides of each row: {'; '.join(changes)}."
    if comparison.command_line:
        yield f"Command line: {' '.join(comparison.command_line)}."
    yield from _imported(comparison)
    if fixed := common_options(comparison.records):
        has_imported = any(record.is_imported for record in comparison.records)
        yield f"Common to all runs{' of InstanceMap' if has_imported else ''}: {fixed}."
    yield from _protocol(comparison)
    yield from _published(comparison)
    yield f"Data: {data(comparison.records)}."
    if known := [str(space) for record in comparison.records if (space := record.metrics.get("label_space"))]:
        yield f"Map label space: {counted(known)}."
    yield f"Code: {counted(record.code for record in comparison.records)}."
    yield from _mixed_code(comparison)
    if used := machines(comparison.records):
        yield f"Machine: {used}."
    yield f"Config: config.yaml of each run; SHA-256 of all config hashes: {digest(comparison.records)}."
    yield from _missing(comparison)


def _imported(comparison: ComparisonTable) -> Iterator[str]:
    """Yield a note about the rows of imported maps."""
    rows = [row for row in comparison.rows if any(record.is_imported for record in row.records.values())]
    if rows:
        names = "; ".join(
            f"{row.name} from {counted(str(record.metrics.get('external.mesh')) for record in row.records.values())}"
            for row in rows
        )
        yield f"Imported maps of other systems, without run times and trajectories: {names}."


def _averaging(comparison: ComparisonTable) -> Iterator[str]:
    """Yield notes about the runs in the table and their means."""
    choice, over = comparison.choice, ", ".join(comparison.choice.average_over)
    if choice.conditions:
        yield f"Only runs with {as_text(choice.conditions)}."
    if others := dependent_keys(comparison.records, choice.averaged, comparison.asked):
        yield f"Also averaged over keys that depend on {', '.join(choice.averaged)}: {', '.join(others)}."
    spread = f"mean ± sample standard deviation over {over}, without ± for equal values"
    if not choice.split_key:
        yield f"Cells: {spread}. runs: number of complete runs."
        return
    yield (
        f"Cells: {spread}. mean: average over {choice.split_key} with equal weights; its standard deviation is over "
        f"the runs with all values of {choice.split_key}. {_bold(choice.columns)} missing: no complete run."
    )


def _bold(columns: Sequence[str]) -> str:
    """Return the meaning of bold cells."""
    of = {better: [head(key) for key in columns if direction(key) is better] for better in Direction}
    parts = [f"{word} {', '.join(of[better])}" for better, word in _BEST if of[better]]
    if not parts:
        return ""
    return f"Bold: {'; '.join(parts)} for the same poses and number of runs, unless several rows have it."


_BEST = ((Direction.HIGHER, "highest"), (Direction.LOWER, "lowest"))


def _comparing(comparison: ComparisonTable) -> Iterator[str]:
    """Yield notes about the differences between rows."""
    choice = comparison.choice
    if not comparison.has_base:
        yield f"No differences: the base {comparison.base_name} has no complete run; set table.base=ROW."
    elif not comparison.compared:
        if len(comparison.rows) > 1:
            yield "No differences: no two rows have the same data."
    else:
        error, units = "mean ± standard error", ", ".join(choice.units)
        keys = ", ".join(choice.pair_by or choice.averaged)
        if choice.units != choice.averaged:
            error += f" over {units}, after averaging the runs of each"
        yield (
            f"Differences are paired by {keys}: {error}. pairs: number of values of {units} in both rows. "
            f"*: p < {ALPHA:.2g} in a paired t-test with Holm's correction."
        )
        paired = {one.name for pair in comparison.compared for one in pair}
        if alone := [row.name for row in comparison.rows if row.name not in paired]:
            yield f"Rows without a matching base row ({comparison.base_called}): {'; '.join(alone)}."


def _identical(comparison: ComparisonTable) -> Iterator[str]:
    """Yield notes about averaged keys and rows without an effect on the results."""
    for k, key in enumerate(comparison.choice.averaged):
        if rows := [comparison.called(row) for row in comparison.rows if _has_no_effect(row, k)]:
            yield f"Identical runs: the results do not depend on {key} in {'; '.join(rows)}."
    for row, base in comparison.compared:
        runs = row.records.keys() & base.records.keys()
        if runs and all(_results(row.records[run]) == _results(base.records[run]) for run in runs):
            yield f"Identical rows: the results of {comparison.called(row)} equal those of {base.name}."


def _has_no_effect(row: RunRow, place: int) -> bool:
    """Return True if runs that differ only in one averaged key have equal results, and there are such runs."""
    groups: dict[Run, list[dict[str, Any]]] = {}
    for run, record in row.records.items():
        groups.setdefault((*run[:place], *run[place + 1 :]), []).append(_results(record))
    several = [results for results in groups.values() if len(results) > 1]
    return bool(several) and all(one == results[0] for results in several for one in results)


def _results(record: Record) -> dict[str, Any]:
    """Return the metrics that do not depend on the machine."""
    return {key: value for key, value in record.metrics.items() if key.startswith(OF_RESULTS)}


def _with_needs(columns: Sequence[str]) -> str:
    """Return the headings of metrics, each with the ground truth that it requires."""
    heads: dict[str, list[str]] = {}
    for key in columns:
        what = "instances" if is_evaluation(key) else "poses" if key.startswith("trajectory.") else ""
        heads.setdefault(f" (only with ground-truth {what})" if what else "", []).append(head(key))
    return "; ".join(f"{', '.join(names)}{needs}" for needs, names in heads.items())


def _winners(comparison: ComparisonTable) -> Iterator[str]:
    """Yield, for each row, the numbers of sequences in which the base has a higher and a lower value."""
    if not comparison.choice.columns_by:
        return
    [key] = comparison.choice.columns
    for row, base in comparison.compared:
        found = comparison.difference_by_sequence(base, row, key)
        lost = [sequence for sequence in comparison.sequences if found.get(sequence, 0) < 0]
        won = sum(difference > 0 for difference in found.values())
        yield (
            f"{comparison.base_called} compared with {comparison.called(row, without='tracker')}, {row.poses}: "
            f"higher in {won} of {len(found)} sequences, lower in {len(lost)}{': ' + ', '.join(lost) if lost else ''}."
        )


def _protocol(comparison: ComparisonTable) -> Iterator[str]:
    """Yield notes about the comparison of the instances with the ground truth."""
    kinds = {key.startswith("instances.to_map.") for key in comparison.choice.columns if is_evaluation(key)}
    if not kinds:
        return
    near = f"within {MAX_DISTANCE * 100:.0f} cm"
    if False in kinds:
        yield (
            f"Label transfer: each ground-truth vertex gets the instance of the nearest map vertex {near}. "
            "AP is in [0, 1]."
        )
    spaces = [record.metrics.get(LABEL_SPACE) for record in comparison.records]
    if any(spaces):
        yield f"Evaluation label space: {counted(str(space or UNCHANGED) for space in spaces)}."
    if ignored := [text for text in map(_ignored, comparison.records) if text]:
        yield f"Ignored objects: {counted(ignored)}."
    if True in kinds:
        yield f"Label transfer, to map: each map vertex gets the instance of the nearest ground-truth vertex {near}."


def _ignored(record: Record) -> str:
    """Return the names of the objects that an evaluation ignored because of their classes."""
    return "; ".join(f"{side}: {names}" for side, names in ignored_names(record.metrics))


def _published(comparison: ComparisonTable) -> Iterator[str]:
    if comparison.choice.published and not comparison.is_of_scenenn:
        yield "Published numbers are for the original SceneNN data (sequences=scenenn) and omitted for other data."
    for row in comparison.published_rows:
        yield f"Published, {row.system}: {row.source}{f'; {row.remark}' if row.remark else ''}."
    if unknown := [f"{row.system} ({row.source})" for row in comparison.published_unknown]:
        yield f"Published results not looked up: {'; '.join(unknown)}."


def _missing(comparison: ComparisonTable) -> Iterator[str]:
    """Yield the metrics, rows, sequences and runs without a result, and the incomplete runs."""
    known_keys = {key for record in comparison.records for key in record.metrics}
    if absent := [key for key in comparison.choice.columns if key not in known_keys]:
        yield f"Metrics in no run: {', '.join(absent)}."
    begun = {row.system for row in comparison.rows}
    if absent := [name for name in comparison.overrides if name not in begun]:
        yield f"Rows without a complete run: {', '.join(absent)}."
    run_of = {run[-1] for row in comparison.rows for run in row.records}
    if absent := [sequence for sequence in comparison.sequences if sequence not in run_of]:
        yield f"Sequences without a complete run: {comparison.choice.split_key}={','.join(absent)}."
    keys = comparison.choice.averaged
    for row, missing in comparison.missing():
        yield f"Missing in {row.name}: {_as_overrides(keys, missing)}."
    if comparison.superseded:
        yield f"Omitted older records of the same runs: {comparison.superseded}."
    for one in comparison.incomplete:
        yield f"Incomplete: {one.directory.relative_to(comparison.root)}: {one.reason.rstrip('.')}."


def _mixed_code(comparison: ComparisonTable) -> Iterator[str]:
    """Yield a note for each row whose runs have different code of the same option."""
    for row in comparison.rows:
        records = row.records.values()
        codes: dict[tuple[str, str | None], list[str]] = {}  # by stage and its option
        for key in sorted({key for record in records for key in record.metrics if key.startswith(CODE)}):
            stage = key.removeprefix(CODE)
            for record in records:
                codes.setdefault((stage, record.choices.get(stage)), []).append(str(record.metrics.get(key)))
        if mixed := [f"{stage} {counted(found)}" for (stage, _), found in codes.items() if len(set(found)) > 1]:
            yield f"Mixed plugin code in {row.name}: {'; '.join(mixed)}; repeat its runs with skip_completed=true."


def _as_overrides(keys: Sequence[str], runs: Sequence[Run]) -> str:
    """Return the runs as overrides: seed=0 dataset.scene=011,030; seed=1 dataset.scene=011."""
    last: dict[Run, list[str]] = {}
    for run in runs:
        last.setdefault(run[:-1], []).append(run[-1])
    versions = [zip(keys, (*first, ",".join(values)), strict=True) for first, values in last.items()]
    return "; ".join(" ".join(f"{key}={value}" for key, value in pairs) for pairs in versions)


def common_options(records: Sequence[Record]) -> str:
    """Return the config options that all runs have in common, as stage=option. Imported maps are ignored."""
    mapped = [record for record in records if not record.is_imported]
    chosen = {stage: {record.choices.get(stage) for record in mapped} for stage in STAGES}
    agreed = {stage: names for stage, names in chosen.items() if len(names) == 1 and None not in names}
    return ", ".join(f"{stage}={names.pop()}" for stage, names in agreed.items())


def data(records: Sequence[Record]) -> str:
    """Return the datasets with their folders and annotation releases, the sequences, and the range of frame counts."""
    names = (
        record.choices.get("dataset", "unknown")
        + (f" in {root}" if (root := record.parameters.get(DATA)) else "")
        + (f", annotation {record.annotation}" if record.annotation else "")
        for record in records
    )
    parts = [f"dataset={counted(names)}"]
    sequences = dict.fromkeys(str(record.metrics["sequence"]) for record in records if "sequence" in record.metrics)
    if sequences:
        shown = ", ".join(list(sequences)[:MOST_NAMES])
        parts.append(f"sequences {shown}" + (f" and {more} more" if (more := len(sequences) - MOST_NAMES) > 0 else ""))
    frames = sorted(number for record in records if is_number(number := record.metrics.get("frames")))
    lengths = dict.fromkeys(f"{number:g}" for number in frames[:1] + frames[-1:])
    return "; ".join(parts + ([f"{' to '.join(lengths)} frames per run"] if frames else []))


def machines(records: Sequence[Record]) -> str:
    """Return the machines of the runs, or "" if all are imported maps, whose machines are unknown."""
    mapped = [machine(record) for record in records if not record.is_imported]
    return counted(mapped) if mapped else ""


def machine(record: Record) -> str:
    """Return the number of cores, the processor and the number of threads."""
    cores = f"{record.metrics.get('environment.cpus')} cores of {record.metrics.get('environment.processor')}"
    threads = record.config.get("threads")
    return f"{cores}, threads={threads}" if threads else cores


def counted(words: Iterable[str]) -> str:
    """Return the distinct texts, each with its number of runs if there are several."""
    counts = Counter(words).most_common()
    if len(counts) == 1:
        return counts[0][0]
    return ", ".join(f"{word} ({count} run{'s' * (count > 1)})" for word, count in counts)


def digest(records: Sequence[Record]) -> str:
    """Return 12 hexadecimal digits of the hash of the configs of several runs, independent of their order."""
    hashes = sorted(str(record.metrics["config_hash"]) for record in records)
    return hashlib.sha256("".join(hashes).encode()).hexdigest()[:12]
