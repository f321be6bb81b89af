"""No masking."""

from __future__ import annotations

from dataclasses import dataclass

from framework.interfaces import FrameMasking


@dataclass
class NoMasking(FrameMasking):
    """Masking that changes no frame."""
