"""Open3D's VoxelBlockGrid, with workarounds for errors in Open3D 0.20.

See Dong et al., "ASH: A modern framework for parallel spatial hashing in 3D perception", 2022.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import open3d as o3d
from open3d.core import Tensor

from framework.config.validation import check_bounds
from framework.data import Array, Bool, Camera, Float32, Float64, Frame, Int32, Int64, SurfaceView, UInt8, check_view
from framework.errors import MapFullError
from framework.geometry import inverse
from framework.mapping.storage.map_file import check_blocks, check_like
from framework.mapping.storage.map_header import MapHeader
from framework.mapping.voxels.integration_parameters import BOUNDS
from framework.mapping.voxels.voxel_grid import MAX_BLOCKS

ATTRIBUTES = {  # name: (type, channels) of a voxel; Open3D's `integrate` expects the first three
    "tsdf": (o3d.core.float32, 1),  # in truncation distances
    "weight": (o3d.core.float32, 1),  # number of observations
    "color": (o3d.core.float32, 3),  # in [0, 255]
    "instance": (o3d.core.int32, 1),  # 0 = no instance
    "votes": (o3d.core.float32, 1),  # votes for the instance minus votes against it
}
FIRST_BLOCKS = 1000  # maximum initial capacity, blocks; Open3D allocates it immediately
FIRST_VOXELS = 2**23  # maximum initial capacity, voxels; 0.2 GB
METERS = 1.0  # depth_scale of Open3D: units of a float image per meter
TOUCH_STRIDE = 4  # stride of the block search of Open3D, px
NEAR = 0.05  # start depth of rays, m
RANGE_TILE = 8  # side of a tile with common depth bounds in the range map, px; the default of Open3D
FRAGMENTS = 2**18  # capacity of the range map, fragments; a view of 10,000 blocks has 20,000 fragments
FRAGMENT = 16 * 16  # number of range map pixels per fragment
MAX_RANGE_PIXELS = 2**24  # maximum number of pixels of the first range map
CPU = o3d.core.Device("CPU:0")


@dataclass(frozen=True)
class BlockGridSettings:
    """Parameters of the voxel blocks."""

    voxel_size: float  # side of a voxel, m
    block_resolution: int  # number of voxels per side of a block
    truncation: float  # truncation distance, in voxels
    min_depth: float  # minimum depth of integrated readings, m
    max_depth: float  # maximum depth of integrated readings, m
    max_blocks: int  # block budget
    min_weight: float  # minimum number of observations of a surface voxel

    def __post_init__(self) -> None:
        check_bounds(self, block_resolution=(2, 64), max_blocks=(1, MAX_BLOCKS), min_weight=(1.0, 1e6))

    @classmethod
    def of(cls, saved: MapHeader) -> BlockGridSettings:
        """Return the settings in the header of a map file.

        Raises:
            DataError: If a value is missing or invalid.
            ConfigError: If a parameter is outside its bounds.
        """
        return cls(
            voxel_size=saved.number("voxel_size", BOUNDS["voxel_size"]),
            block_resolution=saved.whole("block_resolution"),
            truncation=saved.number("truncation", (1.0, 100.0)),
            min_depth=saved.number("min_depth", BOUNDS["min_depth"]),
            max_depth=saved.number("max_depth", BOUNDS["max_depth"]),
            max_blocks=saved.whole("max_blocks"),
            min_weight=saved.number("min_weight"),
        )


class BlockGrid:
    """Voxel blocks with signed distances, colors and instance votes.

    Flat indices of voxels are indices into the arrays of `flat`.
    """

    def __init__(self, settings: BlockGridSettings) -> None:
        self.settings = settings
        self.frames = 0  # number of integrated frames
        self.blocks = o3d.t.geometry.VoxelBlockGrid(
            attr_names=list(ATTRIBUTES),
            attr_dtypes=[dtype for dtype, _ in ATTRIBUTES.values()],
            attr_channels=[o3d.core.SizeVector([channels]) for _, channels in ATTRIBUTES.values()],
            voxel_size=settings.voxel_size,
            block_resolution=settings.block_resolution,
            block_count=min(FIRST_BLOCKS, settings.max_blocks, FIRST_VOXELS // settings.block_resolution**3),
            device=CPU,
        )
        self._reserve_range_map()

    def _reserve_range_map(self) -> None:
        """Allocate the range map of Open3D by ray casting a large image.

        Open3D allocates the range map for the first image. If it is too small, later views have holes.
        """
        side = int(np.ceil(np.sqrt(min(FRAGMENTS * FRAGMENT * self.settings.voxel_size, MAX_RANGE_PIXELS))))
        nowhere = Tensor(np.zeros((1, 3), np.int32))
        self.blocks.ray_cast(
            nowhere, Tensor(np.eye(3)), Tensor(np.eye(4)), side, side, ["depth"], METERS, range_map_down_factor=1
        )

    @property
    def block_count(self) -> int:
        return int(self.blocks.hashmap().size())

    @property
    def voxel_count(self) -> int:
        return self.block_count * int(self.settings.block_resolution**3)

    @property
    def byte_count(self) -> int:
        """Size of the blocks in use, bytes."""
        return self.voxel_count * sum(dtype.byte_size() * channels for dtype, channels in ATTRIBUTES.values())

    @property
    def min_weight(self) -> float:
        """Minimum weight of surface voxels, reduced in the first frames."""
        return min(self.settings.min_weight, float(self.frames))

    def integrate(self, frame: Frame, T_world_camera: Float64) -> None:
        """Integrate one frame.

        Raises:
            MapFullError: If the map needs too many blocks. The frame is then not integrated.
        """
        s = self.settings
        depth = self._usable(frame.depth)
        if not depth.any():
            return  # Open3D would raise an error
        blocks = self._touched(depth, frame.camera, T_world_camera, s.truncation)
        self._make_room(blocks)
        view = _tensors(frame.camera, T_world_camera, 0.5)
        image = _image(depth)
        color = _image(frame.color.astype(np.float32) / np.float32(255))  # Open3D requires both images as float
        self.blocks.integrate(blocks, image, color, *view, METERS, s.max_depth, s.truncation)
        self.frames += 1

    def _usable(self, depth: Float32) -> Float32:
        s = self.settings
        return np.where((depth >= s.min_depth) & (depth <= s.max_depth), depth, np.float32(0))

    def _touched(self, depth: Float32, camera: Camera, T_world_camera: Float64, band: float) -> Tensor:
        """Return the coordinates (B, 3) of the blocks within `band` voxels of the depth readings."""
        # Open3D samples every 4th pixel of every 4th row. Enlarge the image if the samples are more than half a block
        # apart, because the map would have holes.
        s = self.settings
        distance = TOUCH_STRIDE * float(depth.max()) / min(camera.fx, camera.fy)
        scale = min(int(np.ceil(distance / (s.block_resolution * s.voxel_size / 2))), TOUCH_STRIDE)
        if not depth[::TOUCH_STRIDE, ::TOUCH_STRIDE].any():  # Open3D would raise an error
            scale = TOUCH_STRIDE
        if scale > 1:
            depth = depth.repeat(scale, axis=0).repeat(scale, axis=1)
            camera = camera.scaled(scale)
        view = _tensors(camera, T_world_camera)
        return self.blocks.compute_unique_block_coordinates(_image(depth), *view, METERS, s.max_depth, band)

    def _make_room(self, blocks: Tensor) -> None:
        """Grow the hash map so that it can store the given blocks.

        Raises:
            MapFullError: If there are more than `max_blocks`. Open3D itself has no limit.
        """
        hashmap = self.blocks.hashmap()
        new = blocks.shape[0]
        if hashmap.size():
            new -= int(np.count_nonzero(hashmap.find(blocks)[1].numpy()))
        needed = hashmap.size() + new
        if needed > self.settings.max_blocks:
            raise MapFullError(
                f"fuser.max_blocks: expected at most {self.settings.max_blocks} blocks of "
                f"{self.settings.block_resolution}^3 voxels in the map ({self.byte_count / 2**20:.0f} MiB in use), got "
                f"{needed}; raise fuser.max_blocks or fuser.voxel_size"
            )
        if needed > hashmap.capacity():
            hashmap.reserve(min(max(needed, 2 * hashmap.capacity()), self.settings.max_blocks))

    def voxels_seen(self, frame: Frame, T_world_camera: Float64, mask: Bool, band: float) -> tuple[Int64, Int64]:
        """Return the flat indices (V,) of voxels near the measured surface, and the flat indices (V,) of their pixels.

        The method follows integrate_custom.py in the examples of Open3D.

        Args:
            frame: The frame.
            T_world_camera: The camera pose (4, 4).
            mask: The pixels (H, W) to use.
            band: The maximum difference between the depth of a voxel and the reading at its pixel, voxels.
        """
        camera = frame.camera
        usable = self._usable(frame.depth)
        depth = usable * mask
        if not depth.any():
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        around = cv2.dilate(mask.astype(np.uint8), np.ones((2 * TOUCH_STRIDE - 1,) * 2, np.uint8))
        blocks = self._touched(usable * around, camera, T_world_camera, band)
        indices, known = self.blocks.hashmap().find(blocks)
        points, voxels = self.blocks.voxel_coordinates_and_flattened_indices(indices[known])
        K, T_camera_world = (tensor.to(o3d.core.float32) for tensor in _tensors(camera, T_world_camera))
        uvz = K @ (T_camera_world[:3, :3] @ points.T() + T_camera_world[:3, 3:])
        z = uvz[2].numpy()
        u = (uvz[0] / uvz[2]).round().to(o3d.core.int32).numpy()
        v = (uvz[1] / uvz[2]).round().to(o3d.core.int32).numpy()
        inside = np.flatnonzero((z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height))
        pixels = v[inside] * np.int64(camera.width) + u[inside]
        readings = depth.ravel()[pixels]
        near = (readings > 0) & (np.abs(readings - z[inside]) <= band * self.settings.voxel_size)
        return voxels.numpy().ravel()[inside[near]], pixels[near]

    def voxels_at(self, points_world: Float32) -> Int64:
        """Return the flat index (P,) of the voxel nearest to each world point (P, 3), m, -1 = not allocated."""
        if not len(points_world) or not self.block_count:
            return np.full(len(points_world), -1)
        r = self.settings.block_resolution
        nearest = np.rint(points_world / np.float32(self.settings.voxel_size)).astype(np.int32)
        blocks = nearest // r
        indices, known = (tensor.numpy() for tensor in self.blocks.hashmap().find(Tensor(blocks)))
        x, y, z = (nearest - r * blocks).T
        return np.where(known, indices.astype(np.int64) * r**3 + (z * r + y) * r + x, -1)  # x varies fastest

    def flat(self, attribute: str) -> npt.NDArray[Any]:
        """Return a writable, flat view of one attribute of all voxels, including unused blocks."""
        return np.asarray(self.blocks.attribute(attribute).numpy()).reshape(-1)

    def ray_cast(self, camera: Camera, T_world_camera: Float64) -> SurfaceView:
        """Return the visible surface without labels.

        Raises:
            DataError: If the camera or its pose is invalid.
        """
        check_view(camera, T_world_camera)
        depth, normals, color = _blank(camera)
        blocks, far = self._blocks_in_view(camera, T_world_camera)
        if len(blocks):
            found = self._cast(blocks, far, camera, T_world_camera)
            z = found["depth"][..., 0]
            length = np.linalg.norm(found["normal"], axis=-1)
            seen = (z > 0) & (length > 0.5)  # Open3D normalizes all valid normals
            behind = self._distance(found["index"][seen], found["interp_ratio"][seen] * found["mask"][seen])
            depth[seen] = np.maximum(z[seen] + behind, NEAR)
            normals[seen] = _towards(camera, T_world_camera, found["normal"] / np.maximum(length, 0.5)[..., None])[seen]
            color[seen] = np.rint(255 * found["color"][seen]).astype(np.uint8)
        return SurfaceView(camera, T_world_camera, depth, normals, color)

    def _cast(self, blocks: Int32, far: float, camera: Camera, T_world_camera: Float64) -> dict[str, npt.NDArray[Any]]:
        """Return the results (H, W, channels) of Open3D's ray casting by name."""
        names = ("depth", "normal", "color", "index", "mask", "interp_ratio")
        # the range map omits incomplete tiles
        width, height = (RANGE_TILE * int(np.ceil(side / RANGE_TILE)) for side in (camera.width, camera.height))
        hit = self.blocks.ray_cast(
            Tensor(blocks),
            *_tensors(camera, T_world_camera),
            width,
            height,
            names,
            METERS,
            NEAR,
            far,
            self.min_weight,
            self.settings.truncation,
            RANGE_TILE,
        )
        return {name: hit[name].numpy()[: camera.height, : camera.width] for name in names}

    def _distance(self, corners: Int64, weights: Float32) -> Float32:
        """Return the signed distance (P,), m, interpolated between voxels.

        Rays of Open3D sample the distance at coordinates rounded down to voxels, and end half a voxel too far along
        each axis. Adding this distance to the depth corrects the error.

        Args:
            corners: The flat indices (P, 8) of the voxels.
            weights: The interpolation weights (P, 8), 0 = unobserved voxel.
        """
        total = np.maximum(weights.sum(axis=1), np.float32(1e-6))
        tsdf = (self.flat("tsdf")[corners] * weights).sum(axis=1) / total
        return np.asarray(tsdf * np.float32(self.settings.truncation * self.settings.voxel_size), np.float32)

    def _blocks_in_view(self, camera: Camera, T_world_camera: Float64) -> tuple[Int32, float]:
        """Return the coordinates (B, 3) of the blocks in view, and an upper bound of their depth, m."""
        coords = self.block_coords()
        side = self.settings.block_resolution * self.settings.voxel_size
        radius = side * np.sqrt(3) / 2
        T_camera_world = inverse(T_world_camera)
        x, y, z = T_camera_world[:3, :3] @ ((coords + 0.5) * side).T + T_camera_world[:3, 3:]
        seen = z > -radius
        # a block is in view if its center is at most `radius` outside each side of the view frustum
        for sideways, focal, center, size in (
            (x, camera.fx, camera.cx, camera.width),
            (y, camera.fy, camera.cy, camera.height),
        ):
            low, high = (-0.5 - center) / focal, (size - 0.5 - center) / focal
            seen &= (sideways - low * z > -radius * np.hypot(1, low)) & (
                high * z - sideways > -radius * np.hypot(1, high)
            )
        return coords[seen], float(z[seen].max(initial=0) + radius)

    def block_coords(self) -> Int32:
        """Return the coordinates (B, 3) of the blocks in use."""
        if not self.block_count:
            return np.zeros((0, 3), np.int32)
        hashmap = self.blocks.hashmap()
        # the order differs between runs
        return np.asarray(hashmap.key_tensor().numpy()[hashmap.active_buf_indices().numpy()], np.int32)

    def extract(self) -> tuple[Float32, Int32, UInt8]:
        """Return the vertices (V, 3), m, triangles (F, 3) and colors (V, 3), RGB, of the mesh.

        Their order is deterministic.
        """
        if self.block_count:
            # weights are integers; the threshold is exclusive in marching cubes and inclusive in ray casting
            mesh = self.blocks.extract_triangle_mesh(self.min_weight - 0.5)
            if mesh.triangle.indices.shape[0]:
                colors = np.rint(255 * mesh.vertex.colors.numpy()).astype(np.uint8)
                return _in_order(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), colors)
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8)

    def arrays(self) -> dict[str, Array]:
        """Return the arrays for a map file, in a deterministic order."""
        # not Open3D's `save`, which terminates the process if the disk is full
        coords = self.block_coords()
        order = np.lexsort(coords.T)
        blocks = self.blocks.hashmap().active_buf_indices().numpy()[order] if len(coords) else order
        values = {name: self.blocks.attribute(name).numpy()[blocks] for name in ATTRIBUTES}
        return {"block_coords": coords[order], **values}

    def fill(self, arrays: Mapping[str, Array]) -> None:
        """Copy the arrays of a map file into this empty grid."""
        values = {name: self.blocks.attribute(name).numpy() for name in ATTRIBUTES}
        expected = {"block_coords": np.zeros((0, 3), np.int32), **values}
        check_like(arrays, expected, len(arrays["block_coords"]))
        if len(arrays["block_coords"]):
            check_blocks(arrays["block_coords"])
            coords = Tensor(arrays["block_coords"])
            self._make_room(coords)
            blocks = self.blocks.hashmap().activate(coords)[0].numpy()
            for name in ATTRIBUTES:
                self.blocks.attribute(name).numpy()[blocks] = arrays[name]


