"""Run `make endurance`: `python -m tests.endurance [--frames N] [--out FOLDER]`."""

from __future__ import annotations

import logging

from tests.support.process_memory import restart_with_malloc

restart_with_malloc()

import instancemap  # noqa: E402

instancemap.configure_process()  # before numpy is loaded

from tests.endurance.lane import main  # noqa: E402

logging.getLogger("framework").setLevel(logging.ERROR)
main()
