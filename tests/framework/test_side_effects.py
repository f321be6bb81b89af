"""Tests that using the library does not change the state of the host process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from framework.errors import ConfigError
from framework.runtime.process_settings import ENVIRONMENT, configure_process

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]

PROBE = '''
import gc, json, logging, os, random, signal, sys, types, warnings

import cv2, hydra, numba, numpy as np, omegaconf, open3d, torch  # some change the process when they are imported
from hydra.core.config_store import ConfigStore
from hydra.core.singleton import Singleton
from omegaconf.basecontainer import BaseContainer
from threadpoolctl import threadpool_info

exec(sys.argv[1])  # what the host does before


def tree(node):
    return {name: tree(child) for name, child in node.items()} if isinstance(node, dict) else id(node)


def functions():
    """Return the ids of the functions and classes of Hydra, OmegaConf and Numba, and of their methods."""
    found = {}
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("hydra", "omegaconf", "numba"):
            for key, value in list(vars(module).items()):
                if isinstance(value, (types.FunctionType, type)):
                    found[name, key] = id(value)
                if isinstance(value, type):
                    members = list(vars(value).items())
                    found |= {(name, key, k): id(v) for k, v in members if isinstance(v, types.FunctionType)}
    return found


def state():
    return {
        "environ": dict(os.environ),
        "random": random.getstate(),
        "numpy.random": str(np.random.get_state()),
        "torch.random": torch.get_rng_state().numpy().tobytes(),
        "numba threads": numba.get_num_threads(),
        "torch threads": torch.get_num_threads(),
        "cv2 threads": cv2.getNumThreads(),
        "pools": {pool["filepath"]: pool["num_threads"] for pool in threadpool_info()},
        "meta_path": list(map(id, sys.meta_path)),
        "path": list(sys.path),
        "signals": {number: signal.getsignal(number) for number in signal.valid_signals()},
        "gc": (gc.isenabled(), gc.get_threshold(), gc.get_freeze_count()),
        "logging": (list(logging.root.handlers), logging.root.level, logging.root.manager.disable),
        "numpy errors": np.geterr(),
        "hooks": (id(sys.excepthook), id(sys.unraisablehook)),
        "ConfigStore": tree(ConfigStore.instance().repo),
        "singletons": {kind.__name__: id(value) for kind, value in Singleton._instances.items()},
        "singletons' state": {kind.__name__: tree(vars(value)) for kind, value in Singleton._instances.items()},
        "resolvers": {name: id(resolver) for name, resolver in BaseContainer._resolvers.items()},
        "functions": functions(),
    }


def kept(before, after):
    """Return True if a mapping keeps its entries; modules that are loaded in between add functions and pools."""
    return all(after.get(key) == value for key, value in before.items())


before = state()
exec(sys.argv[2])
after = state()
added = ("functions", "pools")
changed = [key for key in before if not (kept if key in added else lambda a, b: a == b)(before[key], after[key])]
for key in changed:
    print(key, before[key], after[key], sep="\\n", file=sys.stderr)
print(json.dumps(changed))
'''

USE = """
import instancemap
from instancemap import Camera, Mapper, Pipeline, load_map

camera = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
color = np.tile(np.arange(160, dtype=np.uint8)[None, :, None], (120, 1, 3))
u, v = np.meshgrid(np.arange(160), np.arange(120))
depth = (1.5 + 0.2 * np.sin(u / 9) * np.cos(v / 7)).astype(np.float32)
mapper = Mapper("fuser.voxel_size=0.05", threads=1)
for _ in range(2):
    assert not mapper.add(color, depth, camera=camera).lost
mapper.save(os.environ["PROBE_MAP"])
assert load_map(os.environ["PROBE_MAP"]).mesh().vertices.shape[0] > 100

from tests.support.scenes.corner_room import CornerRoom
stages = Mapper("detector=none", "tracker=ground_truth", "fuser.voxel_size=0.05").pipeline
result = Pipeline(stages.detector, stages.tracker, stages.refiner, stages.fuser).run(CornerRoom())
assert result.frames == 6
"""

HYDRA_APPLICATION = """
from hydra import initialize_config_dir

