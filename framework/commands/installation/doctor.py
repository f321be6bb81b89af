"""`instancemap doctor`: check the installation and print the fix for each problem."""

from __future__ import annotations

import argparse
import json
import platform
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import partial, update_wrapper
from pathlib import Path
from typing import Any

import framework
from framework.doctor import machine, networks, packages
from framework.doctor.check_result import Check, Status, anonymous, run_checks
from framework.doctor.isolated import ACCELERATION, KERNELS, REPAIR, Outcomes, run_all

LEGEND = "ok: available   --: missing or failed, optional   !!: missing or broken, required by the default stages"


def main() -> None:
    """Run the command `instancemap doctor`."""
    parser = argparse.ArgumentParser(
        description="Check the installation and print the fix for each problem. The output contains no user name or "
        "home folder, so you can paste it into an issue. Exit status 1 means that a required check failed."
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--repair", action="store_true", help="first delete the damaged files of the kernel cache")
    options = parser.parse_args([word for word in sys.argv[1:] if not word.startswith("debug=")])
    sections = examine(options.repair)
    errors = sum(check.status is Status.ERROR for checks in sections.values() for check in checks)
    print(_as_json(sections) if options.json else _as_text(sections, errors), flush=True)
    if errors:
        sys.exit(1)


def examine(repair: bool = False) -> dict[str, list[Check]]:
    """Run all checks and return them by section. Nothing is downloaded, compiled or written.

    With `repair`, the damaged files of the kernel cache are deleted first.
    """
    imports = [packages.import_statement(line.name) for line in packages.declared()[1]]
    outcomes = {**run_all([REPAIR] if repair else []), **run_all([ACCELERATION, KERNELS, *imports])}
    libraries, acceleration, kernels = (
        update_wrapper(partial(check, outcomes), check) for check in (packages.libraries, _acceleration, _kernels)
    )
    return {
        "InstanceMap": run_checks(_version),
        "Python and machine": run_checks(_python, machine.hardware, acceleration),
        "Libraries": run_checks(libraries),
        "Extras (optional)": run_checks(packages.extras),
        "Networks": run_checks(networks.included_and_hub, networks.published),
        "System libraries": run_checks(machine.system_libraries),
        "Compiled kernels": run_checks(kernels),
        "Disk": run_checks(machine.disk),
        "Environment variables": run_checks(machine.environment),
    }


def _version() -> Iterator[Check]:
    from framework.runs.provenance import UNKNOWN, code_version

    yield Check("version", Status.OK, framework.__version__)
    found = code_version()
    modified = " with local changes" if found["git_dirty"] is True else ""
    commit = "no checkout" if found["git_commit"] == UNKNOWN else f"{str(found['git_commit'])[:12]}{modified}"
    yield Check.of("commit", shutil.which("git") is not None, commit, "apt-get install git")


def _python() -> Iterator[Check]:
    from packaging.specifiers import SpecifierSet

    wanted, version = packages.declared()[0], platform.python_version()
    fits = SpecifierSet(wanted).contains(version, prereleases=True)
    fix = f"create an environment with Python {wanted}"
    yield Check.of("Python", fits, f"{version} in {anonymous(sys.prefix)}", fix, required=True)
    yield Check("platform", Status.OK, platform.platform())


def _acceleration(outcomes: Outcomes) -> Iterator[Check]:
    answer, error = outcomes[ACCELERATION]
    found: dict[str, Any] = json.loads(answer) if answer else {"gpus": [], "int8": False}
    has_driver = Path("/proc/driver/nvidia/version").exists()
    detail = "NVIDIA driver found, but torch cannot use it" if has_driver else "none; networks run on the CPU"
    fix = "install a torch build for your driver: https://pytorch.org/get-started/locally" if has_driver else ""
    yield Check.of("GPU", bool(found["gpus"]), ", ".join(found["gpus"]) or error or detail, fix)
    detail = "VNNI" if found["int8"] else error or "no VNNI; maskrcnn2go computes in float32, three times slower"
    yield Check.of("8-bit integers", found["int8"], detail)


def _kernels(outcomes: Outcomes) -> Iterator[Check]:
    answer, error = outcomes[KERNELS]
    if error:
        yield Check("kernels", Status.ERROR, error)
        return
    found = json.loads(answer)
    if REPAIR in outcomes:
        count, error = outcomes[REPAIR]
        detail = error or f"{count} damaged files deleted"
        yield Check.of("repair", not error, detail, "delete the *.nbi and *.nbc files of the kernel cache")
    commands = {"default stages": "instancemap compile", "other stages": "instancemap compile --all"}
    for (name, command), (compiled, count) in zip(commands.items(), found["counts"], strict=True):
        yield Check.of(name, compiled == count, f"{compiled} of {count} kernels compiled", command)
    fix = "set the variable NUMBA_CACHE_DIR to a writable folder"
    if found["folder"] is None:
        yield Check.of("kernel cache", False, "no writable folder; each process compiles again", fix)
        return
    _, writable = machine.writable_parent(Path(found["folder"]))
    detail = anonymous(found["folder"]) + ("" if writable else " is not writable; each process compiles again")
    yield Check.of("kernel cache", writable, detail, fix)
    damaged = found["damaged"]
    detail = f"{len(damaged)} damaged, such as {anonymous(damaged[0])}" if damaged else "no damaged files"
    yield Check.of("cache files", not damaged, detail, "instancemap doctor --repair")


def _as_text(sections: Mapping[str, list[Check]], errors: int) -> str:
    lines = []
    for title, checks in sections.items():
        lines.append(title)
        width = max((len(check.name) for check in checks), default=0)
        for check in checks:
            lines.append(f"  {check.status.value}  {check.name:<{width}}  {check.detail}".rstrip())
            lines += [f"      {'':<{width}}  fix: {check.fix}"] if check.fix else []
        lines.append("")
    failed = f"{errors} required check{'s' * (errors > 1)} failed."
    lines += [LEGEND, failed if errors else "All required checks passed."]
    return "\n".join(lines).encode("ascii", "backslashreplace").decode()


def _as_json(sections: Mapping[str, list[Check]]) -> str:
    listed = [
        {"title": title, "checks": [asdict(check) | {"status": check.status.name.lower()} for check in checks]}
        for title, checks in sections.items()
    ]
    return json.dumps(listed, indent=2)
