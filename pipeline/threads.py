"""Settings of the thread pools. Import this before torch, numba or scikit-image.

libgomp reads its environment once, when it is loaded. By default idle threads spin: if another process uses the same
cores, a step of the fit takes forty times as long. Passive threads sleep instead, and are as fast on a free machine.
Settings of the user are kept.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Sums in the same order in every run: else the matrix library may choose its number of threads and its code path by the
# load of the machine and the alignment of arrays.
os.environ.setdefault("MKL_DYNAMIC", "FALSE")
os.environ.setdefault("MKL_CBWR", "AUTO")
