"""Results of checks, and a runner that continues after a failing check."""

from __future__ import annotations

import getpass
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path


class Status(Enum):
    """The status of a check. The value is the mark in front of the check in the output."""

    OK = "ok"
    MISSING = "--"  # missing or failed, but optional
    ERROR = "!!"  # missing or broken, and required by a run with the default stages


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    status: Status
    detail: str
    fix: str = ""  # command or instruction that fixes the problem; "" = not needed or unknown

    @classmethod
    def of(cls, name: str, passed: bool, detail: str, fix: str = "", required: bool = False) -> Check:
        """Return the result of a check.

        A failed check includes its fix. Its status is ERROR if `required`, otherwise MISSING.
        """
        if passed:
            return cls(name, Status.OK, detail)
        return cls(name, Status.ERROR if required else Status.MISSING, detail, fix)


def run_checks(*checks: Callable[[], Iterable[Check]]) -> list[Check]:
    """Return the results of all checks. An exception becomes a result with status ERROR."""
    results: list[Check] = []
    for check in checks:
        try:
            results += check()
        except Exception as error:  # a broken installation can raise anything
            results.append(Check(check.__name__.replace("_", " "), Status.ERROR, one_line(error)))
    return results


def one_line(error: BaseException) -> str:
    """Return the class and message of an exception on one line of at most 300 characters."""
    return anonymous(f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": "))[:300]


def anonymous(text: str | Path) -> str:
    """Return a text without the home folder and user name, for pasting into an issue."""
    home, text = str(Path.home()), str(text)
    if home != "/":
        text = text.replace(home, "~")
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user in a container may have no name
        return text
    return text if user == "root" else re.sub(rf"/{re.escape(user)}(?![\w.-])", "/USER", text)
