"""Notes below a table: computation of the metrics, provenance, and missing runs."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from framework.evaluation.instances import MAX_DISTANCE
from framework.registry import STAGES
from framework.runs.metrics import is_evaluation
from framework.runs.run_rows import CHOICE, Run, following
from framework.runs.stored_runs import Record, is_number
from framework.tables.comparison import ComparisonTable, mean_by_sequence
from framework.tables.layouts import head
from framework.tables.statistics import ALPHA


def notes(comparison: ComparisonTable) -> Iterator[str]:
    """Yield the notes, one line each."""
    for note in _notes(comparison):
        yield " ".join(note.split())


def _notes(comparison: ComparisonTable) -> Iterator[str]:
    yield from _averaging(comparison)
    yield from comparison.statistics.notes()
    yield from _winners(comparison)
    if comparison.left_out:
        yield f"Omitted columns without values: {_with_needs(comparison.left_out)}."
    if comparison.overrides:
        changes = (f"{name}: {' '.join(changes) or 'none'}" for name, changes in comparison.overrides.items())
        yield f"Overrides of each row: {'; '.join(changes)}."
    if fixed := _same(comparison.records):
        yield f"Common to all runs: {fixed}."
    yield from _protocol(comparison)
    yield from _published(comparison)
    yield f"Data: {data(comparison.records)}."
    yield f"Code: {counted(record.code for record in comparison.records)}."
    yield f"Machine: {counted(machine(record) for record in comparison.records)}."
    yield f"Config: config.yaml of each run; SHA-256 of all config hashes: {digest(comparison.records)}."
    yield from _missing(comparison)


def _averaging(comparison: ComparisonTable) -> Iterator[str]:
    """Yield notes about the means and the comparison of rows."""
    choice, over = comparison.choice, ", ".join(comparison.choice.average_over)
    if others := following(comparison.records, choice.average_over):
        yield f"Also averaged over keys whose value equals that of {over} in every run: {', '.join(others)}."
    if choice.split_key:
        yield (
            f"Cells: mean ± sample standard deviation over {over}. mean: average of the sequences "
            f"({choice.split_key}) with equal weights; its deviation is over the runs with all sequences. "
            "Bold: highest value for the same poses and number of runs. missing: no complete run."
        )
    else:
        yield f"Cells: mean ± sample standard deviation over {over}. runs: number of complete runs."
    if not comparison.has_base:
        yield f"No differences: the baseline {comparison.base_name} has no complete run; set table.baseline=ROW."
    elif len(comparison.rows) > 1:
        keys = [*choice.average_over, *filter(None, [choice.split_key])]
        error = "mean ± standard error"
        if len(keys) > 1:
            kinds = "the sequences" if choice.split_key else f"the values of {keys[-1]}"
            error += f" over {kinds}, after averaging the runs of each"
        yield (
            f"Differences are paired by {', '.join(keys)}: {error}. "
            f"*: p < {ALPHA:.2g} in a paired t-test with Holm's correction."
        )
        bases = [base for _, base in comparison.compared]
        if alone := [row.name for row in comparison.rows if not (comparison.base_of(row) or row in bases)]:
            yield f"Rows without a matching row of {comparison.base_name}: {'; '.join(alone)}."


def _with_needs(columns: Sequence[str]) -> str:
    """Return the headings of metrics, each with the ground truth that it requires."""
    heads: dict[str, list[str]] = {}
    for key in columns:
        what = "instances" if is_evaluation(key) else "poses" if key.startswith("trajectory.") else ""
        heads.setdefault(f" (only with ground-truth {what})" if what else "", []).append(head(key))
    return "; ".join(f"{', '.join(names)}{needs}" for needs, names in heads.items())


def _winners(comparison: ComparisonTable) -> Iterator[str]:
    """Yield, for each row, the numbers of sequences in which the baseline has a higher and a lower value."""
    if not comparison.choice.columns_by:
        return
    [key] = comparison.choice.columns
    for row, base in comparison.compared:
        means = mean_by_sequence(base.differences(row, key))
        lost = [sequence for sequence in comparison.sequences if sequence in means and means[sequence].value < 0]
        won = sum(mean.value > 0 for mean in means.values())
        yield (
            f"{comparison.base_called} compared with {comparison.called(row, without='tracker')}, {row.poses}: "
            f"higher in {won} of {len(means)} sequences, lower in {len(lost)}{': ' + ', '.join(lost) if lost else ''}."
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
    if True in kinds:
        yield f"Label transfer, to map: each map vertex gets the instance of the nearest ground-truth vertex {near}."


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
    keys = [*comparison.choice.average_over, *filter(None, [comparison.choice.split_key])]
    for row, missing in comparison.missing():
        yield f"Missing in {row.name}: {_as_overrides(keys, missing)}."
    if comparison.superseded:
        yield f"Omitted older records of the same runs: {comparison.superseded}."
    for one in comparison.incomplete:
        yield f"Incomplete: {one.directory.relative_to(comparison.root)}: {one.reason.rstrip('.')}."


def _as_overrides(keys: Sequence[str], runs: Sequence[Run]) -> str:
    """Return the runs as overrides: seed=0 dataset.scene=011,030; seed=1 dataset.scene=011."""
    last: dict[Run, list[str]] = {}
    for run in runs:
        last.setdefault(run[:-1], []).append(run[-1])
    versions = [zip(keys, (*first, ",".join(values)), strict=True) for first, values in last.items()]
    return "; ".join(" ".join(f"{key}={value}" for key, value in pairs) for pairs in versions)


def _same(records: Sequence[Record]) -> str:
    """Return the options that all runs have in common, by stage."""
    chosen = {stage: {record.metrics.get(f"{CHOICE}{stage}") for record in records} for stage in STAGES}
    agreed = {stage: names for stage, names in chosen.items() if len(names) == 1 and None not in names}
    return ", ".join(f"{stage}={names.pop()}" for stage, names in agreed.items())


def data(records: Sequence[Record]) -> str:
    """Return the datasets with their annotation releases, and the range of frame counts."""
    names = (
        f"{record.metrics.get(f'{CHOICE}dataset')}{record.annotation and f', annotation {record.annotation}'}"
        for record in records
    )
    frames = sorted(number for record in records if is_number(number := record.metrics.get("frames")))
    lengths = dict.fromkeys(f"{number:g}" for number in frames[:1] + frames[-1:])
    return f"dataset={counted(names)}" + (f"; {' to '.join(lengths)} frames per run" if frames else "")


def machine(record: Record) -> str:
    """Return the number of cores, the processor and the number of threads."""
    cores = f"{record.metrics.get('environment.cpus')} cores of {record.metrics.get('environment.processor')}"
    threads = record.config.get("threads")
    return f"{cores}, threads={threads}" if threads else cores


def counted(words: Iterable[str]) -> str:
    """Return the distinct words, each with its number of runs if there are several words."""
    counts = Counter(words).most_common()
    if len(counts) == 1:
        return counts[0][0]
    return ", ".join(f"{word} ({count} run{'s' * (count > 1)})" for word, count in counts)


def digest(records: Sequence[Record]) -> str:
    """Return one short hash of the configs of several runs, independent of their order."""
    hashes = sorted(str(record.metrics["config_hash"]) for record in records)
    return hashlib.sha256("".join(hashes).encode()).hexdigest()[:12]
