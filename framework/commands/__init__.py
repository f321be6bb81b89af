"""One file = one command of `instancemap`; `command_line`, `experiment` and `sweep` are what they share."""

from framework.runtime.process_settings import set_environment

set_environment()  # before a command, or a worker of a sweep, imports numba
