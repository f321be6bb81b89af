"""Virtual environments with InstanceMap, installed from a wheel outside of the checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Iterable
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
SITE = Path(sysconfig.get_paths()["purelib"])
PIP = (sys.executable, "-m", "pip")
OFFLINE = ("--quiet", "--no-deps", "--no-index")


def create_environment(folder: Path, packages: Iterable[Path] = ()) -> None:
    """Create the virtual environment `folder`/env with InstanceMap and the packages in other source folders.

    The dependencies are those of the current environment.
    """
    wheels = build_wheels(folder / "wheels", [CHECKOUT, *packages])
    venv.create(folder / "env", symlinks=True)
    subprocess.run([*PIP, "--python", str(folder / "env"), "install", *OFFLINE, *wheels], check=True, timeout=120)
    [site] = folder.glob("env/lib/python*/site-packages")
    (site / "libraries.pth").write_text(f"{SITE}\n")
    copy_kernels(site)


def build_wheels(folder: Path, sources: Iterable[Path]) -> list[str]:
    """Build the wheels of source folders, and return the paths of all wheels in `folder`."""
    folder.mkdir(exist_ok=True)
    for source in sources:
        build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
        subprocess.run(build, cwd=source, check=True, capture_output=True, timeout=120)
    return [str(path) for path in folder.iterdir()]


def copy_kernels(site: Path) -> None:
    """Copy the numba cache of the checkout. The copied modification times are those that numba expects."""
    for path in (CHECKOUT / "framework").rglob("*.py"):
        shutil.copystat(path, site / path.relative_to(CHECKOUT))
    for path in (CHECKOUT / "framework").rglob("*.nb[ic]"):
        copied = site / path.relative_to(CHECKOUT)
        if copied.parents[1].is_dir():  # false for the outdated cache of a removed package
            copied.parent.mkdir(exist_ok=True)
            shutil.copy2(path, copied)


def run_in(folder: Path, *line: str) -> str:
    """Run a program of `folder`/env in `folder` and return its output."""
    alone = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "HYDRA_FULL_ERROR")}
    program = str(folder / "env" / "bin" / line[0])
    done = subprocess.run([program, *line[1:]], cwd=folder, env=alone, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout
