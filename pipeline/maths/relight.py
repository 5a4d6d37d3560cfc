"""Other lights than the captured one, as SH coefficients.

Symbols: c_lm ((L + 1)^2, 3) real orthonormal coefficients (pipeline.maths.sh); d unit direction towards the light;
s = 1 / kappa. A lat-long picture (H, W, 3) is linear radiance; row 0 is next to +Y, the middle column looks along +Z
and columns grow towards -X, as in docs/conventions.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pipeline.maths import sh
from pipeline.maths.precision import full_precision

WINDOWS = ("none", "hanning", "lanczos")


@dataclass(frozen=True, slots=True)
class Energy:
    """What a projection kept. flux: sum of L dw (3,). kept_flux: of the coefficients, equal up to rounding.
    kept_power: share of the integral of L^2 that the coefficients carry (3,): the rest is detail beyond the order.
    lowest: the smallest radiance of the projection; far below 0 the light rings."""

    flux: Tensor
    kept_flux: Tensor
    kept_power: Tensor
    lowest: float


def lat_long_directions(height: int, width: int) -> Tensor:
    """Unit directions of pixel centres: (H, W, 3) float64."""
    polar = (torch.arange(height, dtype=torch.float64) + 0.5) * math.pi / height
    turn = (torch.arange(width, dtype=torch.float64) + 0.5) * 2 * math.pi / width - math.pi
    p, t = torch.meshgrid(polar, turn, indexing="ij")
    return torch.stack([-torch.sin(p) * torch.sin(t), torch.cos(p), torch.sin(p) * torch.cos(t)], -1)


def lat_long_solid_angles(height: int, width: int) -> Tensor:
    """Exact solid angle of a pixel in every row: (H,) float64. width times their sum is 4 pi."""
    edge = torch.cos(torch.arange(height + 1, dtype=torch.float64) * math.pi / height)
    return (edge[:-1] - edge[1:]) * 2 * math.pi / width


@full_precision
def project_lat_long(picture: Tensor, order: int = sh.ORDER, window: str = "none") -> Tensor:
    """Coefficients of a lat-long picture of linear radiance, (H, W, 3) -> ((order + 1)^2, 3), in its dtype.

    Rows are summed one after the other in float64, so that a picture with a sun of 1e5 keeps its dark side.
    """
    height, width = picture.shape[:2]
    directions, area = lat_long_directions(height, width), lat_long_solid_angles(height, width)
    c = torch.zeros(sh.count(order), 3, dtype=torch.float64)
    for row in range(height):
        c = c + area[row] * sh.sh_basis(directions[row], order).T @ picture[row].to(torch.float64).cpu()
    return (window_of(order, window)[:, None] * c).to(picture)


def window_of(order: int, kind: str) -> Tensor:
    """Factor of every coefficient against ringing: ((order + 1)^2,) float64; band 0 keeps its energy.

    hanning: (1 + cos(pi l / (L + 1))) / 2. lanczos: sinc(pi l / (L + 1)). ValueError for another name.
    """
    if kind not in WINDOWS:
        raise ValueError(f"unknown window {kind!r}; one of {', '.join(WINDOWS)}")
    x = torch.arange(order + 1, dtype=torch.float64) / (order + 1)
    band = {"none": torch.ones_like(x), "hanning": (1 + torch.cos(math.pi * x)) / 2, "lanczos": torch.sinc(x)}[kind]
    return band.repeat_interleave(2 * torch.arange(order + 1) + 1)


def energy_of(picture: Tensor, c: Tensor) -> Energy:
    """How much of a picture its projection c carries."""
    height, width = picture.shape[:2]
    weight = lat_long_solid_angles(height, width)[:, None, None]
    light, c64 = picture.double().cpu(), c.double().cpu()
    found = sh.radiance(c64, lat_long_directions(32, 64).reshape(-1, 3))
    return Energy(
        (weight * light).sum((0, 1)),
        c64[0] * math.sqrt(4 * math.pi),
        (c64 * c64).sum(0) / (weight * light * light).sum((0, 1)).clamp(min=1e-300),
        float(found.min()),
    )


@full_precision
def rotate(c: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients of the light turned by `rotation` (3, 3): L'(d) = L(R^-1 d). Same shape and dtype.

    L' is a polynomial of the same order, so that a product rule (Gauss in z, even in the azimuth) projects it exactly.
    """
    order = sh.order_of(c)
    d, w = product_rule(order)
    turned = d @ rotation.double().cpu()  # rows: R^T d
    basis = sh.sh_basis(d, order) * w[:, None]
    return (basis.T @ (sh.sh_basis(turned, order) @ c.double().cpu())).to(c)


def product_rule(order: int) -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate polynomials up to order 2 * `order` over the sphere exactly."""
    import numpy as np

    z, wz = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(order + 1))
    phi = torch.arange(2 * order + 2, dtype=torch.float64) * math.pi / (order + 1)
    r = torch.sqrt(1 - z * z)[:, None]
    d = torch.stack([r * torch.cos(phi), r * torch.sin(phi), z[:, None].expand(-1, len(phi))], -1)
    return d.reshape(-1, 3), (wz[:, None] * math.pi / (order + 1)).expand(-1, len(phi)).reshape(-1)


def order_for(inv_kappa: float, tolerance: float = 0.01, most: int = 64) -> int:
    """The highest order that a lobe of 1 / kappa lets through: the last l with exp(-l (l + 1) s / 2) >= tolerance.

    Bands beyond it can't be seen in any highlight, so that a small light needs no more of them. [NeuFace eq. 11]
    """
    if inv_kappa <= 0:
        return most
    reach = 2 * math.log(1 / tolerance) / inv_kappa
    return min(most, max(int(math.floor((math.sqrt(1 + 4 * reach) - 1) / 2)), 2))


@full_precision
def directional(towards: Tensor, irradiance: Tensor, order: int) -> Tensor:
    """A distant light: radiance E delta(d - towards), (3,) unit and (3,) -> ((order + 1)^2, 3).

    c_lm = E Y_lm(towards). E is what a surface that faces the light receives.
    """
    return sh.sh_basis(towards[None], order).T * irradiance[None]


@full_precision
def point(position: Tensor, intensity: Tensor, x: Tensor, order: int) -> Tensor:
    """A small lamp as a surface point x sees it: intensity (3,) over squared distance, towards it.

    (3,), (3,), (3,) -> ((order + 1)^2, 3). The light differs from place to place: for a head under a lamp near it, ask
    at several places. ValueError if the lamp is at x.
    """
    to = position - x
    far = to.norm()
    if float(far.detach()) == 0:
        raise ValueError("the lamp is at the point that it lights")
    return directional(to / far, intensity / far**2, order)
