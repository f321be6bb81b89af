"""No viewer."""

from __future__ import annotations

from dataclasses import dataclass

from framework.interfaces import Viewer


@dataclass
class NoViewer(Viewer):
    """Viewer without output."""
