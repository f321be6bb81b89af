"""InstanceMap: incremental instance-oriented semantic 3D mapping from RGB-D video.

*The paper*, in docstrings, is "Incremental Instance-Oriented 3D Semantic Mapping via RGB-D Cameras for Unknown Indoor
Scene" (Discrete Dynamics in Nature and Society, 2020, article 2528954); numbers in brackets are its equations.
"""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

__version__ = "0.1.0"

# The detector's threads and the mapping thread all launch parallel kernels. Of numba's threading layers only OpenMP and
# TBB allow that; OpenMP comes with torch's requirements, TBB does not, and an old one on the system only gives a
# warning. OpenMP's idle threads must sleep: by default they spin, and take the cores from the other threads. A few
# microseconds of spinning are worth it, from one kernel of a stage to the next.
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "10000")
# The threads of OpenBLAS, of which numpy, scipy and OpenCV bring one each, spin for 2^26 cycles by default after a
# product that they were woken for: OpenCV's took a core from the kernels of the frame after each keyframe for 30 ms.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "14")  # 2^14 cycles


def _can_be_written(folder: Path) -> bool:
    """The folder, or where it is to be made."""
    there = next((path for path in (folder, *folder.parents) if path.exists()), Path())
    return os.access(there, os.W_OK)


# numba keeps kernels beside the code, else in the user's cache, and does not begin where neither can be written: in an
# image that is only read, without a home. There they last as long as this process. The place is no known one, where
# somebody else could leave other code.
_HOME = os.environ.get("XDG_CACHE_HOME") or os.environ.get("HOME") or os.environ.get("USERPROFILE") or "/"
_KEPT = (Path(__file__).parent, Path(_HOME))
if "NUMBA_CACHE_DIR" not in os.environ and not any(map(_can_be_written, _KEPT)):
    os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="instancemap-kernels-")
    atexit.register(shutil.rmtree, os.environ["NUMBA_CACHE_DIR"], ignore_errors=True)
