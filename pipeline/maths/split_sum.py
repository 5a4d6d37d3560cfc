"""Split sum: GGX under an environment map as a blurred light times a table [Karis 2013], for [NeuFace section 5.2].

Symbols: n.v cosine to the viewer; alpha GGX width; F0 reflectance at normal incidence (Schlick);
    int f_GGX (n.l) dl = F0 A(n.v, alpha) + B(n.v, alpha)
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from pipeline.maths.precision import full_precision

SIZE, SAMPLES = 32, 4096


def ggx_kernel(cosine: Tensor, alpha: float) -> Tensor:
    """Kernel (any shape) that blurs a light by a GGX lobe viewed along its axis (n = v = r): D(h) (n.l), unnormalised.

    h is the half vector, so n.h = sqrt((1 + cos) / 2).
    """
    half = (1 + cosine) / 2
    d = 1 / (half * (alpha * alpha - 1) + 1) ** 2
    return d * cosine.clamp(min=0)


def smith(cosine: Tensor, alpha: Tensor) -> Tensor:
    """Smith's Lambda of GGX at an angle: (sqrt(1 + alpha^2 tan^2) - 1) / 2."""
    c2 = (cosine * cosine).clamp(1e-8, 1)
    return (torch.sqrt(1 + alpha * alpha * (1 - c2) / c2) - 1) / 2


@lru_cache(maxsize=1)
def table() -> Tensor:
    """A and B at n.v = (i + 1/2) / SIZE and alpha = (j + 1/2) / SIZE: (SIZE, SIZE, 2) float32.

    By half vectors sampled from D (n.h) on a fixed lattice; height-correlated masking.
    """
    at = (torch.arange(SIZE, dtype=torch.float64) + 0.5) / SIZE
    nv, alpha = torch.meshgrid(at, at, indexing="ij")
    nv, alpha = nv[..., None], alpha[..., None]
    i = torch.arange(SAMPLES, dtype=torch.float64)
    u, phi = (i + 0.5) / SAMPLES, 2 * torch.pi * ((i * 0.6180339887498949) % 1)
    nh = torch.sqrt((1 - u) / (1 + (alpha * alpha - 1) * u))
    sh = torch.sqrt((1 - nh * nh).clamp(min=0))
    vh = (torch.sqrt(1 - nv * nv) * sh * torch.cos(phi) + nv * nh).clamp(min=0)
    nl = 2 * vh * nh - nv
    g = 1 / (1 + smith(nv, alpha) + smith(nl, alpha))
    share = torch.where(nl > 0, g * vh / (nh * nv).clamp(min=1e-12), torch.zeros_like(nl))
    fresnel = (1 - vh) ** 5
    return torch.stack([(share * (1 - fresnel)).mean(-1), (share * fresnel).mean(-1)], -1).float()


@full_precision
def environment_brdf(f0: Tensor, nv: Tensor, alpha: Tensor) -> Tensor:
    """F0 A + B: (N, 3), (N,), (N,) -> (N, 3), bilinear in the table."""
    t = table().to(f0)
    x = (nv.clamp(0, 1) * SIZE - 0.5).clamp(0, SIZE - 1)
    y = (alpha.clamp(0, 1) * SIZE - 0.5).clamp(0, SIZE - 1)
    i, j = (v.detach().floor().long().clamp(max=SIZE - 2) for v in (x, y))
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    ab = (1 - fx) * ((1 - fy) * t[i, j] + fy * t[i, j + 1]) + fx * ((1 - fy) * t[i + 1, j] + fy * t[i + 1, j + 1])
    return f0 * ab[:, :1] + ab[:, 1:]
