"""No back end."""

from __future__ import annotations

from dataclasses import dataclass

from framework.interfaces import BackEnd


@dataclass
class NoBackEnd(BackEnd):
    """Back end that changes nothing, so the drift of the camera remains in the map."""
