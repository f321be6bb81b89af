"""Small input files for options that require user files. The contract tests use these files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from framework.commands.running.detect import write_detections, write_labels
from framework.datasets.scenenn.scene_files import write_intrinsics, write_trajectory_log
from framework.files.tum_trajectory import write_tum
from tests.support.recordings.recordings import write_color, write_depth
from tests.support.recordings.scannet_files import shots, write_sens
from tests.support.scenes.corner_room import CAMERA, CLASSES, CornerRoom, SphereDetector, pose_at
from tests.support.scenes.fake_cameras import FakeCamera, orbbec_module, realsense_module

FRAMES = 3


def modules(stage: str, name: str) -> dict[str, ModuleType]:
    """Return the fake device libraries that an option needs, keyed by module name."""
    plugged_in = {
        ("dataset", "orbbec"): {"pyorbbecsdk": orbbec_module(FakeCamera())},
        ("dataset", "realsense"): {"pyrealsense2": realsense_module(FakeCamera())},
    }
    return plugged_in.get((stage, name), {})


def overrides(stage: str, name: str, folder: Path) -> list[str]:
    """Write the files that an option needs to `folder`, and return its overrides."""
    write = WRITERS.get((stage, name))
    return write(folder) if write else []


def _images(color: str, depth: str, first: int = 0) -> None:
    """Write the color and depth (mm) images of the corner room. The names contain frame numbers from `first` on."""
    for frame in CornerRoom(frames=FRAMES):
        for path, image in (
            (Path(color.format(first + frame.index)), frame.color[..., ::-1]),
            (Path(depth.format(first + frame.index)), (frame.depth * 1000).astype(np.uint16)),
        ):
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), image)


def _replica_nice_slam(root: Path) -> list[str]:
    _images(f"{root}/room0/results/frame{{:06d}}.jpg", f"{root}/room0/results/depth{{:06d}}.png")
    camera = {"w": CAMERA.width, "h": CAMERA.height, "fx": 90.0, "fy": 90.0, "cx": 47.5, "cy": 35.5, "scale": 1000.0}
    (root / "cam_params.json").write_text(json.dumps({"camera": camera}))
    np.savetxt(root / "room0" / "traj.txt", [pose_at(k).ravel() for k in range(FRAMES)])
    return [f"dataset.root={root}", "dataset.scene=room0"]


def _icl_nuim(root: Path) -> list[str]:
    scene = root / "living_room_traj0_frei_png"
    for k in range(FRAMES):
        write_color(scene / f"rgb/{k}.png", (40 * k, 100, 200))
        write_depth(scene / f"depth/{k}.png", 10000)
    write_tum(scene / "livingRoom0.gt.freiburg", list(range(FRAMES)), [pose_at(k) for k in range(FRAMES)])
    return [f"dataset.root={root}", f"dataset.scene={scene.name}"]


def _folder_watch(root: Path) -> list[str]:
    _rgbd_folder(root)
    (root / "end").touch()
    return [f"dataset.root={root}"]


def _camera(_: Path) -> list[str]:
    return [f"dataset.width={CAMERA.width}", f"dataset.height={CAMERA.height}"]


def _rgbd_folder(root: Path) -> list[str]:
    _images(f"{root}/color/{{:06d}}.png", f"{root}/depth/{{:06d}}.png")
    camera = {"width": CAMERA.width, "height": CAMERA.height, "fx": 90.0, "fy": 90.0, "cx": 47.5, "cy": 35.5}
    (root / "camera.json").write_text(json.dumps(camera | {"depth_scale": 1000.0}))
    write_tum(root / "poses.txt", [k / 30 for k in range(FRAMES)], [pose_at(k) for k in range(FRAMES)])
    (root / "instance").mkdir()
    for frame in CornerRoom(frames=FRAMES):
        assert frame.truth is not None
        cv2.imwrite(f"{root}/instance/{frame.index:06d}.png", frame.truth.instance_ids.astype(np.uint16))
    named = {str(k): {"name": name, "class": name} for k, name in enumerate(CLASSES, start=1)}
    (root / "instances.json").write_text(json.dumps(named))
    return [f"dataset.root={root}"]


def _scannet(root: Path) -> list[str]:
    write_sens(root / "scene0000_00" / "scene0000_00.sens", shots(FRAMES))
    return [f"dataset.root={root}", "dataset.scene=scene0000_00"]


def _scenenn(root: Path) -> list[str]:
    _images(f"{root}/011/image/image{{:05d}}.png", f"{root}/011/depth/depth{{:05d}}.png", first=1)
    (root / "intrinsic").mkdir()
    write_intrinsics(root / "intrinsic" / "asus.ini", CAMERA)
    write_trajectory_log(root / "011" / "trajectory.log", {k: pose_at(k) for k in range(FRAMES)})
    return [f"dataset.root={root}"]


def _seven_scenes(root: Path) -> list[str]:
    for k in range(FRAMES):
        write_color(root / f"frame-{k:06d}.color.png", (40 * k, 100, 200))
        write_depth(root / f"frame-{k:06d}.depth.png", 2000)
        np.savetxt(root / f"frame-{k:06d}.pose.txt", pose_at(k))
    return [f"dataset.root={root}"]


def _synthetic_building(folder: Path) -> list[str]:
    small = ("rooms=4", "designs=1", "frames=60", f"width={CAMERA.width}", f"height={CAMERA.height}")
    return [f"dataset.{parameter}" for parameter in (*small, f"cache_dir={folder}")]


def _synthetic(_: Path) -> list[str]:
    return [f"dataset.frames={FRAMES}", "dataset.width=160", "dataset.height=120"]


def _tum_rgbd(root: Path) -> list[str]:
    for k in range(FRAMES):
        write_color(root / "rgb" / f"{k}.png", (40 * k, 100, 200))
        write_depth(root / "depth" / f"{k}.png", 10_000)
    for name in ("rgb", "depth"):
        (root / f"{name}.txt").write_text("".join(f"{k / 30:.6f} {name}/{k}.png\n" for k in range(FRAMES)))
    write_tum(root / "groundtruth.txt", [k / 30 for k in range(FRAMES)], [pose_at(k) for k in range(FRAMES)])
    return [f"dataset.root={root}", "dataset.intrinsics=FREIBURG1"]


def _mask_rcnn(folder: Path) -> list[str]:
    from tests.support.networks.tiny_mask_rcnn import tiny_network_file

    return [f"detector.weights={tiny_network_file(folder)}"]


def _onnx_boxes(folder: Path) -> list[str]:
    """Write a network with an input of 32x32 px and two boxes of 16 px, in the layout of YOLOX."""
    pytest.importorskip("onnx")
    from tests.support.networks.tiny_networks import constant_network

    (folder / "labels.txt").write_text("\n".join(CLASSES))
    rows = np.zeros((21, 5 + len(CLASSES)))
    rows[[5, 10]] = [[0.5, 0.5, np.log(2), np.log(2), 0.9, 0.7, 0.1], [0, 0, np.log(2), np.log(2), 0.8, 0.1, 0.6]]
    weights = constant_network(folder / "tiny.onnx", (1, 3, 32, 32), {"output": rows[None]})
    return [f"detector.weights={weights}", f"detector.label_space={folder / 'labels.txt'}"]


def _onnx_segmentation(folder: Path) -> list[str]:
    """Write a network with two boxes. The masks are the left half and the lower half of the image."""
    pytest.importorskip("onnx")
    from tests.support.networks.tiny_networks import constant_network

    (folder / "labels.txt").write_text("\n".join(CLASSES))
    ramp = np.tile(np.arange(40) - 20.0, (40, 1))
    rows = np.array([[30, 40, 30, 20, 0.6, 0.1, -1, 0], [40, 50, 20, 20, 0.05, 0.4, 0, 1]])
    outputs = {"output0": rows.T[None], "output1": np.stack([ramp, ramp.T])[None]}
    weights = constant_network(folder / "tiny.onnx", (1, 3, 80, 80), outputs)
    return [f"detector.weights={weights}", f"detector.label_space={folder / 'labels.txt'}"]


def _precomputed(folder: Path) -> list[str]:
    path = folder / "detections.json"
    write_detections(path, SphereDetector(), CornerRoom())
    return [f"detector.path={path}", f"detector.label_space={write_labels(path, SphereDetector().classes)}"]


def _transformers_segmentation(folder: Path) -> list[str]:
    pytest.importorskip("transformers")
    from tests.support.networks.tiny_transformers import write_network

    return [f"detector.model={write_network(folder, 'mask2former')}", "detector.score_threshold=0.02"]


def _with_embeddings(folder: Path) -> list[str]:
    pytest.importorskip("transformers")
    from tests.support.networks.tiny_image_text import write_image_text

    return [f"detector.model={write_image_text(folder)}", "detector.min_pixels=20"]


def _open_vocabulary(folder: Path) -> list[str]:
    pytest.importorskip("transformers")
    from tests.support.networks.tiny_open_vocabulary import write_owlv2, write_sam

    boxes, masks = write_owlv2(folder / "owlv2"), write_sam(folder / "sam", "sam")
    return [f"detector.model={boxes}", f"detector.mask_model={masks}", "detector.text_queries=[red chair,bed]"]


def _rf_detr_seg(folder: Path) -> list[str]:
    pytest.importorskip("transformers")
    from tests.support.networks.tiny_transformers import write_network

    return [f"detector.model={write_network(folder, 'rf_detr')}", "detector.score_threshold=0.02"]


def _trajectory_file(folder: Path) -> list[str]:
    frames = range(len(CornerRoom()))
    write_tum(folder / "poses.txt", [k / 30 for k in frames], [pose_at(k) for k in frames])
    return [f"tracker.path={folder / 'poses.txt'}"]


def _mlflow(folder: Path) -> list[str]:
    pytest.importorskip("mlflow", reason="requires mlflow-skinny (extra mlflow)")
    return [f"viewer.tracking_uri=sqlite:///{folder / 'mlflow.db'}"]


def _rerun(_: Path) -> list[str]:
    pytest.importorskip("rerun", reason="requires rerun-sdk (extra viewer)")
    return []


def _tensorboard(_: Path) -> list[str]:
    pytest.importorskip("tensorboard", reason="requires tensorboard (extra tensorboard)")
    return []


def _wandb(_: Path) -> list[str]:
    pytest.importorskip("wandb", reason="requires wandb (extra wandb)")
    return []


WRITERS: dict[tuple[str, str], Callable[[Path], list[str]]] = {
    ("dataset", "folder_watch"): _folder_watch,
    ("dataset", "icl_nuim"): _icl_nuim,
    ("dataset", "orbbec"): _camera,
    ("dataset", "realsense"): _camera,
    ("dataset", "replica_nice_slam"): _replica_nice_slam,
    ("dataset", "rgbd_folder"): _rgbd_folder,
    ("dataset", "scannet"): _scannet,
    ("dataset", "scenenn"): _scenenn,
    ("dataset", "seven_scenes"): _seven_scenes,
    ("dataset", "synthetic"): _synthetic,
    ("dataset", "synthetic_building"): _synthetic_building,
    ("dataset", "tum_rgbd"): _tum_rgbd,
    ("detector", "mask_rcnn"): _mask_rcnn,
    ("detector", "onnx_boxes"): _onnx_boxes,
    ("detector", "onnx_segmentation"): _onnx_segmentation,
    ("detector", "open_vocabulary"): _open_vocabulary,
    ("detector", "precomputed"): _precomputed,
    ("detector", "rf_detr_seg"): _rf_detr_seg,
    ("detector", "transformers_segmentation"): _transformers_segmentation,
    ("detector", "with_embeddings"): _with_embeddings,
    ("tracker", "trajectory_file"): _trajectory_file,
    ("viewer", "mlflow"): _mlflow,
    ("viewer", "rerun"): _rerun,
    ("viewer", "tensorboard"): _tensorboard,
    ("viewer", "wandb"): _wandb,
}
