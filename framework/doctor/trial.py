"""Tries what may be broken in processes of their own: a library may end the process that loads it.

    python -m framework.doctor.trial NAME...      answers each name with a line of JSON, {"name": ..., ...}

A name is that of a module to be imported, or one of PROBES.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from framework.doctor.check_result import reason

PATIENCE = 120.0  # s, for all that one process tries
ROOT = Path(__file__).resolve().parents[2]


def tried(batches: Sequence[Sequence[str]]) -> dict[str, dict[str, Any]]:
    """What each name answers, or {"fault": why it does not, in one line}; the batches are tried side by side."""
    answers: dict[str, dict[str, Any]] = {}
    threads = [threading.Thread(target=_try, args=(list(batch), answers)) for batch in batches]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return answers


def _try(names: list[str], answers: dict[str, dict[str, Any]]) -> None:
    """Goes on behind a name that ends its process."""
    while names:
        lines, fault = _run(names)
        for line in lines:
            answer = json.loads(line)
            answers[answer.pop("name")] = answer
        names = [name for name in names if name not in answers]
        if names:
            answers[names.pop(0)] = {"fault": fault}


def _run(names: Sequence[str]) -> tuple[list[str], str]:
    """The lines of a process that tries these names, and how it ended."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    with subprocess.Popen(
        [sys.executable, "-P", "-m", __spec__.name, *names],  # -P: nothing of the working folder
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    ) as process:
        assert process.stdout is not None
        lines: list[str] = []
        reader = threading.Thread(target=lines.extend, args=(process.stdout,))
        reader.start()
        try:
            status = process.wait(PATIENCE)
            fault = f"ends the process ({signal.Signals(-status).name if status < 0 else f'exit status {status}'})"
        except subprocess.TimeoutExpired:
            process.kill()
            fault = f"does not end within {PATIENCE:.0f} s"
        reader.join()
    return lines, fault


def _gpu() -> dict[str, Any]:
    import torch

    if not torch.cuda.is_available():
        return {"gpus": [], "built": torch.version.cuda}
    found = [torch.cuda.get_device_properties(k) for k in range(torch.cuda.device_count())]
    return {"gpus": [f"{of.name}, {of.total_memory / 2**30:.0f} GiB" for of in found], "built": torch.version.cuda}


def _integers() -> dict[str, Any]:
    from framework.detection.runtimes.caffe2_network import has_int8_kernels

    return {"there": has_int8_kernels()}


def _kernels() -> dict[str, Any]:
    from framework.compilation.catalog import DEFAULT, OTHERS, listed

    counted: dict[str, Any] = {}
    for section, name in ((DEFAULT, "default"), (OTHERS, "others")):
        kernels = listed(section)
        compiled = [kernel.is_compiled() for kernel in kernels]
        counted[name] = [sum(compiled), len(compiled)]
        counted["folder"] = kernels[0].dispatcher._cache.cache_path
    return counted


PROBES: Mapping[str, Callable[[], dict[str, Any]]] = {"gpu()": _gpu, "integers()": _integers, "kernels()": _kernels}


def main(names: Sequence[str]) -> None:
    answers, sys.stdout = sys.stdout, sys.stderr  # what libraries print when they are loaded is no answer
    for name in names:
        answer: dict[str, Any] = {"name": name}
        try:
            if name in PROBES:
                answer |= PROBES[name]()
            else:
                import_module(name)
        except Exception as error:
            answer["fault"] = reason(error)
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
