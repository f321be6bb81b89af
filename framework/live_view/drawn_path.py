"""The drawn camera path, which moves with the submaps of the map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from framework.data import Float32, Float64
from framework.geometry import transform
from framework.interfaces import SubmapChange

PIECE = 200  # maximum number of frames that are drawn again for a new frame


@dataclass
class _Piece:
    """Successive frames of one submap."""

    submap: int
    is_connected: bool  # True = the line begins at the last position of the piece before
    frames: list[int] = field(default_factory=list)  # Frame.index
    positions: list[Float64] = field(default_factory=list)  # (3,) m


class DrawnPath:
    """Camera path in pieces. Only changed pieces are drawn again."""

    def __init__(self) -> None:
        self._pieces: list[_Piece] = []
        self._changed: set[int] = set()
        self._submap = self._next_submap = 0  # of the next frame, and of those after it
        self._is_complete, self._is_connected = True, False  # True = a piece begins, connected with the one before

    def add(self, frame: int, position: Float64) -> None:
        """Add a frame at a camera position (3,), m."""
        if self._is_complete or len(self._pieces[-1].frames) == PIECE:
            self._pieces.append(_Piece(self._submap, self._is_connected))
        self._pieces[-1].frames.append(frame)
        self._pieces[-1].positions.append(position)
        self._changed.add(len(self._pieces) - 1)
        self._is_complete, self._is_connected = self._next_submap != self._submap, True
        self._submap = self._next_submap

    def interrupt(self) -> None:
        """End the line at the last position."""
        self._is_complete, self._is_connected = True, False

    def correct(self, change: SubmapChange) -> None:
        """Move the pieces with their submaps. The next frame still belongs to the submap before the change."""
        for k, piece in enumerate(self._pieces):
            if piece.submap in change.motions:
                piece.positions = list(transform(change.motions[piece.submap], np.array(piece.positions)))
                self._changed |= {k, min(k + 1, len(self._pieces) - 1)}  # the next one may begin at the last position
        self._next_submap = change.submap

    def position(self, frame: int) -> Float64 | None:
        """Return the camera position (3,) of a frame, m, or None if the frame has not been added."""
        piece = next((one for one in self._pieces if frame in one.frames), None)
        return None if piece is None else piece.positions[piece.frames.index(frame)]

    def changed(self) -> Iterator[tuple[int, Float32]]:
        """Yield the number and the line (P, 3), m, of each piece that has changed since the last call."""
        for k in sorted(self._changed):
            start = self._pieces[k - 1].positions[-1:] if self._pieces[k].is_connected else []
            yield k, np.array([*start, *self._pieces[k].positions], np.float32)
        self._changed = set()
