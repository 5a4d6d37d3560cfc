"""Compiled: one layer over a diffuse base, fitted to each texel's samples for several widths.

    y - rest = V n.l (b' / pi + D G / (4 n.l n.v) (F0 (1 - c) + c)),   c = (1 - v.h)^5

Symbols as in fit_kernels; b' (3) the base as the layer lets it through, F0 >= 0, one width alpha. For one width it is
linear least squares in four numbers. Samples weigh as in the fit of three lobes, by the errors of that fit.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

from stages.reflectance.fit_kernels import DARK, GRAZING, TRUST, _not_negative
from stages.reflectance.lobe_kernels import RISE, geometry, lobe, specular

NARROW = 1e-3  # weight of F0's square, as of the lobes'


@njit(parallel=True, error_model="numpy", cache=True)
def layers(points, normals, first, camera, weight, samples, arrives, rest, lights, axes, eyes, alphas, albedo, lobes,
           spread, widths, base, f0, error, facing):  # fmt: skip
    """Writes base (T, K, 3): b'; f0 (T, K); error (T, K): mean squared error along white; facing (T,): mean n.v, 0
    where nothing was fitted. normals, albedo, lobes (with alphas): of the fit of three lobes. widths (K,)."""
    count = len(widths)
    for t in prange(len(points)):
        m, r, x = np.zeros((4, 4)), np.zeros(4), np.zeros(4)
        # sums over samples, for each width: with w for white: g = n.l / pi, p the layer for F0 = 1, y less its rim
        gg, own_gg, weights, seen = 0.0, 0.0, 0.0, 0.0
        gp, pp, py, yy = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
        gy, colour = np.zeros(count), np.zeros(3)
        y = np.zeros(3)
        for k in range(first[t], first[t + 1]):
            for i in range(len(lights)):
                if arrives[t, i] < 0.999 or samples[k, i, 0] != samples[k, i, 0]:
                    continue
                _, nl, nv, nh, vh = geometry(points[t], normals[t], lights[i], axes[i], eyes[camera[k], i])
                if nl < GRAZING or nv < GRAZING:
                    continue
                g = nl / np.pi
                shine = specular(lobes[t], alphas, nl, nv, nh, vh)
                level = (albedo[t, 0] + albedo[t, 1] + albedo[t, 2]) / 3 * g + shine
                for c in range(3):
                    y[c] = samples[k, i, c] - rest[t, i, c]
                mean = (y[0] + y[1] + y[2]) / 3
                own = weight[k] / (level + DARK)
                white = own / (1 + ((mean - level) / (spread * (level + 0.03))) ** 2)
                white *= TRUST + (1 - TRUST) * ((level - shine) / (level + shine + 1e-6))
                gg += white * g * g
                own_gg += own * g * g
                for c in range(3):
                    colour[c] += own * g * (y[c] - mean)
                weights += white
                seen += white * nv
                rim = (1 - vh) ** 5
                for j in range(count):
                    f = lobe(widths[j], nl, nv, nh, vh) * nl / (1.0 + RISE * rim)
                    p, left = f * (1 - rim), mean - f * rim
                    gp[j] += white * g * p
                    pp[j] += white * p * p
                    py[j] += white * p * left
                    gy[j] += white * g * left
                    yy[j] += white * left * left
        facing[t] = 0.0
        if weights <= 0:
            continue
        facing[t] = seen / weights
        for j in range(count):
            for a in range(3):
                for b in range(3):
                    m[a, b] = own_gg * ((1.0 if a == b else 0.0) - 1.0 / 3) + gg / 3
                m[a, 3] = gp[j]
                m[3, a] = gp[j]
                r[a] = colour[a] + gy[j]
                x[a] = albedo[t, a]
            m[3, 3] = 3 * pp[j] + NARROW * weights
            r[3] = 3 * py[j]
            x[3] = 0.03
            _not_negative(m, r, x, 4)
            for c in range(3):
                base[t, j, c] = x[c]
            f0[t, j] = x[3]
            b, s = (x[0] + x[1] + x[2]) / 3, x[3]
            squares = yy[j] - 2 * b * gy[j] - 2 * s * py[j] + b * b * gg + 2 * b * s * gp[j] + s * s * pp[j]
            error[t, j] = max(squares, 0.0) / weights
