"""The acceptance measurements. Each function returns the measured value and whether the value is within the bound."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from framework.tables.statistics import bootstrap_interval
from tests.acceptance import changing_scenes, depth_calibration, long_run, recording_checks
from tests.acceptance.buildings import files_that_depend_on_threads, five_rooms, second_round
from tests.acceptance.explained_faults import explained_faults
from tests.acceptance.instance_calibration import unseen_scenes
from tests.acceptance.large_map import measure_large_map
from tests.acceptance.loops import counted_loops
from tests.acceptance.runner import CHECKOUT, Measured, measurement

SHARED = CHECKOUT.parent / "shared" / "data"
PIPELINE = ("framework", "plugins", "conf")
TESTS = ("tests/conftest.py", "tests/framework", "tests/plugins", "tests/support")
YOLO = SHARED.parent / "weights" / "yolo11n_seg" / "yolo11n_seg.onnx"
MASKING_DETECTORS = (("detector=maskrcnn2go",), ("detector=onnx_segmentation", f"detector.weights={YOLO}"))
CHECKS = (
    "framework/checking", "framework/datasets", "tests/acceptance/recording_checks.py",
    "tests/support/recordings/damaged.py",
)  # fmt: skip


def pipeline_and(module: str) -> tuple[str, ...]:
    """Return the paths of the pipeline and of a module of this folder."""
    return (*PIPELINE, f"tests/acceptance/{module}.py")


FAULTS = (*pipeline_and("explained_faults"), "tests/support/stage_faults.py")


@functools.cache
def mapped(*overrides: str) -> dict[str, Any]:
    """Map a sequence and return the metrics.

    Repeated calls with the same overrides in one process reuse the metrics.
    """
    with tempfile.TemporaryDirectory() as directory:
        command = [sys.executable, "-m", "framework", *overrides, f"hydra.run.dir={directory}/run"]
        subprocess.run(command, cwd=CHECKOUT, check=True)
        metrics: dict[str, Any] = json.loads(Path(directory, "run", "metrics.json").read_text())
        return metrics


def failures(*arguments: str, **variables: str) -> Measured:
    """Run pytest with `arguments`, and return its exit status and whether it is 0, i.e. all tests pass."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", *arguments]
    status = subprocess.run(command, cwd=CHECKOUT, env=os.environ | variables, check=False).returncode
    return status, status == 0


def counted(lines: Iterable[str]) -> Measured:
    """Print the lines, and return their number and whether it is 0."""
    count = 0
    for line in lines:
        print(line)
        count += 1
    return count, count == 0


def folder(scene: str) -> tuple[str, str]:
    return "dataset=rgbd_folder", f"dataset.root={SHARED / scene}"


RPY_ROOT = SHARED / "tum_fr1_rpy_a" / "rgbd_dataset_freiburg1_rpy"
RPY = ("dataset=tum_rgbd", f"dataset.root={RPY_ROOT}", "detector=none")


def ate_mm(bound: float, *overrides: str) -> Measured:
    value = 1e3 * mapped(*overrides)["trajectory.ate_rmse_m"]
    return value, value <= bound


def lost_frames(*overrides: str) -> Measured:
    value = mapped(*overrides)["frames_lost"]
    return value, value == 0


def ap50(bound: float, scene: str) -> Measured:
    value = mapped(*folder(scene), "tracker=ground_truth")["instances.ap50"]
    return value, value >= bound


@measurement("ATE <= 25 mm, KinectFusion, no correction of depth", *PIPELINE)
def kitchen_ate() -> Measured:
    return ate_mm(25, *folder("redkitchen"), "detector=none", "backend=none")  # the reference has uncorrected depth


@measurement("0 frames", *PIPELINE)
def kitchen_lost_frames() -> Measured:
    return lost_frames(*folder("redkitchen"), "detector=none")


@measurement("ATE <= 40 mm", *PIPELINE)
def freiburg1_rpy_ate() -> Measured:
    return ate_mm(40, *RPY)


@measurement("0 frames", *PIPELINE)
def freiburg1_rpy_lost_frames() -> Measured:
    return lost_frames(*RPY)


@measurement("AP50 >= 0.8, given poses", *PIPELINE)
def replica_floor2_ap50() -> Measured:
    return ap50(0.8, "replica_floor2")