ConfigStore.instance().store("none", {"_target_": "os.system"}, "detector")
initialize_config_dir(os.getcwd(), version_base="1.1").__enter__()
"""

OTHERS = """
random.random(), np.random.rand(), torch.rand(1)
os.environ["PROBE"] = "1"
torch.set_num_threads(before["torch threads"] + 1)
cv2.setNumThreads(before["cv2 threads"] + 1)
numba.set_num_threads(1)
sys.meta_path.append(sys.meta_path[0])
sys.path.append("")
signal.signal(signal.SIGUSR1, print)
gc.freeze()
logging.basicConfig()
np.seterr(all="ignore")
sys.excepthook = print
omegaconf.OmegaConf.register_new_resolver("probe", str)
ConfigStore.instance().store("probe", {})
hydra.core.plugins.Plugins.instance()
hydra.compose = print
numba.core.dispatcher.Dispatcher.compile = lambda *_: None
"""


def changes(code: str, path: Path, before: str = "", **variables: str) -> list[str]:
    """Return the names of the process settings that `code` changes in a new process.

    Args:
        code: Code to test.
        path: Folder for a map.
        before: Code that is executed first.
        **variables: Environment variables of the process.
    """
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "NUMBA_THREADING"))
    }
    environment |= {"PROBE_MAP": str(path / "map.npz"), **variables}
    line = [sys.executable, "-W", "ignore", "-c", PROBE, before, code]
    done = subprocess.run(line, cwd=CHECKOUT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return list(json.loads(done.stdout.splitlines()[-1]))


def test_library_use_keeps_process_state(tmp_path: Path) -> None:
    assert changes(USE, tmp_path) == []


def test_library_use_in_hydra_application_keeps_process_state(tmp_path: Path) -> None:
    assert changes(USE, tmp_path, HYDRA_APPLICATION) == []


def test_probe_detects_all_kinds_of_changes(tmp_path: Path) -> None:
    code = OTHERS + "print(json.dumps(sorted(before)))"
    assert set(changes("import hydra.core.plugins\n" + code, tmp_path)) >= {
        "environ", "random", "numpy.random", "torch.random", "numba threads", "torch threads", "cv2 threads", "pools",
        "meta_path", "path", "signals", "gc", "logging", "numpy errors", "hooks", "ConfigStore", "singletons",
        "singletons' state", "resolvers", "functions",
    }  # fmt: skip


def test_configure_process_sets_environment_threads_and_seeds(tmp_path: Path) -> None:
    changed = changes("import instancemap\ninstancemap.configure_process(threads=1, seed=4)", tmp_path)
    assert set(changed) >= {"environ", "random", "numpy.random", "torch.random"}
    assert not {"meta_path", "signals", "gc", "singletons", "resolvers", "functions", "logging"} & set(changed)


CONFIGURED = """
import logging, os, sys
logging.basicConfig(format="%(message)s")
{before}
import instancemap
assert {loaded} or not {{"numpy", "numba"}} & sys.modules.keys()
instancemap.configure_process(threads=1)
from instancemap import Mapper
import cv2, numba
numba.get_num_threads()
print(numba.threading_layer(), numba.get_num_threads(), cv2.getNumThreads(), os.environ["OMP_WAIT_POLICY"])
"""


@pytest.mark.parametrize("before", ["", "import numba"])
def test_configure_process_after_numba_is_imported_warns(before: str) -> None:
    code = CONFIGURED.format(before=before, loaded=bool(before))
    environment = {name: value for name, value in os.environ.items() if name not in ENVIRONMENT}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=CHECKOUT, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["omp", "1", "1", "passive"]
    assert ("OMP_WAIT_POLICY" in done.stderr) == bool(before)


def test_configure_process_with_negative_threads_raises() -> None:
    with pytest.raises(ConfigError, match="threads"):
        configure_process(threads=-1)


WORKQUEUE = """
import logging
logging.basicConfig(level=logging.INFO, format="%(message)s")
import numba
from instancemap import Mapper, Pipeline
from tests.support.scenes.corner_room import CornerRoom
stages = Mapper("detector=none", "tracker=ground_truth", "fuser.voxel_size=0.05").pipeline
Pipeline(stages.detector, stages.tracker, stages.refiner, stages.fuser, prefetch=2).run(CornerRoom())
print(numba.threading_layer(), stages.fuser.scene.statistics.voxels)
"""


def test_pipeline_without_thread_safe_layer_gives_same_map() -> None:
    found = {}
    for layer in ("omp", "workqueue"):
        done = subprocess.run(
            [sys.executable, "-c", WORKQUEUE],
            cwd=CHECKOUT,
            env=os.environ | {"NUMBA_THREADING_LAYER": layer},
            capture_output=True,
            text=True,
            timeout=300,
            check=True,
        )
        used, found[layer] = done.stdout.split()
        assert used == layer
        assert done.stderr.count("not thread-safe") == (layer == "workqueue")
    assert found["omp"] == found["workqueue"]
