"""Commands of `instancemap`, one per file; `command_line`, `experiment` and `sweep` are shared."""

from framework.runtime.process_settings import set_environment

set_environment()  # before a command, or a worker of a sweep, imports numba
