"""Drawing of a run into a rerun recording (rerun-sdk 0.41)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import open3d  # noqa: F401  # required for boxes; imported early to avoid a delay during the run
import simplejpeg
from scipy.spatial.transform import Rotation

from framework.data import Float64, Frame, InstanceMesh, Int32, Pose, UInt8
from framework.interfaces import ClosedLoop
from framework.live_view import rerun_layout as at
from framework.live_view.drawing_thread import CorrectionNote, FrameNote, FrameUpdate, MapSnapshot
from framework.live_view.drawn_path import DrawnPath
from framework.live_view.instance_colors import InstanceColors, seen_instances
from framework.live_view.mesh_regions import MeshRegions
from framework.mapping.instances.instance_list import box_around, vertices_by_id
from framework.vocabulary.label_spaces import label_space_of

if TYPE_CHECKING:
    import rerun as rr

MM = 1000  # depth image units per m
UNKNOWN_COLOR = np.array([235, 235, 235], np.uint8)  # of masks without an instance of the map
MASK_OPACITY = 128  # of 255
PATH_COLOR, LOST_COLOR, LOOP_COLOR = (40, 160, 255), (230, 60, 50), (255, 170, 40)
NAME_RADIUS = 0.005  # m, radius of the point that carries an object name
PATH_RADIUS = 0.004  # m, radius of the line of the camera path
LOOP_RADIUS = 0.012  # m, radius of the line between the two camera positions of a loop
FRUSTUM_M = 0.25  # m, distance of the image plane from the camera
MIN_TURN = 0.01  # minimum change of a component of the up direction (unit vector) to rotate the scene again


class RerunDrawing:
    """Drawing into a rerun recording stream. The parameters are described in `RerunViewer`."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        stride: int,
        jpeg_quality: int,
        region: float,
        min_probability: float,
        min_score: float,
    ) -> None:
        import rerun

        self._rr, self._recording = rerun, recording
        self._stride, self._jpeg_quality = stride, jpeg_quality
        self._min_probability, self._min_score = min_probability, min_score
        self._regions, self._colors = MeshRegions(region), InstanceColors()
        self._label_space: str | None = None  # of the map; None = not yet drawn
        self._first_s: float | None = None  # timestamp of the first frame
        self._path = DrawnPath()
        self._loops: tuple[ClosedLoop, ...] | None = None  # to be drawn; None = unchanged
        self._up: Float64 | None = None  # (3,) up direction, as drawn
        self._is_upright = False  # True = `_up` was estimated from the map
        self._T_world_first: Float64 = np.eye(4)  # (4, 4) pose of the first camera
        self._mesh: InstanceMesh | None = None  # as last drawn, with the shown instances
        self._names: dict[int, str] = {}  # names of the shown instances
        recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stages, colors = [*at.STAGE_COLORS], [*at.STAGE_COLORS.values()]
        recording.log(at.STAGE_MS, rerun.SeriesLines(names=stages, colors=colors), static=True)

    def draw_frames(
        self, notes: Sequence[FrameNote | CorrectionNote], skipped: Sequence[str], picture: FrameUpdate | None
    ) -> None:
        for note in notes:
            if isinstance(note, CorrectionNote):
                self._correct(note)
            else:
                self._note(note)
        self._draw_times([note for note in notes if isinstance(note, FrameNote)])
        for reason in skipped:
            self._recording.log(at.LOG, self._rr.TextLog(f"skipped: {reason}", level="WARN"))
        self._draw_path()
        if picture is not None:
            self._set_time(picture.frame.index, picture.frame.timestamp)
            self._draw_camera(picture.frame, picture.pose)
            self._draw_picture(picture)

    def draw_map(self, snapshot: MapSnapshot) -> None:
        self._set_time(snapshot.index, snapshot.timestamp)
        if snapshot.up is not None:
            self._turn(snapshot.up)
            if not self._is_upright:
                self._is_upright = True
                self._show_from_first_camera()
        shown = {key: of for key, of in snapshot.objects.items() if of[1] >= self._min_probability}
        mesh = snapshot.mesh
        if self._label_space is None:
            self._label_space = label_space_of(mesh.classes)
            self._recording.log(at.LOG, self._rr.TextLog(f"label space: {self._label_space}", level="INFO"))
        ids = np.where(np.isin(mesh.instance_ids, [*shown]), mesh.instance_ids, 0).astype(np.int32)
        self._mesh = replace(mesh, instance_ids=ids)
        members = vertices_by_id(ids)
        self._names = {key: mesh.classes[shown[key][0]] for key in members}
        self._colors.add({key: mesh.vertices[of].mean(axis=0, dtype=np.float64) for key, of in members.items()})
        self._draw_mesh(self._mesh)
        self._draw_boxes(members, {key: shown[key][1] for key in members}, snapshot)

    def close(self) -> None:
        try:
            self._recording.flush()
        finally:
            self._recording.disconnect()

    def _set_time(self, index: int, timestamp: float) -> None:
        self._recording.set_time(at.FRAME, sequence=index)
        self._recording.set_time(at.SECONDS, duration=self._since_first(timestamp))

    def _since_first(self, timestamp: float) -> float:
        self._first_s = timestamp if self._first_s is None else self._first_s
        return timestamp - self._first_s

    def _turn(self, up: Float64) -> None:
        """Rotate the world frame, so that `up` (3,) is the z axis of the view."""
        if self._up is None or not np.allclose(self._up, up, atol=MIN_TURN):
            self._up = up
            self._recording.log(at.WORLD, self._rr.Transform3D(mat3x3=turned(up, self._T_world_first[:3, 2])))

    def _begin_world(self, T_world_camera: Float64) -> None:
        """Orient the world frame by the first camera, until the up direction of the map is known."""
        self._T_world_first = T_world_camera
        self._turn(-T_world_camera[:3, 1])
        self._show_from_first_camera()
        self._recording.log(at.LOG, self._rr.TextLog("mapping started", level="INFO"))

    def _show_from_first_camera(self) -> None:
        """Place the viewpoint of the map behind the first camera."""
        assert self._up is not None
        T_view_camera = self._T_world_first.copy()
        T_view_camera[:3] = turned(self._up, T_view_camera[:3, 2]) @ T_view_camera[:3]
        self._recording.send_blueprint(at.layout(T_view_camera))

    def _note(self, note: FrameNote) -> None:
        self._set_time(note.index, note.timestamp)
        if note.pose.lost:
            reason = note.pose.reason or "no reason from the tracker"
            self._recording.log(at.LOG, self._rr.TextLog(f"lost: {reason}", level="WARN"))
            self._path.interrupt()
            return
        T_world_camera = note.pose.T_world_camera
        if self._up is None:
            self._begin_world(T_world_camera)
        self._path.add(note.index, T_world_camera[:3, 3])

    def _correct(self, note: CorrectionNote) -> None:
        self._path.correct(note.change)
        if note.graph is not None:
            self._loops = note.graph.loops

    def _draw_path(self) -> None:
        """Draw the changed pieces of the path, and a line between the two camera positions of each loop.

        A correction is noted before its frame. Its loops are therefore drawn again until the path contains this frame.
        """
        for k, line in self._path.changed():
            strip = self._rr.LineStrips3D([line], colors=PATH_COLOR, radii=PATH_RADIUS)
            self._recording.log(f"{at.PATH}/{k}", strip)
        if self._loops is not None:
            ends = [(self._path.position(loop.earlier_frame), self._path.position(loop.frame)) for loop in self._loops]
            known = [[start, end] for start, end in ends if start is not None and end is not None]
            self._recording.log(at.LOOPS, self._rr.LineStrips3D(known, colors=LOOP_COLOR, radii=LOOP_RADIUS))
            newest = max((loop.frame for loop in self._loops), default=None)
            if newest is None or self._path.position(newest) is not None:
                self._loops = None

    def _draw_times(self, notes: Sequence[FrameNote]) -> None:
        if notes:
            ms = [[note.stage_ms.get(stage, np.nan) for stage in at.STAGE_COLORS] for note in notes]
            frames = self._rr.TimeColumn(at.FRAME, sequence=[note.index for note in notes])
            seconds = self._rr.TimeColumn(at.SECONDS, duration=[self._since_first(note.timestamp) for note in notes])
            rows = self._rr.Scalars.columns(scalars=np.ravel(ms)).partition([len(at.STAGE_COLORS)] * len(notes))
            self._recording.send_columns(at.STAGE_MS, indexes=[frames, seconds], columns=rows)

    def _draw_picture(self, picture: FrameUpdate) -> None:
        frame, stride = picture.frame, self._stride
        color = frame.color
        if stride > 1:
            size = tuple(-(-side // stride) for side in reversed(frame.camera.shape))
            color = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(color), self._jpeg_quality)
        self._recording.log(at.COLOR, self._rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        depth_mm = np.minimum(frame.depth[::stride, ::stride] * MM, 65535).astype(np.uint16)
        png = cv2.imencode(".png", depth_mm)[1]
        depth = self._rr.EncodedDepthImage(blob=png, media_type="image/png", meter=MM, colormap="Viridis")
        self._recording.log(at.DEPTH, depth)
        self._draw_found(picture)

    def _draw_found(self, picture: FrameUpdate) -> None:
        """Draw the masks and names of the detections in the colors of their instances.

        Masks are a color image, because rerun 0.41 shows labels above 128 in wrong colors (rerun-io/rerun#12939).
        """
        found, stride = picture.detections, self._stride
        ids = np.zeros(len(found), np.int32)
        if self._mesh is not None and not picture.pose.lost:
            ids = seen_instances(found.masks, picture.frame, picture.pose.T_world_camera, self._mesh)
        colors = [self._colors.get(k, UNKNOWN_COLOR) for k in ids.tolist()]
        masks = found.masks[:, ::stride, ::stride]
        image = np.zeros((*masks.shape[1:], 4), np.uint8)  # BGR and opacity
        for mask, color in zip(masks[::-1], colors[::-1], strict=True):
            image[mask] = (*color[::-1], MASK_OPACITY)  # the best detection is drawn last
        png = cv2.imencode(".png", image)[1].tobytes()
        self._recording.log(at.MASKS, self._rr.EncodedImage(contents=png, media_type="image/png", draw_order=0.0))
        named = np.flatnonzero(found.scores >= self._min_score).tolist()
        classes = found.class_probabilities.argmax(axis=1)
        labels = [f"{found.classes[classes[k]]} {found.scores[k]:.2f}" for k in named]
        colors = [colors[k] for k in named]
        boxes = (found.boxes[named] + 0.5) / stride  # integer coordinates are pixel corners in rerun
        form = self._rr.Box2DFormat.XYXY
        self._recording.log(at.FOUND, self._rr.Boxes2D(array=boxes, array_format=form, colors=colors))
        middles = (boxes[:, :2] + boxes[:, 2:]) / 2  # rerun may place the label of a box outside of the image
        names = self._rr.Points2D(middles, labels=labels, colors=_lighter(colors), radii=2.0, show_labels=True)
        self._recording.log(at.NAMES, names)

    def _draw_camera(self, frame: Frame, pose: Pose) -> None:
        camera, stride = frame.camera, self._stride
        T_world_camera = pose.T_world_camera
        self._recording.log(
            at.CAMERA,
            self._rr.Transform3D(translation=T_world_camera[:3, 3], mat3x3=T_world_camera[:3, :3]),
            self._rr.Pinhole(
                focal_length=(camera.fx / stride, camera.fy / stride),
                principal_point=((camera.cx + 0.5) / stride, (camera.cy + 0.5) / stride),
                resolution=[-(-side // stride) for side in (camera.width, camera.height)],
                camera_xyz=self._rr.ViewCoordinates.RDF,
                image_plane_distance=FRUSTUM_M,
                color=LOST_COLOR if pose.lost else PATH_COLOR,
            ),
        )

    def _draw_mesh(self, mesh: InstanceMesh) -> None:
        colors = self._colors.painted(mesh)
        for (x, y, z), part in self._regions.changed(mesh.vertices, mesh.triangles, colors):
            entity = f"{at.MESH}/{x}_{y}_{z}"
            if len(part.triangles):
                drawn = self._rr.Mesh3D(
                    vertex_positions=part.vertices, triangle_indices=part.triangles, vertex_colors=part.colors
                )
                self._recording.log(entity, drawn)
            else:
                self._recording.log(entity, self._rr.Clear(recursive=False))

    def _draw_boxes(
        self, members: Mapping[int, Int32], probabilities: Mapping[int, float], snapshot: MapSnapshot
    ) -> None:
        boxes = [box_around(snapshot.mesh.vertices[of], snapshot.up) for of in members.values()]
        centers, colors = [box.center for box in boxes], [self._colors[key] for key in members]
        turned = [Rotation.from_matrix(box.rotation).as_quat() for box in boxes]
        labels = [f"{self._names[key]} {probabilities[key]:.2f}" for key in members]
        drawn = self._rr.Boxes3D(
            centers=centers,
            sizes=[box.extent for box in boxes],
            quaternions=turned,
            colors=colors,
            fill_mode="MajorWireframe",
        )
        self._recording.log(at.OBJECTS, drawn)
        names = self._rr.Points3D(centers, labels=labels, colors=_lighter(colors), radii=NAME_RADIUS, show_labels=True)
        self._recording.log(at.OBJECT_NAMES, names)


def turned(up: Float64, forward: Float64) -> Float64:
    """Return the rotation R_view_world (3, 3) of a view with z up.

    Args:
        up: Unit vector (3,) in the world frame that becomes the z axis.
        forward: Vector (3,) in the world frame. Its horizontal component becomes the y axis.
    """
    across = np.cross(forward, up)
    across = across / np.linalg.norm(across) if across.any() else np.linalg.svd(up[None])[2][1]
    return np.stack([across, np.cross(up, across), up])


def _lighter(colors: Sequence[UInt8]) -> UInt8:
    """Return lighter RGB colors (N, 3) for text on a dark background."""
    return (np.array(colors, np.uint16).reshape(-1, 3) // 2 + 115).astype(np.uint8)
