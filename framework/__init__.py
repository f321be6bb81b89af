"""InstanceMap: incremental instance-oriented semantic 3D mapping from RGB-D video."""

import os

__version__ = "0.1.0"

# Before numba is imported: OpenMP first, which may be entered by several threads at once and is on every machine that
# Open3D runs on; numba's own first choice, TBB, is often found too old and then complained about on every start.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
