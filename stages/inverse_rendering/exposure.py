"""Do the photos' exposures differ? Estimated before the fit, on the initial geometry.

With automatic exposure and no EXIF, one colour differs between photos. A fit without calibration explains this by
specular reflection and albedo, and does not undo it when calibration starts later.

Symbols: c_pv colour of point p in view v, g_v the view's gain, D_p the point's colour; c_pv = g_v D_p.
Source: ours; alternating least squares (cross_validation.py), on `SAMPLES` points.
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
DRIFT = 0.1  # smallest spread of the gains that counts: skin's reflections give 0.03, automatic exposure 0.1 to 0.4


def exposures_differ(views: list[PhotoView], start: Start, device: str) -> bool:
    """Whether the spread of the photos' gains is larger than reflections can cause."""
    return gain_spread(views, start, device) > DRIFT


def gain_spread(views: list[PhotoView], start: Start, device: str) -> float:
    """Standard deviation of g_v, averaged over the channels, whose mean over the views is 1; 0 if no point is visible
    in `cross_validation.MIN_TRAIN` views."""
    points, normals = surface_points(start.values, start.lo, start.cell)
    every = max(len(points) // SAMPLES, 1)
    x, n = (torch.from_numpy(a[::every].astype(np.float32)).to(device) for a in (points, normals))
    if not len(x):
        return 0.0
    gains = cross_validation.gains_of(observe(start.surface(device), pictures(views), x, n))
    return 0.0 if gains is None else float(gains.mean(1).std())
