"""InstanceMap: incremental instance-oriented semantic 3D mapping from RGB-D video.

*The paper*, in docstrings, is "Incremental Instance-Oriented 3D Semantic Mapping via RGB-D Cameras for Unknown Indoor
Scene" (Discrete Dynamics in Nature and Society, 2020, article 2528954); numbers in brackets are its equations.
"""

import os

__version__ = "0.1.0"

# The detector's thread and the mapping thread both launch parallel kernels. Of numba's threading layers only OpenMP and
# TBB allow that; OpenMP comes with torch's requirements, TBB does not, and an old one on the system only gives a
# warning. OpenMP's idle threads must sleep: by default they spin, and take the cores from the other thread. A few
# microseconds of spinning are worth it, from one kernel of a stage to the next.
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "10000")
