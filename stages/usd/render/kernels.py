"""Compiled inner loops of the renderer: points on triangles, and shading under many lamps."""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

TWO_PI = np.float32(2 * np.pi)
STEP = np.float32(1 / 256)


@njit(parallel=True, error_model="numpy", cache=True)
def hit_weights(corners, face, origin, directions, out):
    """Write barycentric weights (M, 3) of rays on their triangles, in float64 (Embree's have errors of 1e-5)."""
    for i in prange(len(face)):
        a, b, c = corners[face[i], 0], corners[face[i], 1], corners[face[i], 2]
        d = directions[i]
        e10, e11, e12 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        e20, e21, e22 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        p0, p1, p2 = d[1] * e22 - d[2] * e21, d[2] * e20 - d[0] * e22, d[0] * e21 - d[1] * e20
        determinant = e10 * p0 + e11 * p1 + e12 * p2
        t0, t1, t2 = origin[0] - a[0], origin[1] - a[1], origin[2] - a[2]
        if abs(determinant) < 1e-30:  # a ray in the triangle's plane
            determinant = 1.0
        q0, q1, q2 = t1 * e12 - t2 * e11, t2 * e10 - t0 * e12, t0 * e11 - t1 * e10
        u = min(max((t0 * p0 + t1 * p1 + t2 * p2) / determinant, 0.0), 1.0)
        v = min(max((d[0] * q0 + d[1] * q1 + d[2] * q2) / determinant, 0.0), 1.0)
        w = max(1.0 - u - v, 0.0)
        total = u + v + w
        out[i, 0], out[i, 1], out[i, 2] = w / total, u / total, v / total


@njit(parallel=True, error_model="numpy", cache=True)
def under_lamps(normal, mirror, inv_kappa, corner, weights, seen, lamp, diffuse, specular):
    """Irradiance, and radiance filtered by a lobe of 1/kappa around the mirror direction, at M points under N lamps.

    normal, mirror (M, 3); corner (M, 3) vertices of each point's triangle and their weights; seen (V, N) 0 or 1;
    lamp (7, N): direction, flux, spread, which is added to 1/kappa like a variance (a lamp is an area of the sky).
    The first loop has no sums, so that it vectorises under strict arithmetic.
    Writes diffuse, specular (M, 3). exp(t) is computed as (1 + t / 256)^256; the error is 0.2 % at t = -1.
    """
    one, zero, count = np.float32(1), np.float32(0), lamp.shape[1]
    for i in prange(len(normal)):
        sa, sb, sc = seen[corner[i, 0]], seen[corner[i, 1]], seen[corner[i, 2]]
        wa, wb, wc = weights[i, 0], weights[i, 1], weights[i, 2]
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        mx, my, mz = mirror[i, 0], mirror[i, 1], mirror[i, 2]
        own = inv_kappa[i]
        lobe, cosine = np.empty(count, np.float32), np.empty(count, np.float32)
        for k in range(count):
            x, y, z = lamp[0, k], lamp[1, k], lamp[2, k]
            share = wa * np.float32(sa[k]) + wb * np.float32(sb[k]) + wc * np.float32(sc[k])
            facing = nx * x + ny * y + nz * z
            cosine[k] = share * (facing if facing > zero else zero)
            kappa = one / (own + lamp[6, k])
            g = one + kappa * (mx * x + my * y + mz * z - one) * STEP
            g = g if g > zero else zero
            g *= g
            g *= g
            g *= g
            g *= g
            g *= g
            g *= g
            g *= g
            g *= g
            lobe[k] = g * (share * kappa)
        d0, d1, d2, s0, s1, s2 = zero, zero, zero, zero, zero, zero
        for k in range(count):
            d0 += cosine[k] * lamp[3, k]
            d1 += cosine[k] * lamp[4, k]
            d2 += cosine[k] * lamp[5, k]
            s0 += lobe[k] * lamp[3, k]
            s1 += lobe[k] * lamp[4, k]
            s2 += lobe[k] * lamp[5, k]
        peak = one / (TWO_PI * (one - np.exp(np.float32(-2) / own)))
        diffuse[i, 0], diffuse[i, 1], diffuse[i, 2] = d0, d1, d2
        specular[i, 0], specular[i, 1], specular[i, 2] = s0 * peak, s1 * peak, s2 * peak
