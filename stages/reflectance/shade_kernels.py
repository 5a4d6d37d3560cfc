"""Compiled: the radiance of all texels under one lamp."""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

from stages.reflectance.lobe_kernels import geometry, specular


@njit(parallel=True, error_model="numpy", cache=True)
def shade(points, normals, lamp, axis, strength, eye, alphas, albedo, lobes, arrives, extra, out):
    """out (T, 3) = (V (a n.l / pi + specular) + rest) e strength, not negative. points, normals, albedo (T, 3); lobes
    (T, J); arrives (T,) V; extra (T, 3) the rest; lamp, axis, strength, eye (3,)."""
    for t in prange(len(points)):
        e, nl, nv, nh, vh = geometry(points[t], normals[t], lamp, axis, eye)
        shine = arrives[t] * specular(lobes[t], alphas, nl, nv, nh, vh)
        matt = arrives[t] * max(nl, 0.0) / np.pi
        for c in range(3):
            out[t, c] = max(albedo[t, c] * matt + shine + extra[t, c], 0.0) * e * strength[c]
