"""The whole examination, section by section."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import framework
from framework.doctor import machine, networks, trial
from framework.doctor.check_result import Finding, Section, State, anonymous, section

LATER = ("torch", "gpu()", "integers()")  # what takes as long as all others: one process tries these, another the rest


def examined() -> list[Section]:
    """All sections. Nothing is downloaded, nothing is compiled, and no file is written."""
    answers = _Answers()
    return [
        section("InstanceMap", _code),
        section("Python and machine", _python, machine.processor, machine.memory, answers.gpu, answers.integers),
        section("Libraries", answers.libraries),
        section("Extras, optional", _extras),
        section("Networks", networks.shipped, networks.downloaded, networks.from_hugging_face),
        section("System libraries and programs", machine.system_libraries, machine.programs),
        section("Compiled kernels", answers.kernels),
        section("Disk", machine.disk),
        section("Environment variables", machine.variables),
    ]


def _code() -> Iterator[Finding]:
    yield Finding("version", State.THERE, framework.__version__)
    from framework.runs.provenance import UNKNOWN, code_version

    found = code_version()
    changed = ", and files differ from it" if found["git_dirty"] is True else ""
    commit = "no checkout" if found["git_commit"] == UNKNOWN else f"{str(found['git_commit'])[:12]}{changed}"
    yield Finding("commit", State.THERE, commit)


def _python() -> Iterator[Finding]:
    from framework.doctor.requirements import needs

    wanted = needs().python
    fits = wanted.contains(platform.python_version(), prereleases=True)
    detail = f"{platform.python_version()} in {anonymous(sys.prefix)}" + ("" if fits else f", but {wanted} is needed")
    remedy = "" if fits else f"install a Python {wanted}, and make an environment with it"
    yield Finding("Python", State.THERE if fits else State.BROKEN, detail, remedy)
    yield Finding("platform", State.THERE, platform.platform())


def _extras() -> Iterator[Finding]:
    from framework.doctor.requirements import NOT_OF_USERS, needs, of_extra

    for name, requirements in needs().extras.items():
        if name not in NOT_OF_USERS:
            yield of_extra(name, requirements)


class _Answers:
    """What was tried in processes of their own, once, when it is first asked for."""

    def __init__(self) -> None:
        self._found: dict[str, dict[str, Any]] = {}

    def of(self, name: str) -> dict[str, Any]:
        if not self._found:
            from framework.doctor.requirements import module_of, needs

            modules = [module for module in map(module_of, needs().always) if module and module not in LATER]
            self._found = trial.tried([LATER, [*modules, "kernels()"]])
        return self._found.get(name, {"fault": "not tried"})

    def libraries(self) -> Iterator[Finding]:
        from framework.doctor.requirements import module_of, needs, of_library

        for requirement in needs().always:
            module = module_of(requirement)
            yield of_library(requirement, self.of(module).get("fault") if module else None)

    def gpu(self) -> Iterator[Finding]:
        """Optional: whatever there is, networks run."""
        answer = self.of("gpu()")
        if "fault" in answer:
            yield Finding("GPU", State.OPTIONAL, answer["fault"])
        elif answer["gpus"]:
            yield Finding("GPU", State.THERE, f"{', '.join(answer['gpus'])}, CUDA {answer['built']}")
        elif Path("/proc/driver/nvidia/version").exists():
            built = f"for CUDA {answer['built']}" if answer["built"] else "without CUDA"
            remedy = "install a torch that fits the driver: https://pytorch.org/get-started/locally"
            yield Finding(
                "GPU", State.OPTIONAL, f"an NVIDIA driver is there, and torch, {built}, does not use it", remedy
            )
        else:
            yield Finding("GPU", State.OPTIONAL, "none with CUDA: networks run on the processor")

    def integers(self) -> Iterator[Finding]:
        """Whether maskrcnn2go computes in its own integers."""
        answer = self.of("integers()")
        if answer.get("there"):
            yield Finding("8-bit integers", State.THERE, "maskrcnn2go computes in them (VNNI)")
        else:
            why = answer.get("fault", "the processor has no VNNI")
            yield Finding(
                "8-bit integers", State.OPTIONAL, f"{why}: maskrcnn2go computes in float, at a third of the speed"
            )

    def kernels(self) -> Iterator[Finding]:
        answer = self.of("kernels()")
        if "fault" in answer:
            yield Finding("kernels", State.BROKEN, answer["fault"])
            return
        for name, command in (("default", "instancemap compile"), ("others", "instancemap compile --all")):
            compiled, count = answer[name]
            whole = compiled == count
            detail = f"{compiled} of {count} are compiled" + ("" if whole else "; a run compiles what it needs")
            yield Finding(name, State.THERE if whole else State.OPTIONAL, detail, "" if whole else command)
        folder = Path(answer["folder"])
        there = next(path for path in (folder, *folder.parents) if path.exists())
        if os.access(there, os.W_OK):
            yield Finding("kept in", State.THERE, f"{anonymous(str(folder))} and others beside the code")
        else:
            detail = f"{anonymous(str(folder))} cannot be written: every process compiles anew"
            yield Finding("kept in", State.OPTIONAL, detail, "NUMBA_CACHE_DIR=DIR: kernels are kept in another place")