@measurement("AP50 >= 0.6, given poses", *PIPELINE)
def kitchen_ap50() -> Measured:
    return ap50(0.6, "redkitchen")


@measurement("ATE with/without the person <= 1.1", *pipeline_and("changing_scenes"))
def person_ate_ratio() -> Measured:
    ratio = max(run.ate for run in changing_scenes.masked()) / changing_scenes.without_person().ate
    return ratio, ratio <= 1.1


@measurement("<= 0.1% of vertices on the person", *pipeline_and("changing_scenes"))
def person_vertices() -> Measured:
    percentage = 100 * max(run.vertices for run in changing_scenes.masked())
    return percentage, percentage <= 0.1


@measurement("0 likely instances of the person", *pipeline_and("changing_scenes"))
def person_instances() -> Measured:
    count = max(run.instances for run in changing_scenes.masked())
    return count, count == 0


@measurement(
    "mean change of ATE <= +2%, 0 additional lost frames, two networks",
    *pipeline_and("changing_scenes"),
)
def masking_freiburg1_rpy() -> Measured:
    """Return the larger mean change of the ATE with two networks, in percent."""
    means, lost = [], 0
    for detector in MASKING_DETECTORS:
        effect = changing_scenes.MaskingEffect.on(RPY_ROOT, *detector)
        changes = 100 * effect.ate_changes
        print(detector[0], changes, changes.mean(), bootstrap_interval(changes), effect.additional_lost, flush=True)
        means.append(float(changes.mean()))
        lost += max(0, effect.additional_lost)
    return max(means), max(means) <= 2 and lost == 0


@measurement("0 wrong diagnoses, 75 recordings with one error", *CHECKS)
def wrong_diagnoses() -> Measured:
    return counted(recording_checks.wrong_diagnoses(SHARED))


@measurement("<= 1 false alarm, 59 valid recordings", *CHECKS)
def false_alarms() -> Measured:
    count, _ = counted(recording_checks.false_alarms(SHARED))
    return count, count <= 1


@measurement("time per frame of Open3D / InstanceMap >= 6, redkitchen, 1 cm", *PIPELINE, "tests/benchmarks")
def speed_ratio() -> Measured:
    with tempfile.TemporaryDirectory() as directory:
        report = Path(directory, "benchmark.json")
        chosen = "test_slam_speed_compared_with_open3d and redkitchen and 1cm"
        failures("tests/benchmarks/test_slam.py", "-k", chosen, f"--benchmark-json={report}")
        info = json.loads(report.read_text())["benchmarks"][0]["extra_info"]
    ours, theirs = info["whole loop, ms (ours, Open3D)"]
    return theirs / ours, theirs / ours >= 6


@functools.cache
def grown() -> long_run.Growth:
    return long_run.measure()


@measurement("< 50 bytes of heap per frame", *pipeline_and("long_run"))
def long_run_growth() -> Measured:
    value = grown().bytes_per_frame
    return value, value < 50


@measurement("processor time of the last / first quarter <= 1.05", *pipeline_and("long_run"))
def long_run_slowdown() -> Measured:
    value = grown().time_ratio
    return value, value <= 1.05


@measurement("exit status 0, 2,000 cases per test", *PIPELINE, *TESTS)
def fuzzing() -> Measured:
    return failures("tests", "-k", "fuzz", INSTANCEMAP_FUZZ="2000")


@measurement(
    "change of the loading time with a manifest <= +5%, map of redkitchen",
    "framework/files",
    "framework/mapping",
    "tests/acceptance/loading_time.py",
)
def hashing_cost() -> Measured:
    """Compare the time to load a map with its manifest to the time without, where zipfile checks the arrays."""
    with tempfile.TemporaryDirectory() as directory:
        run = Path(directory, "run")
        command = [sys.executable, "-m", "framework", *folder("redkitchen"), "detector=none", f"hydra.run.dir={run}"]
        subprocess.run(command, cwd=CHECKOUT, check=True)
        os.sync()  # writing the run to the disk would take a core
        command = [sys.executable, "-m", "tests.acceptance.loading_time", str(run / "map.npz")]
        printed = subprocess.run(command, cwd=CHECKOUT, check=True, capture_output=True, text=True).stdout
    cost = 100 * (float(printed) - 1)
    return cost, cost <= 5


@measurement("ATE with/without back end <= 1/3", *pipeline_and("buildings"))
def building_ate() -> Measured:
    value = max(one.corrected.ate / one.drifted.ate for one in five_rooms())
    return value, value <= 1 / 3


