"""Settings of the thread pools, to be imported before torch, numba or scikit-image are.

libgomp reads its environment once, when it is loaded. With its default, idle threads spin: as soon as another process
wants the same cores, a step of the fit takes forty times as long. Passive threads sleep instead and cost nothing
when the machine is free. A setting that the user made is left alone.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
