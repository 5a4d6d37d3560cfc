"""Do the photos differ in exposure? Asked before the fit, of the surface that it begins with.

A camera that sets its exposure anew for every photo, and writes nothing of it, makes one colour many. A fit that begins
as if all photos were alike explains that by shine and by albedo, and does not let go of these once it knows.

Symbols: c_pv colour of point p in view v, g_v the view's gain, D_p the point's colour; c_pv = g_v D_p.
Source: ours; least squares in turn (cross_validation.py), on `SAMPLES` points.
"""

from __future__ import annotations

import numpy as np
import torch

from stages.inverse_rendering import cross_validation
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.observations import observe, pictures
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.stereo import surface_points

SAMPLES = 1500
DRIFT = 0.1  # of the gains' mean: what skin reflects spreads photos by one camera by 0.03; cameras set 0.1 to 0.4


def exposures_differ(views: list[PhotoView], start: Start, device: str) -> bool:
    """Whether the photos' gains are spread wider than reflections make them."""
    return gain_spread(views, start, device) > DRIFT


def gain_spread(views: list[PhotoView], start: Start, device: str) -> float:
    """Standard deviation of g_v, the mean of its channels, where the mean over the views is 1; 0 where no point is seen
    by `cross_validation.LEAST_TRAIN` views."""
    points, normals = surface_points(start.values, start.lo, start.cell)
    every = max(len(points) // SAMPLES, 1)
    x, n = (torch.from_numpy(a[::every].astype(np.float32)).to(device) for a in (points, normals))
    if not len(x):
        return 0.0
    gains = cross_validation.gains_of(observe(start.surface(device), pictures(views), x, n))
    return 0.0 if gains is None else float(gains.mean(1).std())