@measurement("decrease of AP50 from ground-truth to tracked poses <= 0.03", *pipeline_and("buildings"))
def building_ap50() -> Measured:
    value = max(one.given.ap50 - one.corrected.ap50 for one in five_rooms())
    return value, value <= 0.03


@measurement("0 instances duplicated only with tracked poses", *pipeline_and("buildings"))
def building_doubled() -> Measured:
    value = sum(len(one.corrected.doubled - one.given.doubled) for one in five_rooms())
    return value, value == 0


@measurement("median surface error <= 10 mm", *pipeline_and("buildings"))
def building_surface() -> Measured:
    value = 1e3 * max(one.corrected.distance for one in five_rooms())
    return value, value <= 10


@measurement("AP50 and mean IoU: difference from the oracle <= 0.01", *pipeline_and("buildings"))
def building_oracle() -> Measured:
    pairs = [(one.corrected, one.oracle) for one in five_rooms()]
    value = max(max(abs(a.ap50 - b.ap50), abs(a.mean_iou - b.mean_iou)) for a, b in pairs)
    return value, value <= 0.01


@measurement("surface error: difference from the oracle <= 2 mm", *pipeline_and("buildings"))
def building_oracle_surface() -> Measured:
    value = 1e3 * max(abs(one.corrected.distance - one.oracle.distance) for one in five_rooms())
    return value, value <= 2


@measurement("ATE with/without back end <= 0.8, motion capture", *pipeline_and("depth_calibration"))
def calibrated_freiburg1_ate() -> Measured:
    value = depth_calibration.of_freiburg1().ratio
    return value, value <= 0.8


@measurement(
    "distance from structure-from-motion poses with/without back end <= 0.5",
    *pipeline_and("depth_calibration"),
)
def calibrated_kitchen_distance() -> Measured:
    value = depth_calibration.of_kitchen().ratio
    return value, value <= 0.5


@measurement("0 false loops, 20 buildings with identical rooms", *pipeline_and("loops"))
def false_loops() -> Measured:
    value = sum(one.false for one in counted_loops())
    return value, value == 0


@measurement("recall of revisits >= 0.8, 20 buildings with identical rooms", *pipeline_and("loops"))
def loop_recall() -> Measured:
    value = sum(one.found for one in counted_loops()) / sum(one.revisits for one in counted_loops())
    return value, value >= 0.8


@measurement("map size after two rounds / one round <= 1.05, one building", *pipeline_and("buildings"))
def building_second_round() -> Measured:
    value = second_round()
    return value, value <= 1.05


@measurement("0 different files between one and two threads, one building", *pipeline_and("buildings"))
def building_threads() -> Measured:
    return counted(files_that_depend_on_threads())


@measurement("ECE of existence <= 0.1", *pipeline_and("instance_calibration"))
def calibration_of_existence() -> Measured:
    value = unseen_scenes()["exists"].calibrated.ece()
    return value, value <= 0.1


@measurement("ECE of the class <= 0.1", *pipeline_and("instance_calibration"))
def calibration_of_class() -> Measured:
    value = unseen_scenes()["class"].calibrated.ece()
    return value, value <= 0.1


@measurement(
    "0 events with a higher Brier score or lower AUROC than uncalibrated",
    *pipeline_and("instance_calibration"),
)
def calibration_of_each_event() -> Measured:
    worse = [
        event
        for event, one in unseen_scenes().items()
        if one.calibrated.brier() >= one.today.brier() or one.calibrated.auroc() < one.today.auroc()
    ]
    return counted(worse)


@measurement("0 faults attributed to a wrong stage, 4 faults in 3 rooms", *FAULTS)
def faults_without_cause() -> Measured:
    return counted(str(one) for one in explained_faults() if not one.named)


@measurement("fraction of the additional loss >= 0.8, 4 faults in 3 rooms", *FAULTS)
def loss_of_faulty_stage() -> Measured:
    value = min(one.fraction for one in explained_faults())
    return value, value >= 0.8


@measurement("difference between the sum of contributions and the loss <= 1e-9", *FAULTS)
def sum_of_contributions() -> Measured:
    value = max(one.rest for one in explained_faults())
    return value, value <= 1e-9


