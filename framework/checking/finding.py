"""What a check has found out, in a sentence and, where something is wrong, with the parameter that mends it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Verdict(Enum):
    """What a finding means for mapping."""

    FINE = "ok"
    UNKNOWN = "?"  # the recording does not tell
    NOTE = "note"  # it maps, and the result suffers
    FAULT = "WRONG"  # it does not map as it is read


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    verdict: Verdict
    subject: str
    text: str
    setting: str = ""  # what mends it: KEY=VALUE for the command line; "" = no parameter does

    def __str__(self) -> str:
        line = f"{self.verdict.value:<6} {self.subject}: {self.text}"
        return f"{line}; set {self.setting}" if self.setting else line
