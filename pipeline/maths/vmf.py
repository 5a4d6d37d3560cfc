"""Attenuation of spherical harmonics under a von Mises-Fisher lobe: D of [NeuFace eq. 10], [NeuFace eq. 25].

Symbols: kappa > 0 concentration; s = 1 / kappa >= 0 its inverse, which is what the field predicts (s = 0: mirror).
A_l(s) is the factor of E over vMF(w; w_r, kappa) of Y_lm(w), relative to Y_lm(w_r). A_0 = 1, A_l falls with l and s.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.maths.precision import full_precision

EXTRA_ORDERS = 8  # error below 4e-8 over all s in float64, 1e-6 in float32
LARGEST = 1e30  # 1 / kappa is limited to it where it is multiplied by l = 0: 0 x infinity has no value
MIN_ORDER = 10  # lower orders use this one: starting 8 orders above order 1 would have an error of 1.4e-6


@full_precision
def attenuation_exponential(inv_kappa: Tensor, order: int) -> Tensor:
    """A_l = exp(-l (l + 1) s / 2): (N,) -> (N, order + 1). [NeuFace eq. 11], [NeuFace eq. 27]

    Error against the exact ratio: at most 0.075 (l = 1, kappa = 1.55), of order kappa^-2 for large kappa.
    """
    l = torch.arange(order + 1, dtype=inv_kappa.dtype, device=inv_kappa.device)  # noqa: E741
    return torch.exp(-0.5 * l * (l + 1) * inv_kappa.clamp(max=LARGEST)[:, None])


@full_precision
def attenuation_exact(inv_kappa: Tensor, order: int) -> Tensor:
    """A_l = I_{l+1/2}(kappa) / I_{1/2}(kappa): (N,) -> (N, order + 1). Domain: all s >= 0.

    The expectation of [NeuFace eq. 26] under the lobe of [NeuFace eq. 25], without [NeuFace eq. 27]'s approximation.

        r_l = A_l / A_{l-1} = 1 / ((2 l + 1) s + r_{l+1}),    A_l = r_1 ... r_l

    The recursion runs downward (upward it is unstable). It starts a few orders higher with

        r_N = 1 / (N s + sqrt(1 + N (N + 1) s^2 (1 + s / (1 + s))))

    which agrees with the exact ratio up to s^3 (r_l = 1 - l s + l (l - 1) s^2 / 2 + l (l - 1) s^3 / 2 + ...) and is
    bounded where s is large, where the start has no influence. Every term and its derivative is positive and finite.
    """
    s = inv_kappa
    top = max(order, MIN_ORDER) + EXTRA_ORDERS
    t = s.clamp(max=1e9)  # its square must not overflow; for larger s the start has no influence
    r = 1 / ((top + 1) * s + torch.sqrt(1 + (top + 1) * (top + 2) * t * t * (1 + t / (1 + t))))
    ratios = []
    for l in range(top, 0, -1):  # noqa: E741
        r = 1 / ((2 * l + 1) * s + r)
        if l <= order:
            ratios.append(r)
    a = [torch.ones_like(s)]
    for r in reversed(ratios):
        a.append(a[-1] * r)
    return torch.stack(a, -1)


@full_precision
def attenuation_phong(inv_shininess: Tensor, order: int) -> Tensor:
    """A_l = exp(-l^2 / 2 p) of a Phong lobe cos^p, p = 1 / inv_shininess: (N,) -> (N, order + 1).

    [Ramamoorthi and Hanrahan 2001, section 3.3]; the paper's comparison [NeuFace section 5.2] uses it.
    """
    l = torch.arange(order + 1, dtype=inv_shininess.dtype, device=inv_shininess.device)  # noqa: E741
    return torch.exp(-0.5 * l * l * inv_shininess.clamp(max=LARGEST)[:, None])


ATTENUATIONS = {
    "exponential": attenuation_exponential,
    "exact": attenuation_exact,
    "phong": attenuation_phong,
}
