"""What NeuFace's lobe is called in the words of standard shaders.

Symbols
    kappa   concentration of the vMF lobe [NeuFace eq. 10]; inv_kappa = 1 / kappa is what the field stores
    alpha   GGX width
    E_ss    directional albedo of single-scattering GGX (height-correlated Smith, F = 1) seen along the normal
    F0      reflectance at normal incidence

numpy arrays of any shape, float64 inside.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
Reals = npt.NDArray[np.floating] | float

KAPPA_RANGE = (2.1, 89.0)  # where the fit of alpha was made
E_SS_ALPHA = (0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75)
E_SS = (1.0, 0.988, 0.972, 0.948, 0.877, 0.787, 0.688, 0.592, 0.504, 0.464)


def alpha_from_kappa(kappa: Reals) -> F64:
    """GGX alpha of a lobe seen at normal incidence; kappa is clamped to KAPPA_RANGE.

        alpha = 0.5407 (kappa - 1.517)^-0.486

    A fit to GGX lobes sampled by their visible normals and attenuated at order 10, off by at most 0.0115 in the range.
    Differs from the small-angle form alpha = 0.707 / sqrt(kappa), which is 0.2 off at kappa = 2.
    """
    k = np.clip(np.asarray(kappa, np.float64), *KAPPA_RANGE)
    out: F64 = 0.5407 * (k - 1.517) ** -0.486
    return out


def roughness_from_inv_kappa(inv_kappa: Reals) -> F64:
    """Shader roughness sqrt(alpha) in [0.24, 0.84] from 1 / kappa >= 0. UsdPreviewSurface and OpenPBR square it."""
    return np.sqrt(alpha_from_kappa(1 / np.maximum(np.asarray(inv_kappa, np.float64), 1e-6)))


def energy(alpha: Reals) -> F64:
    """E_ss(alpha) at n.v = 1, linear in a table; alpha in [0, 0.75]."""
    return np.asarray(np.interp(np.asarray(alpha, np.float64), E_SS_ALPHA, E_SS), np.float64)


def f0_from_lobe(strength: Reals, inv_kappa: Reals) -> F64:
    """F0 of the GGX lobe that reflects as much along the normal as NeuFace's.

        F0 = F / E_ss(alpha),  F = rho c . B(n, n)

    strength: F >= 0, negative values are taken as 0. Not clamped above, so that a fit gone wrong shows.
    """
    alpha = alpha_from_kappa(1 / np.maximum(np.asarray(inv_kappa, np.float64), 1e-6))
    out: F64 = np.maximum(np.asarray(strength, np.float64), 0) / energy(alpha)
    return out
