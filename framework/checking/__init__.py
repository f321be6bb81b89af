"""Checks of a recording before it is mapped."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Verdict(Enum):
    """Effect of a check result on mapping."""

    FINE = "ok"
    UNKNOWN = "?"  # the recording has too little information
    NOTE = "note"  # the recording can be mapped, with worse results
    ERROR = "WRONG"  # the recording cannot be mapped with these settings


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    verdict: Verdict
    subject: str  # checked property, such as "depth"
    text: str  # description in one line
    setting: str = ""  # fix, as KEY=VALUE for the command line; "" = no parameter fixes the problem

    def __str__(self) -> str:
        line = f"{self.verdict.value:<6} {self.subject}: {self.text}"
        return f"{line}; set {self.setting}" if self.setting else line
