"""Queries for the objects and views of a map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Camera, Float32, Float64, Instance, InstanceMesh, View
from framework.errors import DataError
from framework.interfaces import SceneMap
from framework.mapping.gravity import floor_height
from framework.mapping.instances.instance_list import InstanceList, bounds_of
from framework.runtime.forked_process import ProcessLock

TOLERANCE = 1e-6  # m, maximum rounding error of a bounding box


class Map:
    """Thread-safe queries of a map, independent of the fuser.

    Mapping waits only while a query reads the map. The results do not change with the map.
    """

    scene: SceneMap
    lock: ProcessLock  # held during a query and while a frame is mapped

    def __init__(self, scene: SceneMap) -> None:
        self.scene = scene
        self.lock = ProcessLock()
        self._floor: tuple[InstanceMesh, float | None] | None = None  # height of the floor in the last mesh

    def __getstate__(self) -> dict[str, Any]:
        with self.lock:
            return {name: value for name, value in vars(self).items() if name != "lock"} | {"_floor": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, lock=ProcessLock())

    @property
    def classes(self) -> tuple[str, ...]:
        """The class names, empty before the first frame."""
        return self.scene.classes

    def instances(self, class_: str | None = None) -> Mapping[int, Instance]:
        """Return the objects by id.

        Args:
            class_: Most likely class of the returned objects; None = all objects.

        Raises:
            DataError: The class is unknown.
        """
        with self.lock:
            found, classes = self.scene.instances(), self.classes
        return found if class_ is None else _of_class(found, class_, classes)

    def name(self, instance: Instance) -> str:
        """Return the most likely class of an object, or "object" in a map without classes."""
        probabilities = instance.class_probabilities
        return self.classes[int(probabilities.argmax())] if len(probabilities) else "object"

    def nearest(self, point: Sequence[float] | Float64, class_: str | None = None) -> Instance | None:
        """Return the object whose surface is nearest to a point.

        Args:
            point: Point (3,) in the world frame, m.
            class_: Most likely class of the object; None = all classes.

        Returns:
            The object; None = no object.

        Raises:
            DataError: The point is invalid or the class is unknown.
        """
        target = np.asarray(point, np.float64)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise DataError(f"point: expected 3 finite coordinates in the world frame, m, got {point!r:.60}")
        with self.lock:
            found, classes = self.scene.instances(), self.classes
            vertices = self.scene.mesh().vertices if found else np.zeros((0, 3), np.float32)
        return _nearest(found if class_ is None else _of_class(found, class_, classes), vertices, target)

    def view(self, camera: Camera, T_world_camera: Float64) -> View:
        """Return the view of the map from a pose.

        Args:
            camera: Camera of the view.
            T_world_camera: Camera pose (4, 4).

        Returns:
            The view. Pixels of unconfirmed instances have instance 0 and class -1.
        """
        with self.lock:
            view = self.scene.render(camera, T_world_camera)
            found = self.scene.instances()
        unknown = ~np.isin(view.instance_ids, [0, *found])
        return replace(
            view,
            instance_ids=np.where(unknown, np.int32(0), view.instance_ids),
            class_ids=np.where(unknown, np.int32(-1), view.class_ids),
        )

    def at_pixel(self, u: int, v: int, camera: Camera, T_world_camera: Float64) -> Instance | None:
        """Return the object at a pixel of the view from a pose.

        Args:
            u: Column, px.
            v: Row, px.
            camera: Camera of the view.
            T_world_camera: Camera pose (4, 4).

        Returns:
            The object; None = no object at the pixel.

        Raises:
            DataError: The pixel is outside the image.
        """
        if not (0 <= u < camera.width and 0 <= v < camera.height):
            raise DataError(f"pixel: expected u, v in an image of {camera.width}x{camera.height} px, got ({u}, {v})")
        with self.lock:
            key = self.scene.instance_at(int(u), int(v), camera, T_world_camera)
            found = self.scene.instances() if key else {}
        return found.get(key)

    def up(self) -> Float64 | None:
        """Return the up direction (3,), a unit vector in the world frame, or None if unknown.

        If frames have `up`, the direction is measured by a sensor. Otherwise it is estimated from the floor, the walls
        and the camera orientation. The vertical axes of the boxes (`obb`) have this direction.
        """
        with self.lock:
            return self.scene.gravity().up

    def up_source(self) -> str:
        """Return the source of `up`: "sensor", "surfaces", or "" if unknown."""
        with self.lock:
            return self.scene.gravity().source

    def floor(self) -> float | None:
        """Return the floor height along `up` in m, or None if the floor was not observed.

        The height of a point above the floor is `point @ up - floor`.
        """
        with self.lock:
            up, mesh = self.scene.gravity().up, self.scene.mesh()
        known = self._floor
        if known is None or known[0] is not mesh:
            known = self._floor = mesh, None if up is None else floor_height(mesh.vertices, mesh.triangles, up)
        return known[1]

    def mesh(self, instance: Instance | int | None = None) -> InstanceMesh:
        """Return the surface of the map or of one object.

        Args:
            instance: Object or its id; None = the whole map.

        Raises:
            DataError: The object is unknown.
        """
        with self.lock:
            whole = self.scene.mesh()
            if instance is None:
                return whole
            instances = self.scene.instances()
        key = instance.id if isinstance(instance, Instance) else instance
        if key not in instances:
            raise DataError(f"instance: expected an id of this map, got {key!r}")
        return instances.mesh_of(key) if isinstance(instances, InstanceList) else whole.of(instances[key])

    def save(self, path: Path | str) -> None:
        """Write the map to one file, atomically. Read it with `load_map`.

        Args:
            path: Path of the file.
        """
        with self.lock:
            self.scene.save(path)


def _of_class(found: Mapping[int, Instance], class_: str, classes: tuple[str, ...]) -> Mapping[int, Instance]:
    """Return the objects whose most likely class is `class_`.

    Raises:
        DataError: The class is unknown.
    """
    if class_ not in classes:
        close = get_close_matches(class_, classes, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise DataError(f"class: expected a class of this map, got {class_!r}{hint}")
    index = classes.index(class_)
    if isinstance(found, InstanceList):  # without creating the instances
        return found.of_class(index)
    return {key: instance for key, instance in found.items() if instance.class_probabilities.argmax() == index}


def _nearest(found: Mapping[int, Instance], vertices: Float32, target: Float64) -> Instance | None:
    """Return the object whose vertices are nearest to a point (3,), m. Ties go to the first object.

    `vertices` (V, 3) are those of the map.
    """
    low, high = bounds_of(found)
    # no vertex is nearer than the bounding box of its object
    to_box = np.linalg.norm(np.maximum(np.maximum(low - target, target - high), 0), axis=1) - TOLERANCE
    ids, best = [*found], (np.inf, 0)
    for k in np.argsort(to_box):
        if to_box[k] > best[0]:
            break
        own = vertices[found[ids[k]].vertices]
        best = min(best, (float(np.linalg.norm(own - target, axis=1).min(initial=np.inf)), int(k)))
    return found[ids[best[1]]] if found else None