def _tensors(camera: Camera, T_world_camera: Float64, half: float = 0.0) -> tuple[Tensor, Tensor]:
    """Return the camera matrix (3, 3), px, and T_camera_world (4, 4) as tensors.

    `half` is added to the principal point. The integration of Open3D truncates pixel coordinates instead of rounding
    them, so it needs 0.5 px.
    """
    K = camera.K
    K[:2, 2] += half
    return Tensor(K), Tensor(inverse(T_world_camera))


def _image(pixels: Float32) -> o3d.t.geometry.Image:
    return o3d.t.geometry.Image(Tensor(np.ascontiguousarray(pixels)))


def _blank(camera: Camera) -> tuple[Float32, Float32, UInt8]:
    shape = camera.shape
    return np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.uint8)


def _rays(camera: Camera, T_world_camera: Float64) -> Float32:
    """Return the world-frame rays (H, W, 3) of the pixels, scaled to unit depth."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    x, y = (u - np.float32(camera.cx)) / np.float32(camera.fx), (v - np.float32(camera.cy)) / np.float32(camera.fy)
    R = T_world_camera[:3, :3].astype(np.float32)
    return np.stack([x * R[i, 0] + y * R[i, 1] + R[i, 2] for i in range(3)], axis=-1)


def points_of(surface: SurfaceView) -> Float32:
    """Return the surface points (H, W, 3) in the world frame, m, or the camera center where there is no surface."""
    points = _rays(surface.camera, surface.T_world_camera)
    points *= surface.depth[..., None]
    points += surface.T_world_camera[:3, 3].astype(np.float32)
    return points


def _towards(camera: Camera, T_world_camera: Float64, normals_camera: Float32) -> Float32:
    """Return the normals (H, W, 3) in the world frame, flipped toward the camera."""
    normals = normals_camera @ T_world_camera[:3, :3].T.astype(np.float32)
    away = np.einsum("hwi,hwi->hw", normals, _rays(camera, T_world_camera)) > 0
    normals[away] *= -1
    return normals


def _in_order(vertices: Float32, triangles: Int32, colors: UInt8) -> tuple[Float32, Int32, UInt8]:
    """Merge equal vertices, and return the mesh in a deterministic order."""
    order = np.lexsort(vertices.T)
    sorted_vertices = vertices[order]
    is_new = np.ones(len(order), np.bool_)
    is_new[1:] = (sorted_vertices[1:] != sorted_vertices[:-1]).any(axis=1)
    new_index = np.empty(len(order), np.int32)
    new_index[order] = np.cumsum(is_new, dtype=np.int32) - 1
    joined = new_index[triangles]
    a, b, c = joined.T
    joined = joined[(a != b) & (b != c) & (c != a)]
    return sorted_vertices[is_new], joined[np.lexsort(joined.T)], colors[order][is_new]
