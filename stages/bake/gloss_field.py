"""How F0 and roughness vary over a surface of one material: the mean of a Gaussian random field, given the photos.

About the group's F0 m and roughness r, the view-dependent part of observation j at vertex p is linear:

    y_j = (m + u_p) x_j + v_p z_j + noise,    z = d(m A + B) / dr

Symbols
    x, y, z  of standard_fit.py: the base's best multiple is subtracted, so that no albedo enters
    u, v     departures of F0 and roughness from the group's
    C        their prior covariance at one place: spreads s_u, s_v and correlation c. Where skin is oily or moist its F0
             is higher and its roughness lower [Weyrich 2006]
    M, K     of smoothing.py; the prior's precision over the surface is C^-1 x (M + LENGTH^2 K) / (4 pi LENGTH^2), the
             field whose correlation falls over LENGTH [Lindgren 2011], drawn to the mean where nothing is known
    s^2      variance of the noise. Errors of shape and light are common to all views and to neighbours: all
             observations within LENGTH count as 1 / TRUST of their number

(u, v) solve one sparse linear system, and vary where the photos say so and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_array, diags_array

from pipeline.maths.sparse import factorised
from pipeline.meshes import F64, Mask, Mesh
from pipeline.smoothing import laplacian

LENGTH = 0.02  # metres: a forehead, a nose, a lip
TRUST = 10.0


@dataclass(frozen=True, slots=True)
class Slopes:
    """Sums over a vertex's views of w times these products, (V,) each; weight: of w alone, and of three colours."""

    xx: F64
    xz: F64
    zz: F64
    xy: F64
    zy: F64
    yy: F64
    weight: F64


@dataclass(frozen=True, slots=True)
class Spread:
    """Prior standard deviations of F0 and roughness inside a material, and their correlation."""

    f0: float
    roughness: float
    correlation: float


def departures(mesh: Mesh, own: Mask, sums: Slopes, f0: float, spread: Spread) -> tuple[F64, F64]:
    """u, v (V,). own (V,): vertices of the material that photos show; f0: m."""
    count = len(own)
    if not own.any():
        return np.zeros(count), np.zeros(count)
    mass, k = laplacian(mesh)
    left = np.maximum(sums.yy - 2 * f0 * sums.xy + f0 * f0 * sums.xx, 0)[own].sum()
    noise = max(float(left / max(sums.weight[own].sum(), 1e-30)), 1e-30) * common(mass[own])
    o = own / noise
    covariance = np.array([[1, spread.correlation], [spread.correlation, 1]])
    covariance *= np.outer([spread.f0, spread.roughness], [spread.f0, spread.roughness])
    precision = np.linalg.inv(covariance)
    prior = (diags_array(mass) + LENGTH**2 * k) / (4 * np.pi * LENGTH**2)
    seen = ((sums.xx, sums.xz), (sums.xz, sums.zz))
    rows = [[diags_array(o * seen[i][j]) + precision[i, j] * prior for j in (0, 1)] for i in (0, 1)]
    told = np.concatenate([o * (sums.xy - f0 * sums.xx), o * (sums.zy - f0 * sums.xz)])
    found = factorised(block_array(rows)).solve(told)
    return found[:count], found[count:]


def common(mass: F64) -> float:
    """How many observations count as one. mass (n,): area of each vertex that photos show."""
    return TRUST * max(LENGTH**2 / max(float(mass.mean()), 1e-12), 1.0)
