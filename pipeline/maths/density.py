"""Volume density of an SDF and the weights of samples along a ray.

Symbols: s signed distance, negative inside; beta > 0 width of the soft surface (asset units); sigma density, 1/unit;
tau optical depth; T transmittance. Rays are rows, samples are columns, front to back.
"""

from __future__ import annotations

import torch
from torch import Tensor


def laplace_density(s: Tensor, beta: Tensor) -> Tensor:
    """sigma = Psi_beta(-s) / beta, Psi the CDF of the zero-mean Laplace distribution. [NeuFace section 4.4]

    Both branches see |s|, so that the one not taken can't overflow and send NaN through the gradient of `where`.
    """
    tail = 0.5 * torch.exp(-s.abs() / beta)
    return torch.where(s >= 0, tail, 1 - tail) / beta


def ray_weights(sigma: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
    """Weights w_i = T_i (1 - exp(-sigma_i delta_i)) and total optical depth: (N, S), (N, S) -> (N, S), (N,).

    The quadrature of [NeuFace eq. 18]; opacity is 1 - exp(-tau) = sum w.
    """
    depth = sigma * delta
    before = torch.cumsum(depth, -1) - depth
    return torch.exp(-before) * -torch.expm1(-depth), depth.sum(-1)


def opacity_cross_entropy(tau: Tensor, alpha: Tensor) -> Tensor:
    """Binary cross-entropy of opacity 1 - e^-tau against alpha in [0, 1], unreduced.

        alpha * -log(1 - e^-tau) + (1 - alpha) * tau

    Written in tau: -log(1 - opacity) is tau itself, so that the gradient doesn't vanish where opacity saturates.
    tau is kept above 1e-4, where the first term's derivative 1 / tau would otherwise grow without bound.
    """
    t = tau.clamp(min=1e-4)
    return -alpha * torch.log(-torch.expm1(-t)) + (1 - alpha) * tau
