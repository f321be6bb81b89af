"""Run acceptance measurements: `python -m tests.acceptance [MEASUREMENT ...]`."""

from __future__ import annotations

import sys

from tests.acceptance import measurements  # noqa: F401  # registers them
from tests.acceptance.runner import MEASUREMENTS, run

if unknown := [name for name in sys.argv[1:] if name not in MEASUREMENTS]:
    sys.exit(f"MEASUREMENT: expected one of {', '.join(MEASUREMENTS)}, got {', '.join(unknown)}")
sys.exit(not run(sys.argv[1:]))
