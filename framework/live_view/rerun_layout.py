"""Entity paths of a rerun recording, and layout of its views."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from framework.data import Float64

if TYPE_CHECKING:
    import rerun.blueprint as rrb

WORLD = "world"  # world frame of the map, rotated upright
MESH, PATH, LOOPS = f"{WORLD}/mesh", f"{WORLD}/path", f"{WORLD}/loops"
OBJECTS, OBJECT_NAMES = f"{WORLD}/objects/boxes", f"{WORLD}/objects/names"
CAMERA = f"{WORLD}/camera"
COLOR, DEPTH = f"{CAMERA}/color", f"{CAMERA}/depth"
MASKS, FOUND, NAMES = f"{CAMERA}/masks", f"{CAMERA}/found", f"{CAMERA}/names"
STAGE_MS = "milliseconds"
LOG = "log"

FRAME, SECONDS = "frame", "seconds"  # names of the timelines: Frame.index, and seconds since the first frame

STAGE_COLORS = {
    "reading": (120, 126, 134),
    "detection": (0, 114, 178),
    "tracking": (0, 158, 115),
    "lifting": (140, 107, 177),
    "refinement": (213, 94, 0),
    "association": (194, 96, 154),
    "update": (75, 163, 199),
    "integration": (181, 131, 10),
    "fusion": (125, 102, 8),
    "backend": (139, 94, 60),
}
"""RGB color of each stage, the same as in reports."""

TIMES_SHOWN = 300  # number of displayed stage times before the current frame, in frames
EYE_BACK, EYE_ABOVE = 1.2, 0.8  # m, from the first camera to the view's position
AIM_FORWARD, AIM_BELOW = 1.5, 0.4  # m, from the first camera to the view's target


def layout(T_view_camera: Float64 | None = None) -> rrb.Blueprint:
    """Return the layout of the views.

    The map and the stage times are on the left, frame and depth on the right. The 3D view starts behind the first
    camera at `T_view_camera` (4, 4), with z up; None = unknown.
    """
    import rerun.blueprint as rrb

    last = rrb.VisibleTimeRange(
        FRAME,
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-TIMES_SHOWN),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=0),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(
                    origin="/",
                    contents=["+ /**", f"- /{MASKS}", f"- /{FOUND}", f"- /{NAMES}", f"- /{DEPTH}"],
                    name="Map",
                    eye_controls=None if T_view_camera is None else _eye(T_view_camera),
                ),
                rrb.Horizontal(
                    rrb.TimeSeriesView(origin=f"/{STAGE_MS}", name="Milliseconds by stage", time_ranges=[last]),
                    rrb.TextLogView(origin=f"/{LOG}", name="Lost and skipped frames"),
                    column_shares=[3, 2],
                ),
                row_shares=[7, 3],
            ),
            rrb.Vertical(
                rrb.Spatial2DView(
                    origin=f"/{CAMERA}",
                    contents=[f"+ /{COLOR}", f"+ /{MASKS}", f"+ /{FOUND}", f"+ /{NAMES}"],
                    name="Frame",
                ),
                rrb.Spatial2DView(origin=f"/{CAMERA}", contents=[f"+ /{DEPTH}"], name="Depth"),
            ),
            column_shares=[8, 5],
        ),
        rrb.TimePanel(state="collapsed", timeline=FRAME),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _eye(T_view_camera: Float64) -> rrb.EyeControls3D:
    import rerun.blueprint as rrb

    position, forward = T_view_camera[:3, 3], T_view_camera[:3, 2]
    up = np.array([0.0, 0.0, 1.0])
    eye, aim = position - EYE_BACK * forward + EYE_ABOVE * up, position + AIM_FORWARD * forward - AIM_BELOW * up
    return rrb.EyeControls3D(position=eye, look_target=aim, eye_up=up)
