"""Export to Universal Scene Description (USD) for simulators.

The stage contains visible meshes, collision shapes and semantic labels:

    /World                      kind = assembly, z up, meters
      PhysicsScene              gravity
      room                      the rest of the room: static, collision by triangles
      chair_7                   kind = component; UsdSemantics label "class"; UsdPhysics rigid body, not enabled
        visual                  Mesh with linear displayColor
        collision               Mesh (convex hull) or Cube, purpose = guide

Each object is at the origin of its prim. It is static until `physics:rigidBodyEnabled` is set.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from framework.data import Float32, InstanceMesh, Int32, Structure, UInt8
from framework.errors import DataError
from framework.exporting.object_meshes import Coloring, Part, linear, part_colors
from framework.files.atomic_write import atomic_write
from framework.vocabulary.label_spaces import label_space_of

MISSING = "usd: expected the package usd-core, got none; run pip install 'instancemap[usd]'"
NOT_WRITTEN = "the USD library could not write the stage"
THINNEST = 0.002  # minimum side of a collision box, m; an object observed from one side may be flat
GRAVITY = 9.81  # m/s^2


class Collision(Enum):
    """The collision shape of objects."""

    HULL = "hull"  # convex hull, or the box of a flat object
    BOX = "box"


def check_usd() -> None:
    """Check that USD is installed.

    Raises:
        DataError: USD is not installed. The message contains the installation command.
    """
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise DataError(MISSING) from error


def write_usd(
    path: Path, parts: Sequence[Part], coloring: Coloring = Coloring.APPEARANCE,
    collision: Collision = Collision.HULL, comments: Sequence[str] = (),
) -> None:  # fmt: skip
    """Write parts as a USD stage in the room frame. The file is deterministic.

    Raises:
        DataError: The package usd-core is not installed.
    """
    check_usd()
    from pxr import Gf, Kind, Tf, Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World")
    Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
    stage.SetDefaultPrim(world.GetPrim())
    physics = UsdPhysics.Scene.Define(stage, "/World/PhysicsScene")
    physics.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    physics.CreateGravityMagnitudeAttr(GRAVITY)
    for part, colors in zip(parts, part_colors(parts, coloring), strict=True):
        if part.object is None:
            _add_rest(stage, part, colors)
        else:
            _add_object(stage, part, colors, collision)
    stage.GetRootLayer().comment = "\n".join(comments)
    with atomic_write(path) as temporary:
        try:
            written = stage.GetRootLayer().Export(str(temporary))
        except Tf.ErrorException as error:
            raise OSError(NOT_WRITTEN) from error
        if not written:
            raise OSError(NOT_WRITTEN)


def _add_rest(stage: Any, part: Part, colors: UInt8) -> None:
    from pxr import UsdPhysics

    if not len(part.mesh.triangles):
        return
    mesh = _add_mesh(stage, f"/World/{part.name}", part.mesh.vertices, part.mesh.triangles)
    _color(mesh, colors)
    _add_structure(mesh, part.mesh)
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.none)


def _add_structure(mesh: Any, labeled: InstanceMesh) -> None:
    """Add a subset of the faces of each kind of structure, such as `floor`, with its name as semantic label."""
    from pxr import UsdGeom, UsdSemantics, Vt

    if labeled.structure is None:
        return
    kinds = labeled.structure[labeled.triangles]
    same = (kinds == kinds[:, :1]).all(axis=1)
    for kind in Structure:
        faces = np.flatnonzero(same & (kinds[:, 0] == kind)).astype(np.int32)
        if kind is Structure.NONE or not len(faces):
            continue
        name = kind.name.lower()
        indices = Vt.IntArray.FromNumpy(faces)
        subset = UsdGeom.Subset.CreateGeomSubset(mesh, name, UsdGeom.Tokens.face, indices, "structure")
        UsdSemantics.LabelsAPI.Apply(subset.GetPrim(), "class").CreateLabelsAttr(Vt.TokenArray([name]))


def _add_object(stage: Any, part: Part, colors: UInt8, collision: Collision) -> None:
    from pxr import Gf, Kind, Usd, UsdGeom, UsdPhysics, UsdSemantics, Vt

    one = part.object
    assert one is not None
    root = UsdGeom.Xform.Define(stage, f"/World/{part.name}")
    prim = root.GetPrim()
    root.AddTransformOp().Set(Gf.Matrix4d(part.T_room_part.T.tolist()))  # USD uses row vectors
    Usd.ModelAPI(prim).SetKind(Kind.Tokens.component)
    UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr(Vt.TokenArray([one.class_name]))
    prim.SetCustomDataByKey("instancemap:id", one.id)
    prim.SetCustomDataByKey("instancemap:label_space", label_space_of(part.mesh.classes))
    prim.SetCustomDataByKey("instancemap:confidence", one.confidence)
    prim.SetCustomDataByKey("instancemap:exists", one.existence)
    if one.probability is not None:
        prim.SetCustomDataByKey("instancemap:probability", one.probability)
    UsdPhysics.RigidBodyAPI.Apply(prim).CreateRigidBodyEnabledAttr(False)
    if len(part.mesh.triangles):
        _color(_add_mesh(stage, f"{prim.GetPath()}/visual", part.mesh.vertices, part.mesh.triangles), colors)
    _add_proxy(stage, f"{prim.GetPath()}/collision", part.mesh.vertices, collision)


def _add_proxy(stage: Any, path: str, vertices: Float32, collision: Collision) -> None:
    """Add the invisible collision shape of an object at the prim path `path`."""
    from pxr import Gf, UsdGeom, UsdPhysics

    hull = convex_hull(vertices) if collision is Collision.HULL else None
    if hull is not None:
        shape = _add_mesh(stage, path, *hull)
        UsdPhysics.MeshCollisionAPI.Apply(shape.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
    else:
        low, high = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
        shape = UsdGeom.Cube.Define(stage, path)
        shape.CreateSizeAttr(1.0)
        shape.CreateExtentAttr([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
        shape.AddTranslateOp().Set(Gf.Vec3d(*((low + high) / 2).tolist()))
        shape.AddScaleOp().Set(Gf.Vec3f(*np.maximum(high - low, THINNEST).tolist()))
    shape.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())


def _add_mesh(stage: Any, path: str, vertices: Float32, triangles: Int32) -> Any:
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices, np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles.ravel(), np.int32)))
    mesh.CreateExtentAttr([tuple(vertices.min(axis=0).tolist()), tuple(vertices.max(axis=0).tolist())])
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return mesh


def _color(mesh: Any, colors: UInt8) -> None:
    from pxr import UsdGeom, Vt

    display = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    display.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(linear(colors))))


def convex_hull(vertices: Float32) -> tuple[Float32, Int32] | None:
    """Return the convex hull of points (M, 3), m, or None if the hull has no volume.

    Returns:
        The vertices (H, 3), m, and the triangles (F, 3) with outward normals.
    """
    try:
        hull = ConvexHull(vertices.astype(np.float64))
    except (QhullError, ValueError):
        return None
    points, outward = vertices[hull.vertices], hull.equations[:, :3]
    number = np.zeros(len(vertices), np.int32)
    number[hull.vertices] = np.arange(len(hull.vertices), dtype=np.int32)
    a, b, c = (vertices[hull.simplices[:, k]].astype(np.float64) for k in range(3))
    inward = (np.cross(b - a, c - a) * outward).sum(axis=1) < 0
    triangles = number[hull.simplices]
    triangles[inward] = triangles[inward][:, ::-1]
    return points, triangles
