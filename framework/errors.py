"""What can go wrong in a way that the user can mend. Each error is one line: expected, found, where, what to do."""


class InstanceMapError(Exception):
    """Base of every known error. `python -m framework` prints it as one line; `debug=true` adds the traceback."""


class ConfigError(InstanceMapError):
    """A configuration names something that does not exist or gives a parameter a value that it cannot have."""


class DataError(InstanceMapError):
    """Input that cannot be used: a file is missing, corrupt or inconsistent, or an array has the wrong form."""


class FrameError(DataError):
    """One frame cannot be used and the rest of its sequence can: the pipeline counts it in `frames_skipped`."""


class NoPoseError(FrameError):
    """No pose is given for this frame, which is normal where motion capture has gaps: skipped, and told in the end."""


class MapFullError(InstanceMapError):
    """The map has reached its block budget; what was mapped so far is kept."""


class PartialRunError(InstanceMapError):
    """A run ended early, and the record of what it had mapped is written. `__cause__` is what ended it."""


def in_one_line(said: object) -> str:
    """What a library says of a fault, for a message of ours; the kind of the fault where it says nothing."""
    return " ".join(str(said).split()) or type(said).__name__
