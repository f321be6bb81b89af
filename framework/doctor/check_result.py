"""One thing that was looked at, and the sections of them."""

from __future__ import annotations

import getpass
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

REINSTALL = "pip install --force-reinstall instancemap"


class State(Enum):
    """Whether a thing is there. The values are the marks in front of it."""

    THERE = "ok"
    OPTIONAL = "--"  # not there, and only some things need it
    BROKEN = "!!"  # not there, or not as it must be, and a run with the default stages needs it


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    name: str
    state: State
    detail: str  # what was found, in a few words
    remedy: str = ""  # one line that gets what is missing; "" = nothing is, or there is none


@dataclass(frozen=True)
class Section:
    """Findings of one kind."""

    title: str
    findings: tuple[Finding, ...]


def section(title: str, *looks: Callable[[], Iterable[Finding]]) -> Section:
    """What each of these finds; one that fails is a finding itself: others are looked at all the same."""
    findings: list[Finding] = []
    for look in looks:
        try:
            findings += look()
        except Exception as error:  # whatever is broken: to say so is what this is for
            broken = isinstance(error, ImportError)  # what is looked with is needed by every run
            state, remedy = (State.BROKEN, REINSTALL) if broken else (State.OPTIONAL, "")
            findings.append(Finding(look.__name__.strip("_").replace("_", " "), state, reason(error), remedy))
    return Section(title, tuple(findings))


def reason(error: BaseException) -> str:
    """What an error says, in one line without names of people, for others will read it."""
    said = " ".join(str(error).split())
    return anonymous(f"{type(error).__name__}: {said}" if said else type(error).__name__)[:300]


def anonymous(text: str) -> str:
    """The text with the user's home as ~, and without the user's name in other paths."""
    home = str(Path.home())
    if home != "/":
        text = text.replace(home, "~")
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        return text
    return text.replace(f"/{user}/", "/USER/") if user != "root" else text
