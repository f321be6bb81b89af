"""Where rerun's viewer shows what, and where it lies in a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from framework.data import Float64

if TYPE_CHECKING:
    import rerun.blueprint as rrb

WORLD = "world"  # the map's coordinates, turned so that up is up
MESH, PATH = f"{WORLD}/mesh", f"{WORLD}/path"
OBJECTS, OBJECT_NAMES = f"{WORLD}/objects/boxes", f"{WORLD}/objects/names"
CAMERA = f"{WORLD}/camera"
COLOR, DEPTH = f"{CAMERA}/color", f"{CAMERA}/depth"
MASKS, FOUND, NAMES = f"{CAMERA}/masks", f"{CAMERA}/found", f"{CAMERA}/names"
STAGE_MS = "milliseconds"
LOG = "log"

FRAME, SECONDS = "frame", "seconds"  # time lines: Frame.index, and s since the first frame

STAGE_COLORS = {
    "read": (120, 126, 134),
    "detect": (0, 114, 178),
    "track": (0, 158, 115),
    "lift": (140, 107, 177),
    "refine": (213, 94, 0),
    "fuse": (181, 131, 10),
}
"""RGB, as in the figure of stage times, by stage."""


TIMES_SHOWN = 300  # frames, up to the chosen one
EYE_BACK, EYE_ABOVE = 1.2, 0.8  # m, from the first camera to the eye
AIM_AHEAD, AIM_BELOW = 1.5, 0.4  # m, from the first camera to what the eye looks at


def layout(T_view_camera: Float64 | None = None) -> rrb.Blueprint:
    """The map and the stages' times at the left, the frame and its depth at the right.

    The map is seen from behind the first camera, which is at `T_view_camera`, z up; None = it is not known yet.
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

    position, ahead = T_view_camera[:3, 3], T_view_camera[:3, 2]
    up = np.array([0.0, 0.0, 1.0])
    eye, aim = position - EYE_BACK * ahead + EYE_ABOVE * up, position + AIM_AHEAD * ahead - AIM_BELOW * up
    return rrb.EyeControls3D(position=eye, look_target=aim, eye_up=up)
