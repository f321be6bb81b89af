"""Commands of `instancemap`, one module each. Modules such as `command_line` are shared."""

from framework.runtime.process_settings import set_environment

set_environment()  # before a command, or a worker of a sweep, imports numba
