"""`instancemap raycast RUN`: draw a ray-cast view of a map from the pose of a frame."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from framework.commands.command_line import arguments, one_line_errors
from framework.config.validation import checked_file
from framework.errors import DataError
from framework.files.tum_trajectory import rigid_pose

if TYPE_CHECKING:
    from framework.reporting.run_contents import RunContents

log = logging.getLogger(__name__)

PICTURE = "raycast.png"


def main() -> None:
    """Run the command `instancemap raycast`."""
    parser = argparse.ArgumentParser(
        description="Draw a ray-cast view of the map of a run in five panels: depth, normals, vertex map, RGB and "
        "object indices."
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="run directory")
    view = parser.add_mutually_exclusive_group()
    view.add_argument("--frame", metavar="N", type=int, help="number of a mapped frame; default: middle frame")
    pose = ("TX", "TY", "TZ", "QX", "QY", "QZ", "QW")
    pose_help = "camera pose T_world_camera: translation, m, and unit quaternion"
    view.add_argument("--pose", metavar=pose, nargs=7, type=float, help=pose_help)
    parser.add_argument("--out", metavar="FILE", type=Path, help=f"PNG file; default: {PICTURE} in the run directory")
    parsed = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        out = parsed.run / PICTURE if parsed.out is None else checked_file("--out", str(parsed.out), ".png")
        draw(parsed.run, parsed.frame, parsed.pose, out)
        print(out)


def draw(run: Path, frame: int | None, pose: list[float] | None, out: Path) -> None:
    """Draw a ray-cast view of the map of a run.

    Args:
        run: Run directory.
        frame: Number of the frame whose pose is used; None = middle frame.
        pose: Camera pose as tx, ty, tz, m, and unit quaternion qx, qy, qz, qw; None = pose of the frame.
        out: PNG file.

    Raises:
        DataError: The frame was not mapped, or the map is not in view.
    """
    from framework.api import scene_of  # slow import: after the arguments are checked
    from framework.figures.raycast_figure import write_raycast
    from framework.reporting.run_contents import RunContents
    from framework.reporting.run_source import RunSource
    from framework.reporting.visibility import NOT_CAMERA

    scene = scene_of("raycast", run)
    contents = RunContents.read(run)
    if pose is None:
        k = pose_of_frame(contents, frame)
        T_world_camera, place = contents.poses[k], f"frame {contents.frame_numbers[k]}"
    else:
        T_world_camera = rigid_pose("--pose", pose[:3], pose[3:])
        place = f"pose {' '.join(f'{value:g}' for value in pose)}"
    source = RunSource.of(contents)
    if source.camera is None:
        log.warning("camera of the run unknown (%s); rendering with the intrinsics of a Kinect", source.why_not)
    objects = scene.instances()
    names = {key: scene.classes[int(one.class_probabilities.argmax())] for key, one in objects.items()}
    view = scene.render(source.camera or NOT_CAMERA, T_world_camera)
    if not (view.depth > 0).any():
        raise DataError(
            f"{'--frame' if pose is None else '--pose'}: expected a pose with the map in view, got an empty view from "
            f"{place}; set another --frame or --pose"
        )
    centers = {key: one.aabb.center for key, one in objects.items()}
    note = f"{contents.name}, {place}, ray-cast from the final map. Commit {contents.record.commit}."
    write_raycast(out, view, names, centers, note)


def pose_of_frame(contents: RunContents, frame: int | None) -> int:
    """Return the index of the pose of a frame in the trajectory. Without a frame, it is the middle pose.

    Raises:
        DataError: The frame was not mapped.
    """
    numbers, lost = contents.frame_numbers, contents.lost_frames
    if not numbers:
        raise DataError(f"{contents.record.directory}: expected at least one mapped frame, got none; set --pose")
    if frame is None:
        return len(numbers) // 2
    if frame in numbers:
        return numbers.index(frame)
    known = (*numbers, *lost)
    if not min(known) <= frame <= max(known):
        raise DataError(f"--frame: expected a frame number from {min(known)} to {max(known)}, got {frame}")
    nearest = min(numbers, key=lambda number: abs(number - frame))
    what = "a lost frame" if frame in lost else "a frame that was not mapped"
    raise DataError(f"--frame: expected a mapped frame, got {frame} ({what}); use the nearest one, --frame {nearest}")
