"""Open3D's VoxelBlockGrid, asked in such a way that its answers are right.

Dong et al. 2022, "ASH: A modern framework for parallel spatial hashing in 3D perception". What Open3D 0.20 does is left
as it is where it is only slow; where it is wrong, the call is made so that the answer is right, and the place says how.
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
from framework.mapping.voxels.voxel_grid import MOST_BLOCKS

ATTRIBUTES = {  # name: (type, channels) of what a voxel holds; the first three as Open3D's `integrate` wants them
    "tsdf": (o3d.core.float32, 1),  # in truncation distances
    "weight": (o3d.core.float32, 1),  # frames
    "color": (o3d.core.float32, 3),  # in [0, 255]
    "instance": (o3d.core.int32, 1),  # 0 = no instance
    "votes": (o3d.core.float32, 1),  # for that instance, less those against it
}
FIRST_BLOCKS = 1000  # room at the start; Open3D's memory follows what is asked for, not what is used ...
FIRST_VOXELS = 2**23  # ... and at most so many voxels, 0.2 GB
METRES = 1.0  # Open3D's depth_scale: units of a float image for each metre
TOUCH_STRIDE = 4  # px between the pixels that Open3D asks which blocks they touch
NEAR = 0.05  # m, where rays start
RANGE_TILE = 8  # px of the image for one of the map of ranges that rays search, Open3D's default
FRAGMENTS = 2**18  # pieces of blocks in view that the map of ranges has room for; a view of 10,000 blocks takes 20,000
FRAGMENT = 16 * 16  # pixels of the map of ranges in a piece
MOST_RANGE_PIXELS = 2**24  # of that first image: coarse voxels need fewer fragments
CPU = o3d.core.Device("CPU:0")


@dataclass(frozen=True)
class BlockGridSettings:
    """What a grid is made with."""

    voxel_size: float  # m
    block_resolution: int  # voxels a side
    truncation: float  # voxels
    min_depth: float  # m
    max_depth: float  # m
    max_blocks: int
    min_weight: float  # frames that must have seen a voxel for it to be surface

    def __post_init__(self) -> None:
        check_bounds(self, block_resolution=(2, 64), max_blocks=(1, MOST_BLOCKS), min_weight=(1.0, 1e6))

    @classmethod
    def of(cls, saved: MapHeader) -> BlockGridSettings:
        """Those that a map's header tells. Raises DataError or ConfigError where they cannot be."""
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
    """Blocks of voxels with a signed distance, a colour and labels. A voxel's number is its place in `flat`."""

    def __init__(self, settings: BlockGridSettings) -> None:
        self.settings = settings
        self.frames = 0  # integrated
        self.blocks = o3d.t.geometry.VoxelBlockGrid(
            attr_names=list(ATTRIBUTES),
            attr_dtypes=[dtype for dtype, _ in ATTRIBUTES.values()],
            attr_channels=[o3d.core.SizeVector([channels]) for _, channels in ATTRIBUTES.values()],
            voxel_size=settings.voxel_size,
            block_resolution=settings.block_resolution,
            block_count=min(FIRST_BLOCKS, settings.max_blocks, FIRST_VOXELS // settings.block_resolution**3),
            device=CPU,
        )
        self._make_room_for_ranges()

    def _make_room_for_ranges(self) -> None:
        """Lets the first ray-cast be of an image so large that the map of ranges has room for every later one.

        Open3D sizes that buffer by the first image. Where it is too small, a view has holes, and stdout a warning.
        """
        side = int(np.ceil(np.sqrt(min(FRAGMENTS * FRAGMENT * self.settings.voxel_size, MOST_RANGE_PIXELS))))
        nowhere = Tensor(np.zeros((1, 3), np.int32))
        self.blocks.ray_cast(
            nowhere, Tensor(np.eye(3)), Tensor(np.eye(4)), side, side, ["depth"], METRES, range_map_down_factor=1
        )

    @property
    def block_count(self) -> int:
        return int(self.blocks.hashmap().size())

    @property
    def voxel_count(self) -> int:
        return self.block_count * int(self.settings.block_resolution**3)

    @property
    def byte_count(self) -> int:
        """Of the blocks in use; Open3D's hash map holds up to twice as many ready."""
        a_voxel = sum(dtype.byte_size() * channels for dtype, channels in ATTRIBUTES.values())
        return self.voxel_count * a_voxel

    @property
    def min_weight(self) -> float:
        """As Open3D's own SLAM does: the first frames alone must be enough for a surface."""
        return min(self.settings.min_weight, float(self.frames))

    def integrate(self, frame: Frame, T_world_camera: Float64) -> None:
        """Adds the depth and the colour of `frame`. Raises MapFullError, and adds nothing, at the end of the budget."""
        s = self.settings
        depth = self._usable(frame.depth)
        if not depth.any():
            return  # Open3D raises an error of its own
        blocks = self._touched(depth, frame.camera, T_world_camera, s.truncation)
        self._make_room(blocks)
        view = _tensors(frame.camera, T_world_camera, 0.5)
        image = _image(depth)
        color = _image(frame.color.astype(np.float32) / np.float32(255))  # Open3D takes both as float or neither
        self.blocks.integrate(blocks, image, color, *view, METRES, s.max_depth, s.truncation)
        self.frames += 1

    def _usable(self, depth: Float32) -> Float32:
        s = self.settings
        return np.where((depth >= s.min_depth) & (depth <= s.max_depth), depth, np.float32(0))

    def _touched(self, depth: Float32, camera: Camera, T_world_camera: Float64, band: float) -> Tensor:
        """The coordinates (B, 3) of the blocks within `band` voxels of a reading of `depth` (H, W), along its ray.

        Open3D looks at every 4th pixel of every 4th row. Where these are more than half a block apart the image is
        enlarged, or the map would have holes.
        """
        s = self.settings
        apart = TOUCH_STRIDE * float(depth.max()) / min(camera.fx, camera.fy)
        larger = min(int(np.ceil(apart / (s.block_resolution * s.voxel_size / 2))), TOUCH_STRIDE)
        if not depth[::TOUCH_STRIDE, ::TOUCH_STRIDE].any():  # it would raise an error
            larger = TOUCH_STRIDE
        if larger > 1:
            depth = depth.repeat(larger, axis=0).repeat(larger, axis=1)
            camera = camera.scaled(larger)
        view = _tensors(camera, T_world_camera)
        return self.blocks.compute_unique_block_coordinates(_image(depth), *view, METRES, s.max_depth, band)

    def _make_room(self, blocks: Tensor) -> None:
        """Lets the hash map grow to hold `blocks` (B, 3), which Open3D would do as well, without an end."""
        hashmap = self.blocks.hashmap()
        new = blocks.shape[0]
        if hashmap.size():
            new -= int(np.count_nonzero(hashmap.find(blocks)[1].numpy()))
        needed = hashmap.size() + new
        if needed > self.settings.max_blocks:
            raise MapFullError(
                f"the map is full: {self.settings.max_blocks} blocks of {self.settings.block_resolution}^3 voxels "
                f"({self.byte_count / 2**20:.0f} MiB in use); raise fuser.max_blocks or fuser.voxel_size"
            )
        if needed > hashmap.capacity():
            hashmap.reserve(min(max(needed, 2 * hashmap.capacity()), self.settings.max_blocks))

    def voxels_seen(self, frame: Frame, T_world_camera: Float64, mask: Bool, band: float) -> tuple[Int64, Int64]:
        """The voxels (V,) within `band` voxels of the reading at their pixel, and that pixel (V,), as flat numbers.

        Only pixels in `mask` (H, W) count. After Open3D's example integrate_custom.py, but for the blocks under them.
        """
        camera = frame.camera
        usable = self._usable(frame.depth)
        depth = usable * mask
        if not depth.any():
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        around = cv2.dilate(mask.astype(np.uint8), np.ones((2 * TOUCH_STRIDE - 1,) * 2, np.uint8))
        blocks = self._touched(usable * around, camera, T_world_camera, band)
        numbers, known = self.blocks.hashmap().find(blocks)
        points, voxels = self.blocks.voxel_coordinates_and_flattened_indices(numbers[known])
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
        """(P,) the voxel nearest to each of the points (P, 3) m, as a flat number; -1 where there is none."""
        if not len(points_world) or not self.block_count:
            return np.full(len(points_world), -1)
        r = self.settings.block_resolution
        nearest = np.rint(points_world / np.float32(self.settings.voxel_size)).astype(np.int32)
        blocks = nearest // r
        numbers, known = (tensor.numpy() for tensor in self.blocks.hashmap().find(Tensor(blocks)))
        x, y, z = (nearest - r * blocks).T
        return np.where(known, numbers.astype(np.int64) * r**3 + (z * r + y) * r + x, -1)  # x runs fastest

    def flat(self, attribute: str) -> npt.NDArray[Any]:
        """One attribute (block capacity * voxels a block,) of all voxels, as a view that writes through."""
        return np.asarray(self.blocks.attribute(attribute).numpy()).reshape(-1)

    def ray_cast(self, camera: Camera, T_world_camera: Float64) -> SurfaceView:
        """The surface that `camera` sees. Raises DataError where the camera or its pose is none."""
        check_view(camera, T_world_camera)
        depth, normals, color = _blank(camera)
        blocks, far = self._blocks_in_view(camera, T_world_camera)
        if len(blocks):
            found = self._cast(blocks, far, camera, T_world_camera)
            z = found["depth"][..., 0]
            length = np.linalg.norm(found["normal"], axis=-1)
            seen = (z > 0) & (length > 0.5)  # Open3D normalises what is not 0
            behind = self._distance(found["index"][seen], found["interp_ratio"][seen] * found["mask"][seen])
            depth[seen] = np.maximum(z[seen] + behind, NEAR)
            normals[seen] = _towards(camera, T_world_camera, found["normal"] / np.maximum(length, 0.5)[..., None])[seen]
            color[seen] = np.rint(255 * found["color"][seen]).astype(np.uint8)
        return SurfaceView(camera, T_world_camera, depth, normals, color)

    def _cast(self, blocks: Int32, far: float, camera: Camera, T_world_camera: Float64) -> dict[str, npt.NDArray[Any]]:
        """What Open3D's rays find, each (H, W, channels).

        Its map of ranges leaves out the last rows and columns of an image whose sides are no multiples of its tile.
        """
        names = ("depth", "normal", "color", "index", "mask", "interp_ratio")
        width, height = (RANGE_TILE * int(np.ceil(side / RANGE_TILE)) for side in (camera.width, camera.height))
        hit = self.blocks.ray_cast(
            Tensor(blocks),
            *_tensors(camera, T_world_camera),
            width,
            height,
            names,
            METRES,
            NEAR,
            far,
            self.min_weight,
            self.settings.truncation,
            RANGE_TILE,
        )
        return {name: hit[name].numpy()[: camera.height, : camera.width] for name in names}

    def _distance(self, corners: Int64, shares: Float32) -> Float32:
        """(P,) m, the trilinear field at points with voxels `corners` (P, 8), of which `shares` (P, 8) were seen.

        Open3D's rays see the field in steps of whole voxels, rounded down: they end half a voxel too far along each
        axis, and ragged. The field is 0 at the surface and falls by about 1 m for each m behind it, so adding it is a
        Newton step: 1 mm instead of 12 mm at 2 cm voxels, in the median.
        """
        total = np.maximum(shares.sum(axis=1), np.float32(1e-6))
        tsdf = (self.flat("tsdf")[corners] * shares).sum(axis=1) / total
        return np.asarray(tsdf * np.float32(self.settings.truncation * self.settings.voxel_size), np.float32)

    def _blocks_in_view(self, camera: Camera, T_world_camera: Float64) -> tuple[Int32, float]:
        """The coordinates (B, 3) of the blocks of which `camera` sees something, and the depth (m) where they end."""
        coords = self.block_coords()
        side = self.settings.block_resolution * self.settings.voxel_size
        radius = side * np.sqrt(3) / 2
        T_camera_world = inverse(T_world_camera)
        x, y, z = T_camera_world[:3, :3] @ ((coords + 0.5) * side).T + T_camera_world[:3, 3:]
        seen = z > -radius
        # the distance of the centre from each side of the pyramid of view, inwards
        for across, focal, center, size in (
            (x, camera.fx, camera.cx, camera.width),
            (y, camera.fy, camera.cy, camera.height),
        ):
            low, high = (-0.5 - center) / focal, (size - 0.5 - center) / focal
            seen &= (across - low * z > -radius * np.hypot(1, low)) & (high * z - across > -radius * np.hypot(1, high))
        return coords[seen], float(z[seen].max(initial=0) + radius)

    def block_coords(self) -> Int32:
        """(B, 3) of the blocks in use, in Open3D's order, which differs between runs."""
        if not self.block_count:
            return np.zeros((0, 3), np.int32)
        hashmap = self.blocks.hashmap()
        return np.asarray(hashmap.key_tensor().numpy()[hashmap.active_buf_indices().numpy()], np.int32)

    def extract(self) -> tuple[Float32, Int32, UInt8]:
        """Vertices (V, 3) m, triangles (F, 3) and colours (V, 3) by marching cubes, the same in every run."""
        if self.block_count:
            # weights are whole numbers; marching cubes asks for more than the threshold, ray-casting for as much
            mesh = self.blocks.extract_triangle_mesh(self.min_weight - 0.5)
            if mesh.triangle.indices.shape[0]:
                colors = np.rint(255 * mesh.vertex.colors.numpy()).astype(np.uint8)
                return _in_order(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), colors)
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8)

    def arrays(self) -> dict[str, Array]:
        """The blocks' coordinates and what their voxels hold, in the same order in every run.

        For a file of our own: Open3D's `save` ends the process on a full disk.
        """
        coords = self.block_coords()
        order = np.lexsort(coords.T)
        blocks = self.blocks.hashmap().active_buf_indices().numpy()[order] if len(coords) else order
        values = {name: self.blocks.attribute(name).numpy()[blocks] for name in ATTRIBUTES}
        return {"block_coords": coords[order], **values}

    def fill(self, arrays: Mapping[str, Array]) -> None:
        """Takes over what `arrays` of another grid gave, into one that is empty."""
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
    """Intrinsics (3, 3) and T_camera_world (4, 4), float64 as Open3D wants them.

    Its `integrate` cuts pixel coordinates off where it should round them; with the principal point `half` = 0.5 px on
    that is the same. Its rays go through integer pixel centres.
    """
    K = camera.K
    K[:2, 2] += half
    return Tensor(K), Tensor(inverse(T_world_camera))


