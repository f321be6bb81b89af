"""Check of the timestamps of a recording."""

from __future__ import annotations

import numpy as np

from framework.checking import Finding, Verdict
from framework.data import Float64
from framework.datasets.frames.conventions import TIME_UNITS
from framework.datasets.frames.sequence_reader import Recording
from framework.interfaces import RGBDSequence

MAX_GAP = 0.5  # s, maximum interval between frames without a gap, or five times the median interval if larger
RATES = 0.1, 1000.0  # Hz, plausible frame rates
USUAL_RATES = 1.0, 240.0  # Hz, usual frame rates, which identify the unit of the timestamps
SUBJECT = "time"


def check_times(sequence: RGBDSequence) -> list[Finding]:
    """Check the timestamps of a recording. Other sequences and short recordings have no result."""
    if not isinstance(sequence, Recording) or len(sequence) < 3:
        return []
    times: Float64 = np.array([sequence.contents.frames[k].timestamp for k in sequence.chosen])
    steps = np.diff(times)
    usual = float(np.median(steps))
    text = f"{1 / usual:.3g} Hz for {times[-1] - times[0]:.1f} s"
    if not RATES[0] <= 1 / usual <= RATES[1]:
        low, high = RATES
        units = [(unit, name) for unit, name in TIME_UNITS.items() if _is_usual(1 / (usual * unit))]
        if not units:
            return [Finding(Verdict.ERROR, SUBJECT, f"expected a frame rate of {low:g} to {high:g} Hz, got {text}")]
        unit, name = units[0]
        now = sequence.time_unit * unit
        text = f"timestamps are in {name}: expected a frame rate of {low:g} to {high:g} Hz, got {text}"
        return [Finding(Verdict.ERROR, SUBJECT, text, f"dataset.time_unit={now:.3g}")]
    gaps = int((steps > max(MAX_GAP, 5 * usual)).sum())
    if gaps:
        return [Finding(Verdict.NOTE, SUBJECT, f"{text}, with {gaps} gaps of up to {steps.max():.1f} s")]
    return [Finding(Verdict.FINE, SUBJECT, text)]


def _is_usual(rate: float) -> bool:
    return USUAL_RATES[0] <= rate <= USUAL_RATES[1]
