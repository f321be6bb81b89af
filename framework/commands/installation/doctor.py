"""`instancemap doctor`: check the installation and print the fix for each problem."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import framework
from framework.doctor import machine, networks, packages
from framework.doctor.check_result import Check, Status, anonymous, run_checks
from framework.doctor.isolated import probe_all


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Checks the installation and prints the fix for each problem. Paste the output into an issue: it"
        " does not contain your user name or home folder. Exits with 1 if a run with the default stages cannot work.",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args([word for word in sys.argv[1:] if not word.startswith("debug=")])
    sections = examine()
    errors = sum(check.status is Status.ERROR for checks in sections.values() for check in checks)
    print(_as_json(sections) if options.json else _as_text(sections, errors), flush=True)
    if errors:
        sys.exit(1)


def examine() -> dict[str, list[Check]]:
    """Return the results by section. Downloads, compiles and writes nothing."""
    from_torch = ["torch", "gpu()", "int8()"]  # torch takes as long to import as all others: they run in parallel
    others = [module for module in packages.modules().values() if module not in from_torch]
    answers = probe_all([from_torch, [*others, "kernels()"]])

    def libraries() -> Iterator[Check]:
        yield from packages.libraries(answers)

    def acceleration() -> Iterator[Check]:
        yield from _acceleration(answers)

    def kernels() -> Iterator[Check]:
        yield from _kernels(answers["kernels()"])

    return {
        "InstanceMap": run_checks(_version),
        "Python and machine": run_checks(_python, machine.hardware, acceleration),
        "Libraries": run_checks(libraries),
        "Extras (optional)": run_checks(packages.extras),
        "Networks": run_checks(networks.included, networks.published, networks.hugging_face),
        "System libraries and programs": run_checks(machine.system_libraries, machine.programs),
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
    yield Check("commit", Status.OK, commit)


def _python() -> Iterator[Check]:
    from packaging.specifiers import SpecifierSet

    wanted, version = packages.declared()[0], platform.python_version()
    fits = SpecifierSet(wanted).contains(version, prereleases=True)
    fix = "" if fits else f"create an environment with Python {wanted}"
    yield Check("Python", Status.OK if fits else Status.ERROR, f"{version} in {anonymous(sys.prefix)}", fix)
    yield Check("platform", Status.OK, platform.platform())


def _acceleration(answers: Mapping[str, Mapping[str, Any]]) -> Iterator[Check]:
    gpu, int8 = answers["gpu()"], answers["int8()"]
    if gpu.get("gpus"):
        yield Check("GPU", Status.OK, ", ".join(gpu["gpus"]))
    elif Path("/proc/driver/nvidia/version").exists():
        fix = "install a torch build for your driver: https://pytorch.org/get-started/locally"
        yield Check("GPU", Status.MISSING, gpu.get("error", "torch does not use the NVIDIA driver"), fix)
    else:
        yield Check("GPU", Status.MISSING, gpu.get("error", "no CUDA device; networks run on the CPU"))
    supported = bool(int8.get("supported"))
    detail = int8.get("error", "VNNI" if supported else "no VNNI; maskrcnn2go runs in float32, three times slower")
    yield Check("8-bit integers", Status.OK if supported else Status.MISSING, detail)


def _kernels(answer: Mapping[str, Any]) -> Iterator[Check]:
    if "error" in answer:
        yield Check("kernels", Status.ERROR, answer["error"])
        return
    for name, command in (("default stages", "instancemap compile"), ("other stages", "instancemap compile --all")):
        compiled, count = answer[name]
        complete = compiled == count
        detail = f"{compiled} of {count} kernels compiled"
        yield Check(name, Status.OK if complete else Status.MISSING, detail, "" if complete else command)
    folder = Path(answer["folder"])
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    writable = os.access(existing, os.W_OK)
    detail = anonymous(str(folder)) + ("" if writable else " is not writable: every process compiles its kernels")
    fix = "" if writable else "set the environment variable NUMBA_CACHE_DIR"
    yield Check("kernel cache", Status.OK if writable else Status.MISSING, detail, fix)


def _as_text(sections: Mapping[str, list[Check]], errors: int) -> str:
    lines = []
    for title, checks in sections.items():
        lines.append(title)
        width = max((len(check.name) for check in checks), default=0)
        for check in checks:
            lines.append(f"  {check.status.value}  {check.name:<{width}}  {check.detail}".rstrip())
            if check.fix:
                lines.append(f"      {'':<{width}}  fix: {check.fix}")
        lines.append("")
    lines.append("ok: available   --: missing, optional   !!: missing or broken, required by the default stages")
    lines.append(f"{errors} required checks failed." if errors else "All required checks passed.")
    return "\n".join(lines).encode("ascii", "backslashreplace").decode()


def _as_json(sections: Mapping[str, list[Check]]) -> str:
    """Return [{"title", "checks": [{"name", "status", "detail", "fix"}]}]."""
    listed = [
        {"title": title, "checks": [asdict(check) | {"status": check.status.name.lower()} for check in checks]}
        for title, checks in sections.items()
    ]
    return json.dumps(listed, indent=2)
