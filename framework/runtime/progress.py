"""Progress of long operations, as a bar in a terminal or as log lines."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

from tqdm import tqdm

MIN_INTERVAL, MAX_INTERVAL = 3.0, 60.0  # s, minimum and maximum interval of log lines


class Progress(tqdm):  # type: ignore[type-arg]  # of counts, not of an iterable
    """Progress bar, or timer for log lines if no bar is shown.

    The total number of items may be unknown (None).
    """

    def __init__(self, total: int | None, unit: str, **options: Any) -> None:
        # tqdm ignores TQDM_DISABLE if `disable` is given; a program without a console has no stderr
        self.quiet = os.environ.get("TQDM_DISABLE") == "1" or sys.stderr is None
        wide = self.quiet or not sys.stderr.isatty() or _columns() > 0  # tqdm shows nothing in a terminal of width 0
        super().__init__(total=total, unit=unit, disable=self.quiet or None, dynamic_ncols=wide, **options)
        self._begun = self._spoken = time.monotonic()

    def line_is_due(self) -> bool:
        """Return True if no bar is shown and it is time for a log line.

        The interval is 10% of the elapsed time, limited to [MIN_INTERVAL, MAX_INTERVAL].
        """
        now = time.monotonic()
        interval = min(max(MIN_INTERVAL, 0.1 * (now - self._begun)), MAX_INTERVAL)
        if not self.disable or self.quiet or now - self._spoken < interval:
            return False
        self._spoken = now
        return True


def _columns() -> int:
    """Return the width of the terminal, or 0 if unknown."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns
    except (OSError, ValueError):
        return 0
