"""A map as its users ask it: which objects there are, where, and what a camera sees of them."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Camera, Float64, Instance, InstanceMesh, View
from framework.errors import DataError
from framework.interfaces import SceneMap
from framework.mapping.gravity import floor_height


class Map:
    """The questions to a map, of whatever fuser; several threads may ask at once."""

    scene: SceneMap  # what answers them
    lock: threading.RLock  # held while one is answered, or a frame is mapped

    def __init__(self, scene: SceneMap) -> None:
        self.scene = scene
        self.lock = threading.RLock()

    def __getstate__(self) -> dict[str, Any]:
        with self.lock:
            return {name: value for name, value in vars(self).items() if name != "lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, lock=threading.RLock())

    @property
    def classes(self) -> tuple[str, ...]:
        """The names that objects can have; empty while nothing is mapped."""
        return self.scene.classes

    def instances(self, class_: str | None = None) -> Mapping[int, Instance]:
        """The objects found so far, by id; of one class, those that are most likely of it.

        Raises DataError for a class that the map does not know.
        """
        with self.lock:
            found = self.scene.instances()
            if class_ is None:
                return found
            if class_ not in self.classes:
                close = get_close_matches(class_, self.classes, n=1)
                hint = f"; did you mean {close[0]!r}?" if close else ""
                raise DataError(f"there is no class {class_!r} in this map{hint}")
            return {key: instance for key, instance in found.items() if self.name(instance) == class_}

    def name(self, instance: Instance) -> str:
        """The name of the class that an object most likely is of; "object" where the map knows no classes."""
        probabilities = instance.class_probabilities
        return self.classes[int(probabilities.argmax())] if len(probabilities) else "object"

    def nearest(self, point: Sequence[float] | Float64, class_: str | None = None) -> Instance | None:
        """The object whose surface comes nearest to a point (3,) m of the world, None where there is none."""
        where = np.asarray(point, np.float64)
        if where.shape != (3,) or not np.isfinite(where).all():
            raise DataError(f"a point is three finite numbers, metres in the world, found {point!r:.60}")
        with self.lock:
            found = self.instances(class_)
            vertices = self.scene.mesh().vertices if found else np.zeros((0, 3), np.float32)

            def distance(instance: Instance) -> float:
                apart = np.linalg.norm(vertices[instance.vertices] - where, axis=1)
                return float(apart.min(initial=np.inf))

            return min(found.values(), key=distance, default=None)

    def view(self, camera: Camera, T_world_camera: Float64) -> View:
        """What `camera` would see of the map from there. It shows no id that `instances` does not know."""
        with self.lock:
            view = self.scene.render(camera, T_world_camera)
            unknown = ~np.isin(view.instance_ids, [0, *self.scene.instances()])
        return replace(
            view,
            instance_ids=np.where(unknown, np.int32(0), view.instance_ids),
            class_ids=np.where(unknown, np.int32(-1), view.class_ids),
        )

    def at_pixel(self, u: int, v: int, camera: Camera, T_world_camera: Float64) -> Instance | None:
        """The object that `camera` would see at pixel (u, v) from there, None where it would see none.

        Raises DataError for a pixel outside the image.
        """
        if not (0 <= u < camera.width and 0 <= v < camera.height):
            raise DataError(f"the pixel ({u}, {v}) is not in the image of {camera.width}x{camera.height}")
        with self.lock:
            seen = int(self.view(camera, T_world_camera).instance_ids[int(v), int(u)])
            return self.scene.instances().get(seen)

    def up(self) -> Float64 | None:
        """The unit vector (3,) against gravity in the world, by a sensor where frames have `up`, else by floor, walls
        and how the camera was held; boxes (`obb`) stand along it. None where the map does not tell.
        """
        with self.lock:
            return self.scene.gravity().up

    def up_source(self) -> str:
        """What tells `up`: "sensor" or "surfaces"; "" where nothing does."""
        with self.lock:
            return self.scene.gravity().source

    def floor(self) -> float | None:
        """m along `up`, how high the floor is: a point is `point @ up - floor` above it. None where it was not seen."""
        with self.lock:
            up, mesh = self.scene.gravity().up, self.scene.mesh()
            return None if up is None else floor_height(mesh.vertices, mesh.triangles, up)

    def mesh(self, instance: Instance | int | None = None) -> InstanceMesh:
        """The surface of the whole map, or of one object. Raises DataError for one that there is not."""
        with self.lock:
            whole = self.scene.mesh()
            if instance is None:
                return whole
            key = instance.id if isinstance(instance, Instance) else instance
            found = self.scene.instances().get(key)
            if found is None:
                raise DataError(f"there is no instance {key!r} in this map")
            return whole.of(found)

    def save(self, path: Path | str) -> None:
        """Writes the map to one file, whole or not at all; `load_map` reads it."""
        with self.lock:
            self.scene.save(path)
