"""Measure acceptance lines: `python -m tests.acceptance [LINE ...]`."""

from __future__ import annotations

import sys

from tests.acceptance import lines  # noqa: F401  # registers them
from tests.acceptance.runner import LINES, run

if unknown := [name for name in sys.argv[1:] if name not in LINES]:
    sys.exit(f"LINE: expected one of {', '.join(LINES)}, got {', '.join(unknown)}")
sys.exit(not run(sys.argv[1:]))