def _image(pixels: Float32) -> o3d.t.geometry.Image:
    return o3d.t.geometry.Image(Tensor(np.ascontiguousarray(pixels)))


def _blank(camera: Camera) -> tuple[Float32, Float32, UInt8]:
    """Depth, normals and colour of a camera that sees nothing."""
    shape = camera.shape
    return np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.uint8)


def _rays(camera: Camera, T_world_camera: Float64) -> Float32:
    """(H, W, 3), in the world: the way of each pixel's ray for each m of depth."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    x, y = (u - np.float32(camera.cx)) / np.float32(camera.fx), (v - np.float32(camera.cy)) / np.float32(camera.fy)
    R = T_world_camera[:3, :3].astype(np.float32)
    return np.stack([x * R[i, 0] + y * R[i, 1] + R[i, 2] for i in range(3)], axis=-1)


def points_of(surface: SurfaceView) -> Float32:
    """(H, W, 3) m, in the world."""
    points = _rays(surface.camera, surface.T_world_camera)
    points *= surface.depth[..., None]
    points += surface.T_world_camera[:3, 3].astype(np.float32)
    return points


def _towards(camera: Camera, T_world_camera: Float64, normals_camera: Float32) -> Float32:
    """Open3D's normals (H, W, 3), which are the camera's and point away from it, in the world and towards it."""
    normals = normals_camera @ T_world_camera[:3, :3].T.astype(np.float32)
    away = np.einsum("hwi,hwi->hw", normals, _rays(camera, T_world_camera)) > 0
    normals[away] *= -1
    return normals


def _in_order(vertices: Float32, triangles: Int32, colors: UInt8) -> tuple[Float32, Int32, UInt8]:
    """The mesh with vertices and triangles sorted, and vertices at one place made one.

    Open3D's order depends on its threads.
    """
    order = np.lexsort(vertices.T)
    sorted_vertices = vertices[order]
    first = np.ones(len(order), np.bool_)
    first[1:] = (sorted_vertices[1:] != sorted_vertices[:-1]).any(axis=1)
    number = np.empty(len(order), np.int32)
    number[order] = np.cumsum(first, dtype=np.int32) - 1
    joined = number[triangles]
    a, b, c = joined.T
    joined = joined[(a != b) & (b != c) & (c != a)]
    return sorted_vertices[first], joined[np.lexsort(joined.T)], colors[order][first]