@measurement("slowest query <= 10 ms, unchanged map", *pipeline_and("large_map"))
def large_map_query() -> Measured:
    value = measure_large_map(SHARED / "redkitchen").query_ms
    return value, value <= 10


@measurement("saving <= 3 s", *pipeline_and("large_map"))
def large_map_saving() -> Measured:
    value = measure_large_map(SHARED / "redkitchen").saving
    return value, value <= 3


@measurement("loading <= 3 s", *pipeline_and("large_map"))
def large_map_loading() -> Measured:
    value = measure_large_map(SHARED / "redkitchen").loading
    return value, value <= 3


ROOMS = (("room0", "STUDIO"), ("room1", "OFFICE"), ("room2", "BEDROOM"))
SMALL_ROOM = ("dataset=synthetic", "dataset.stride=4", "dataset.width=320", "dataset.height=240")


def structure_of_room(scene: str, kind: str, refiner: str) -> dict[str, Any]:
    """Map a synthetic room with given poses and the detector of rendered rooms, and return the metrics."""
    chosen = (f"dataset.scene={scene}", f"dataset.kind={kind}", f"refiner={refiner}")
    return mapped(*SMALL_ROOM, *chosen, "fuser.voxel_size=0.02", "tracker=ground_truth", "detection_cache=read_write")


@measurement("<= 1% of true wall and floor points in instances, 3 synthetic rooms, every refiner", *PIPELINE)
def building_in_instances() -> Measured:
    refiners = sorted(path.stem for path in (CHECKOUT / "conf" / "refiner").glob("*.yaml"))
    values = {
        (scene, refiner): 100 * structure_of_room(scene, kind, refiner)["panoptic.building_in_instances"]
        for refiner in refiners
        for scene, kind in ROOMS
    }
    print(values, flush=True)
    return max(values.values()), max(values.values()) <= 1


@measurement("panoptic quality of stuff >= 0.9, worst of 3 synthetic rooms", *PIPELINE)
def stuff_quality() -> Measured:
    value = min(structure_of_room(scene, kind, "chain")["panoptic.pq_stuff"] for scene, kind in ROOMS)
    return value, value >= 0.9


@measurement("exit status 0, 30 kills", *PIPELINE, "tests/framework/commands/running")
def random_kills() -> Measured:
    return failures("tests/framework/commands/running/test_random_kills.py", INSTANCEMAP_KILLS="30")


@measurement("exit status 0, tests marked `acceptance`", *PIPELINE, *TESTS)
def long_tests() -> Measured:
    return failures("-m", "acceptance", "tests")


@measurement(
    "0 failing commands, fresh virtual environment", "framework", "plugins", "conf", "instancemap.py", "pyproject.toml"
)
def wheel() -> Measured:
    """Build the package, install its wheel in a new environment and use it from an empty folder, as in the README."""
    example = (CHECKOUT / "README.md").read_text().split("```python\n")[1].split("```")[0]
    with tempfile.TemporaryDirectory() as directory:
        dist, tools, environment, empty = (Path(directory, name) for name in ("dist", "tools", "environment", "empty"))
        empty.mkdir()
        for folder in (tools, environment):
            venv.create(folder, with_pip=True)
        subprocess.run([tools / "bin" / "pip", "install", "-q", "build", "twine"], check=True)
        subprocess.run([tools / "bin" / "python", "-m", "build", "--outdir", dist, CHECKOUT], check=True)
        subprocess.run([tools / "bin" / "twine", "check", "--strict", *dist.iterdir()], check=True)
        programs = environment / "bin"
        install = [str(programs / "python"), "-m", "pip", "install", "-q", *map(str, dist.glob("*.whl"))]
        subprocess.run(install, check=True)
        alone = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        commands = (
            ["instancemap", "--version"],
            ["instancemap"],  # maps the demo
            ["instancemap", "hydra.run.dir=outputs/desk"],
            ["instancemap", "report", "outputs/desk"],
            ["python", "-c", example],
            ["instancemap", "new-plugin", "refiner", "my_refiner"],
            ["python", "-m", "pip", "install", "-q", "-e", "instancemap-my-refiner[test]"],
            ["pytest", "-q", "instancemap-my-refiner"],
        )
        statuses = [
            subprocess.run([programs / program, *words], cwd=empty, env=alone, check=False).returncode
            for program, *words in commands
        ]
    failed = sum(status != 0 for status in statuses)
    return failed, failed == 0
