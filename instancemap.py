"""InstanceMap builds object-level 3D maps from RGB-D video.

    from instancemap import Camera, Mapper

    mapper = Mapper("fuser.voxel_size=0.02")  # overrides, as on the command line
    camera = Camera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
    for color, depth in video:  # uint8 (480, 640, 3) RGB; float32 (480, 640) m, 0 = no reading
        result = mapper.add(color, depth, camera=camera)
        if result.lost:
            print(f"frame not mapped: {result.reason}")

    for instance in mapper.instances().values():
        print(instance.id, mapper.name(instance), instance.obb.center, "m", instance.confidence)
    mapper.save("map.npz")

`Mapper("resume_from=outputs/demo")` resumes the map of a run. Query a stored map:

    scene = load_map("outputs/demo/map.npz")
    chairs = scene.instances("chair")
    it = scene.nearest((1.0, 0.0, 2.0))
    mesh = scene.mesh()  # vertices, triangles, color, instance and class of each vertex; scene.mesh(it) for one object
    view = scene.view(camera, T_world_camera)  # rendered depth, normals, color and instances

`export("outputs/demo", "glb", "usd")` writes files in standard formats. `edit("outputs/demo", [{"delete": [9]}])`
corrects the instances of a run. `query("outputs/demo", "a red chair").objects` lists the matching objects, best match
first. `run("outputs/fine", "fuser.voxel_size=0.01", dataset="desk")` writes a run directory. `report` and `tables`
write its HTML report and the tables of runs. `load_runs("multirun/sweep")` returns the runs of a sweep as a data frame.
`import_map("other.ply", "outputs/other")` converts the map of another system to a run directory.

A Mapper is thread-safe; queries wait until the current frame is mapped.

Conventions: meters, seconds, radians; camera axes x right, y down, z forward; `T_a_b` maps coordinates in b to
coordinates in a; pixel centers at integers; instance 0 = no instance. User errors are InstanceMapErrors with a one-line
message.

Your own stages are dataclasses that implement Detector, FrameMasking, PoseTracker, ClusterRefiner, MapFuser or BackEnd.
Combine them with `Pipeline(detector, tracker, refiner, fuser).run(sequence)`, or register them with a YAML file
(CONTRIBUTING.md). Plugins import only `instancemap`, and their tests `instancemap.testing`.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

_own = Path(__file__).resolve().with_name("framework")
_found = find_spec("framework")
if _found is None or _own not in [Path(path).resolve() for path in _found.submodule_search_locations or ()]:
    raise ImportError(
        f"framework: expected the package of InstanceMap at {_own}, got {(_found and _found.origin) or 'none'}; rename "
        "the other package or start Python in another folder"
    )

from framework import __version__
from framework.runtime.process_settings import configure_process

__path__ = [str(_own / "testing" / "public")]  # folder of the submodule instancemap.testing
_SHARED_WITH_PLUGINS = {
    "Association": "framework.mapping.instances.association",
    "Bool": "framework.data",
    "Combine": "framework.mapping.labels.label_evidence_kernels",
    "Float32": "framework.data",
    "Float64": "framework.data",
    "FrameTruth": "framework.data",
    "InstanceMap": "framework.mapping.instance_map",
    "Int32": "framework.data",
    "Int64": "framework.data",
    "LabelRule": "framework.mapping.labels.label_rule",
    "LabeledVoxels": "framework.mapping.labels.label_rule",
    "RosLens": "framework.importing.bags.ros_camera",
    "SceneTruth": "framework.data",
    "SurfaceView": "framework.data",
    "TO_THE_END": "framework.datasets.frames.sequence_reader",
    "UInt8": "framework.data",
    "assemble": "framework.registry",
    "back_project": "framework.geometry",
    "check_bounds": "framework.config.validation",
    "choose_frames": "framework.datasets.frames.sequence_reader",
    "decode_ros_color": "framework.importing.bags.ros_images",
    "decode_ros_depth": "framework.importing.bags.ros_images",
    "exp_se3": "framework.geometry",
    "folder_of": "framework.files.search_paths",
    "inverse": "framework.geometry",
    "is_rectified": "framework.importing.bags.ros_camera",
    "keep_points": "framework.refinement.refine",
    "list_points_by_pixel": "framework.mapping.labels.pixel_lists",
    "normals_of": "framework.tracking.pyramid",
    "project": "framework.geometry",
    "ros_camera": "framework.importing.bags.ros_camera",
    "transform": "framework.geometry",
    "vote_for_best": "framework.mapping.labels.label_rule",
}
"""Module of each name that plugins may import from `instancemap` and that framework.api does not export."""

if TYPE_CHECKING:
    from framework.api import *
    from framework.api import __all__
    from framework.config.validation import check_bounds
    from framework.data import Bool, Float32, Float64, FrameTruth, Int32, Int64, SceneTruth, SurfaceView, UInt8
    from framework.datasets.frames.sequence_reader import TO_THE_END, choose_frames
    from framework.files.search_paths import folder_of
    from framework.geometry import back_project, exp_se3, inverse, project, transform
    from framework.importing.bags.ros_camera import RosLens, is_rectified, ros_camera
    from framework.importing.bags.ros_images import decode_ros_color, decode_ros_depth
    from framework.mapping.instance_map import InstanceMap
    from framework.mapping.instances.association import Association
    from framework.mapping.labels.label_evidence_kernels import Combine
    from framework.mapping.labels.label_rule import LabeledVoxels, LabelRule, vote_for_best
    from framework.mapping.labels.pixel_lists import list_points_by_pixel
    from framework.refinement.refine import keep_points
    from framework.registry import assemble
    from framework.tracking.pyramid import normals_of


def __getattr__(name: str) -> Any:
    """Import a name on first use, so that `configure_process` can run before the libraries are imported."""
    if name in _SHARED_WITH_PLUGINS:
        return getattr(import_module(_SHARED_WITH_PLUGINS[name]), name)
    if name == "__all__" or not name.startswith("_"):
        from framework import api

        if name == "__all__":
            return [*api.__all__, *_SHARED_WITH_PLUGINS]
        if name in api.__all__:
            return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *__getattr__("__all__")]
