"""Compiled: the light at a point, and the reflection lobe.

    f(l, v) = a / pi + sum_j s_j D_j(n.h) G_j / (4 n.l n.v) F(v.h) / F0

Symbols
    n, l, v, h   normal, direction to the light, to the eye, half-way between
    D_j, G_j     GGX of width alpha_j, and its height-correlated shadowing [Heitz 2014]
    F / F0       Schlick's Fresnel factor for F0 = .04, so that the weight s_j is an F0
    e            what falls on a surface that faces the light, over its intensity: (axis . -l) / d^2
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit

RISE = 24.0  # (1 - F0) / F0 of skin's and cornea's F0 of about .04
LOW = 0.02  # n.l is not taken below in the lobe: its shadowing would divide by it
FLAT = 0.05  # n.v of a texel is not taken below: there its own normal is not known well enough


@njit(error_model="numpy", cache=True)
def geometry(point, normal, light, axis, eye):
    """e, n.l, n.v, n.h, v.h of a point (3,) under a lamp at `light` that shines along `axis`, seen from `eye`."""
    lx, ly, lz = light[0] - point[0], light[1] - point[1], light[2] - point[2]
    squared = lx * lx + ly * ly + lz * lz
    d = np.sqrt(squared)
    lx, ly, lz = lx / d, ly / d, lz / d
    vx, vy, vz = eye[0] - point[0], eye[1] - point[1], eye[2] - point[2]
    r = np.sqrt(vx * vx + vy * vy + vz * vz)
    vx, vy, vz = vx / r, vy / r, vz / r
    hx, hy, hz = lx + vx, ly + vy, lz + vz
    h = np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12
    forward = max(-(lx * axis[0] + ly * axis[1] + lz * axis[2]), 0.0)
    nl = normal[0] * lx + normal[1] * ly + normal[2] * lz
    nv = normal[0] * vx + normal[1] * vy + normal[2] * vz
    nh = (normal[0] * hx + normal[1] * hy + normal[2] * hz) / h
    vh = (vx * hx + vy * hy + vz * hz) / h
    return forward / squared, nl, nv, nh, vh


@njit(error_model="numpy", cache=True)
def lobe(alpha, nl, nv, nh, vh):
    """D G / (4 n.l n.v) F / F0 of one width. nl, nv > 0."""
    a2 = alpha * alpha
    q = nh * nh * (a2 - 1.0) + 1.0
    d = a2 / (np.pi * q * q)
    g = 0.5 / (nl * np.sqrt(nv * nv * (1.0 - a2) + a2) + nv * np.sqrt(nl * nl * (1.0 - a2) + a2))
    return d * g * (1.0 + RISE * (1.0 - vh) ** 5)


@njit(error_model="numpy", cache=True)
def specular(weights, alphas, nl, nv, nh, vh):
    """sum_j s_j lobe_j n.l; 0 for n.l <= 0."""
    if nl <= 0:
        return 0.0
    nl, nv = max(nl, LOW), max(nv, FLAT)
    total = 0.0
    for j in range(len(alphas)):
        total += weights[j] * lobe(alphas[j], nl, nv, nh, vh)
    return total * nl
