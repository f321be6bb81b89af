"""Cache for the light of synthetic rooms, in .pytest_cache.

Import this module before a room is rendered, because baking the light of a room takes 4 s. The file name is a hash of
the room and of all modules that affect the light.
"""

from __future__ import annotations

import functools
import os
from hashlib import sha256
from pathlib import Path

import numpy as np

from framework.data import Float32
from framework.synthetic import lights, renderer
from framework.synthetic.buildings import building
from framework.synthetic.lights import Lamp
from framework.synthetic.ray_caster import RayCaster
from framework.synthetic.surfaces import Surfaces

CHECKOUT = Path(__file__).resolve().parents[2]
FOLDER = CHECKOUT / ".pytest_cache" / "lights"


def bake(surfaces: Surfaces, caster: RayCaster, lamps: list[Lamp]) -> Float32:
    """Return the irradiance (V, 3) from the cache, or compute and store it with `lights.bake`."""
    content = sha256(_code())
    arrays = [surfaces.vertices, surfaces.normals, surfaces.triangles, surfaces.materials, surfaces.material_table]
    arrays += [surfaces.instance_ids, *(a for lamp in lamps for a in (lamp.points, lamp.normals, np.array(lamp.power)))]
    for array in arrays:
        content.update(f"{array.shape} {array.dtype}".encode() + np.ascontiguousarray(array).tobytes())
    path = FOLDER / f"{content.hexdigest()}.npy"
    if path.exists():
        kept: Float32 = np.load(path)
        return kept
    light = lights.bake(surfaces, caster, lamps)
    FOLDER.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(f".{os.getpid()}")
    with unfinished.open("wb") as file:
        np.save(file, light)
    unfinished.replace(path)
    return light


@functools.cache
def _code() -> bytes:
    names = ("lights", "ray_caster", "shading_kernels", "surfaces", "paints")
    return b"".join((CHECKOUT / "framework" / "synthetic" / f"{name}.py").read_bytes() for name in names)


renderer.bake = building.bake = bake
