"""Conversion of NeuFace's lobe to GGX and F0 of standard shaders.

Symbols
    kappa   concentration of the vMF lobe [NeuFace eq. 10]; inv_kappa = 1 / kappa is what the field stores
    alpha   GGX width of the exported lobe (pipeline.maths.ggx_width)
    E_ss    directional albedo of single-scattering GGX (height-correlated Smith, F = 1) seen along the normal
    F0      reflectance at normal incidence

numpy arrays of any shape, float64 inside.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.maths.ggx_width import best_fit_alpha

F64 = npt.NDArray[np.float64]
Reals = npt.NDArray[np.floating] | float

SKIN_F0 = 0.03  # index of refraction 1.42; textbooks have 0.028 (1.40). The fit's light has its level from this value
E_SS_ALPHA = (0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75)
E_SS = (1.0, 0.988, 0.972, 0.948, 0.877, 0.787, 0.688, 0.592, 0.504, 0.464)


def roughness_from_inv_kappa(inv_kappa: Reals) -> F64:
    """Shader roughness sqrt(alpha) in [0.24, 0.84] from 1 / kappa >= 0. UsdPreviewSurface and OpenPBR square it."""
    return np.sqrt(best_fit_alpha(1 / np.maximum(np.asarray(inv_kappa, np.float64), 1e-6)))


def energy(alpha: Reals) -> F64:
    """E_ss(alpha) at n.v = 1, linear in a table; alpha in [0, 0.75]."""
    return np.asarray(np.interp(np.asarray(alpha, np.float64), E_SS_ALPHA, E_SS), np.float64)


def f0_from_lobe(strength: Reals, inv_kappa: Reals) -> F64:
    """F0 of the GGX lobe that reflects as much along the normal as NeuFace's.

        F0 = F / E_ss(alpha),  F = rho c . B(n, n)

    strength: F >= 0, negative values count as 0. Not clamped above, so that a failed fit is visible.
    """
    alpha = best_fit_alpha(1 / np.maximum(np.asarray(inv_kappa, np.float64), 1e-6))
    out: F64 = np.maximum(np.asarray(strength, np.float64), 0) / energy(alpha)
    return out


# ------------------------------------------------------------------ reflectance along other directions than the normal
AZIMUTHS, RADII = 24, 24  # of the sampled visible normals; the sums have errors of 1e-3


def split_albedo(cosine: Reals, alpha: Reals) -> tuple[F64, F64]:
    """(a, b), each of the arguments' common shape, such that single-scattering GGX reflects F0 a + b towards n.v.

        R(n.v) = integral of G2 / G1 (F0 + (1 - F0) (1 - h.v)^5) over visible normals h = F0 a + b

    cosine = n.v in (0, 1]; alpha > 0. Schlick's Fresnel term; height-correlated Smith masking. The visible normals are
    a fixed, even set on the projected hemisphere. [Heitz 2018, visible normals; Karis 2013, the split in F0]
    """
    c, w = np.broadcast_arrays(np.asarray(cosine, np.float64), np.asarray(alpha, np.float64))
    v = np.stack([np.sqrt(np.maximum(1 - c * c, 0)), np.zeros_like(c), np.maximum(c, 1e-4)], -1)
    a, b = np.zeros(c.shape), np.zeros(c.shape)
    for r, turn in _disc():
        h = _visible_normal(v, w, r, turn)
        hv = (h * v).sum(-1)
        out = 2 * hv * h[..., 2] - v[..., 2]
        ratio = np.where(out > 0, _masking_ratio(v[..., 2], np.maximum(out, 1e-6), w), 0.0)
        fresnel = np.clip(1 - hv, 0, 1) ** 5
        a += ratio * (1 - fresnel)
        b += ratio * fresnel
    count = AZIMUTHS * RADII
    return a / count, b / count


def _disc() -> list[tuple[float, float]]:
    """(radius, angle) of points spread evenly over the unit disc."""
    ring = np.sqrt((np.arange(RADII) + 0.5) / RADII)
    return [
        (float(r), float(2 * np.pi * (i + 0.5 + 0.618034 * k) / AZIMUTHS))
        for k, r in enumerate(ring)
        for i in range(AZIMUTHS)
    ]


def _visible_normal(v: F64, alpha: F64, r: float, turn: float) -> F64:
    """One visible normal for every view direction v (..., 3), from a point of the disc in the stretched frame."""
    s = np.stack([alpha * v[..., 0], np.zeros_like(alpha), v[..., 2]], -1)
    s /= np.linalg.norm(s, axis=-1, keepdims=True)
    t1, t2 = r * np.cos(turn), r * np.sin(turn)
    lean = 0.5 * (1 + s[..., 2])
    t2 = (1 - lean) * np.sqrt(1 - t1 * t1) + lean * t2
    up = np.sqrt(np.maximum(1 - t1 * t1 - t2 * t2, 0))
    # v has no y component, so the axes orthogonal to it are y and (-s_z, 0, s_x)
    h = np.stack([-t2 * s[..., 2] + up * s[..., 0], np.full_like(up, t1), t2 * s[..., 0] + up * s[..., 2]], -1)
    h = np.stack([alpha * h[..., 0], alpha * h[..., 1], np.maximum(h[..., 2], 1e-9)], -1)
    return np.asarray(h / np.linalg.norm(h, axis=-1, keepdims=True))


def _masking_ratio(cos_out: F64, cos_in: F64, alpha: F64) -> F64:
    """G2 / G1 of the direction with `cos_out`, height-correlated."""
    first, second = (0.5 * (np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1) for c in (cos_out, cos_in))
    return np.asarray((1 + first) / (1 + first + second))
