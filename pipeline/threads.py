"""Settings of the thread pools, to be imported before torch, numba or scikit-image are.

libgomp reads its environment once, when it is loaded. With its default, idle threads spin: as soon as another process
wants the same cores, a step of the fit takes forty times as long. Passive threads sleep instead and cost nothing
when the machine is free. A setting that the user made is left alone.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# The same sums in the same order from run to run: the matrix library may else choose its number of threads and its code
# path by what the machine happens to be doing and where an array happens to lie.
os.environ.setdefault("MKL_DYNAMIC", "FALSE")
os.environ.setdefault("MKL_CBWR", "AUTO")
