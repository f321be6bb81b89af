"""The commands of `instancemap`, one module each, and shared modules such as `command_line`."""

import os

from framework.runtime.process_settings import set_environment

set_environment()  # before a command, or a worker of a sweep, imports numba
os.environ["MPLBACKEND"] = "agg"  # commands draw only files; matplotlib rejects an unknown backend of the user
