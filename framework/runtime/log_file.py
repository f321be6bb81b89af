"""Log file of a run."""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from typing import Any

log = logging.getLogger(__name__)


class LogFile(logging.FileHandler):
    """Handler that writes a log file. If the file cannot be written, the run continues, after one warning."""

    def __init__(self, filename: str, delay: bool = False, **options: Any) -> None:
        super().__init__(filename, delay=True, **options)
        self._failed = False
        if not delay:
            with suppress(OSError):  # reported with the first message, when all handlers are configured
                self.stream = self._open()

    def emit(self, record: logging.LogRecord) -> None:
        try:
            super().emit(record)
        except OSError:  # when the file is opened
            self.handleError(record)

    def handleError(self, record: logging.LogRecord) -> None:
        error = sys.exception()
        if not isinstance(error, OSError):
            super().handleError(record)
        elif not self._failed:
            self._failed = True
            log.warning(
                "%s: expected a writable file, got an error (%s); the log is not complete",
                self.baseFilename, error.strerror,
            )  # fmt: skip

    def close(self) -> None:
        with suppress(OSError):  # lines that could not be written are still in the buffer
            super().close()
