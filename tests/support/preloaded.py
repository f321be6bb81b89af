"""State of the forked commands, set once in the fork server."""

from __future__ import annotations

import pytest

from framework.runs.provenance import frozen_environment
from tests.support.small_overviews import use_small_overviews

frozen_environment()  # reads the metadata of all installed packages, 0.2 s
use_small_overviews(pytest.MonkeyPatch())
