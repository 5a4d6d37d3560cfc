"""Volume density of an SDF and the weights of samples along a ray.

Symbols: s signed distance, negative inside; beta > 0 width of the soft surface (asset units); sigma density, 1/unit;
tau optical depth; T transmittance. Rays are rows, samples are columns, front to back.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.maths.precision import full_precision


@full_precision
def laplace_density(s: Tensor, beta: Tensor) -> Tensor:
    """sigma = Psi_beta(-s) / beta, Psi the CDF of the zero-mean Laplace distribution. [NeuFace section 4.4]

    Both branches use |s|, so that the one not taken can't overflow and give NaN in the gradient of `where`.
    """
    tail = 0.5 * torch.exp(-s.abs() / beta)
    return torch.where(s >= 0, tail, 1 - tail) / beta


@full_precision
def ray_weights(sigma: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
    """Weights w_i = T_i (1 - exp(-sigma_i delta_i)) and total optical depth: (N, S), (N, S) -> (N, S), (N,).

    The quadrature of [NeuFace eq. 18]; opacity is 1 - exp(-tau) = sum w. The depth before a sample is an exclusive sum:
    an inclusive sum minus the sample would be 0 instead of 1e-3 before an interval of depth 1e10, and the weights would
    exceed 1.
    """
    depth = sigma * delta
    before = torch.cumsum(torch.nn.functional.pad(depth[..., :-1], (1, 0)), -1)
    return torch.exp(-before) * -torch.expm1(-depth), depth.sum(-1)


@full_precision
def laplace_survival(s: Tensor, beta: Tensor) -> Tensor:
    """1 - Psi_beta(-s): the transmittance of a ray that came no closer than s. 1 far outside, 1/2 at s = 0."""
    tail = 0.5 * torch.exp(-s.abs() / beta)
    return torch.where(s >= 0, 1 - tail, tail)


@full_precision
def crossing_weights(s: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
    """Weights and optical depth of a surface without bias: (N, S) front to back -> (N, S), (N,).

        T_i = min over j <= i of (1 - Psi_beta(-s_j)),   w at the interval's middle = T_{i-1} - T_i

    Differs: the Laplace density of [NeuFace section 4.4] makes a grazing ray opaque already beta ln(L / 1.4 beta)
    outside the zero set (L its path near the surface: 2 mm for beta = 0.6 mm), so that silhouettes pull the surface
    in by as much. Here transmittance depends only on the closest approach, as in NeuS: a ray that touches the zero
    set has opacity 1/2 for any length, and the mean hit lies on the zero set. Each interval's weight is divided
    between its two ends, so that means over samples are means at the midpoints.

    tau = -ln T is ln 2 - s / beta inside: the mask's gradient doesn't vanish for a ray deep in the solid.
    """
    floor = torch.finfo(s.dtype).tiny
    t = torch.cummin(laplace_survival(s, beta), -1).values.clamp(min=floor)
    before = torch.cat([torch.ones_like(t[:, :1]), t[:, :-1]], -1)
    drop = before - t
    shared = 0.5 * (drop + torch.cat([drop[:, 1:], drop[:, :1]], -1))  # the first drop has no interval before it
    return shared, -torch.log(t[:, -1])


OPAQUE = 3.5  # optical depth from which a ray is covered: opacity 0.97


@full_precision
def opacity_cross_entropy(tau: Tensor, alpha: Tensor) -> Tensor:
    """Binary cross-entropy of opacity 1 - e^-tau against alpha in [0, 1], unreduced.

        alpha * -log(1 - e^-tau) + (1 - alpha) * tau,    the first term 0 from tau = OPAQUE on

    Written in tau: -log(1 - opacity) is tau itself, so that the gradient doesn't vanish where opacity saturates.
    tau is kept above 1e-4, because the first term's derivative 1 / tau is unbounded. Reason for the limit OPAQUE:
    samples end a little behind the surface, which limits tau; without it every ray through the solid would demand more,
    and, because these are far more than the rays at the silhouette, inflate the surface.
    """
    t = tau.clamp(min=1e-4)
    covered = torch.where(tau < OPAQUE, -torch.log(-torch.expm1(-t)), torch.zeros_like(t))
    return alpha * covered + (1 - alpha) * tau
