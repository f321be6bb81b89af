"""InstanceMap: a map of object instances from RGB-D video, frame by frame.

    from instancemap import Camera, Frame, Mapper

    mapper = Mapper("fuser.voxel_size=0.02")  # what `instancemap ...` takes, with its defaults
    camera = Camera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
    for k, (color, depth) in enumerate(video):  # uint8 (480, 640, 3) RGB; float32 (480, 640) m, 0 = no reading
        pose = mapper.add(Frame(index=k, timestamp=k / 30, color=color, depth=depth, camera=camera))
        if pose.lost:
            print(f"frame {k} is not in the map: {pose.reason}")

    for instance in mapper.instances().values():
        likeliest = instance.class_probabilities.argmax()
        print(instance.id, mapper.scene.classes[likeliest], instance.obb.center, "m", instance.confidence)
    mapper.scene.save("map.npz")

`Mapper("map=outputs/demo")` goes on with the map of a run. What else a map does, also one that a run left behind:

    scene = load_map("outputs/demo/map.npz")
    mesh = scene.mesh()  # vertices, triangles, colour, instance and class of each vertex
    view = scene.render(camera, T_world_camera)  # depth, normals, colour and instances, as the camera would see them

A viewer in another thread looks at the map between two frames:

    with mapper.lock:
        mesh = mapper.scene.mesh()

Metres, seconds, radians; camera axes x right, y down, z forward; `T_a_b` maps coordinates in b to coordinates in a;
pixel centres at integers; instance 0 = none. Every fault that is yours to mend is an InstanceMapError of one line.

Stages of your own are dataclasses that implement Detector, PoseTracker, ClusterRefiner or MapFuser. They go together
as `Pipeline(detector, tracker, refiner, fuser).run(sequence)`, or are chosen by name once a YAML registers them
(CONTRIBUTING.md says how).
"""

from importlib.util import find_spec
from pathlib import Path

_own = Path(__file__).resolve().with_name("framework")
_found = find_spec("framework")
if _found is None or str(_own) not in [str(Path(place).resolve()) for place in _found.submodule_search_locations or ()]:
    raise ImportError(
        f"the package 'framework' at {_found and _found.origin} stands in the way of InstanceMap's own at {_own}: "
        "rename it, or start Python elsewhere"
    )

from framework import __version__
from framework.api import *
from framework.api import __all__
