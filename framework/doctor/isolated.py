"""Imports and probes in a separate process, because a broken library can end the process that loads it.

`python -m framework.doctor.isolated NAME...` prints one line of JSON for each module or probe.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

from framework.doctor.check_result import one_line

TIMEOUT_S = 120.0  # for all names of one process
ROOT = Path(__file__).resolve().parents[2]


def probe_all(batches: Sequence[Sequence[str]]) -> dict[str, dict[str, Any]]:
    """Return the answer of each name, or {"error": reason}. The batches run in parallel processes."""
    with ThreadPoolExecutor(len(batches)) as pool:
        return {name: answer for answers in pool.map(_probe, batches) for name, answer in answers.items()}


def _probe(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    answers: dict[str, dict[str, Any]] = {}
    left = list(names)
    while left:
        lines, error = _run(left)
        answers |= {answer.pop("name"): answer for answer in map(json.loads, lines)}
        left = [name for name in left if name not in answers]
        if left:  # the process ended while probing the first of these
            answers[left.pop(0)] = {"error": error}
    return answers


def _run(names: Sequence[str]) -> tuple[list[str], str]:
    """Return the lines of a process that probes these names, and how it ended."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-P", "-m", __spec__.name, *names]  # -P: import nothing from the working folder
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": path},
            timeout=TIMEOUT_S,
        )
    except subprocess.TimeoutExpired as expired:
        return (expired.stdout or b"").decode().splitlines(), f"does not finish within {TIMEOUT_S:g} s"
    return done.stdout.decode().splitlines(), f"ends the process with status {done.returncode}"


def _gpu() -> dict[str, Any]:
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    properties = [torch.cuda.get_device_properties(k) for k in range(count)]
    return {"gpus": [f"{gpu.name}, {gpu.total_memory / 2**30:.0f} GiB" for gpu in properties]}


def _int8() -> dict[str, Any]:
    from framework.detection.runtimes.caffe2_network import has_int8_kernels

    return {"supported": has_int8_kernels()}


def _kernels() -> dict[str, Any]:
    from framework.compilation.catalog import DEFAULT, OTHERS, listed

    kernels = {"default stages": listed(DEFAULT), "other stages": listed(OTHERS)}
    folder = kernels["default stages"][0].dispatcher._cache.cache_path
    return {"folder": folder} | {
        name: [sum(kernel.is_compiled() for kernel in found), len(found)] for name, found in kernels.items()
    }


PROBES: Mapping[str, Callable[[], dict[str, Any]]] = {"gpu()": _gpu, "int8()": _int8, "kernels()": _kernels}


def main(names: Sequence[str]) -> None:
    answers, sys.stdout = sys.stdout, sys.stderr  # libraries may print while they load
    for name in names:
        try:
            answer = PROBES[name]() if name in PROBES else {}
            if name not in PROBES:
                import_module(name)
        except Exception as error:
            answer = {"error": one_line(error)}
        print(json.dumps({"name": name, **answer}), file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
