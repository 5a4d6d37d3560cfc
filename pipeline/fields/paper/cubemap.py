"""A learnable cube map as the captured light, blurred with lobes of several widths. [NeuFace section 5.2]

Symbols: T texels; level 0 is the map itself, level i is averaged with a lobe of width WIDTHS[i]; between levels, values
are interpolated in the logarithm of the width.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from pipeline.maths import cubemap, sh
from pipeline.maths.split_sum import ggx_kernel

INV_KAPPAS = (0.01, 0.03, 0.08, 0.2, 0.5, 1.2)
ALPHAS = (0.08, 0.15, 0.28, 0.45, 0.7, 1.0)


class CubemapLight(nn.Module):
    """Radiance of T texels >= 0. `lobe`: "vmf", widths are 1/kappa, or "ggx", widths are alpha."""

    blurs: Tensor
    cosine: Tensor
    harmonics: Tensor

    def __init__(self, size: int, start: float, lobe: str) -> None:
        super().__init__()
        self.size = size
        self.widths = INV_KAPPAS if lobe == "vmf" else ALPHAS
        d = cubemap.texel_directions(size)
        between = (d @ d.T).clamp(-1, 1)
        kernels = [torch.exp((between - 1) / w) if lobe == "vmf" else ggx_kernel(between, w) for w in self.widths]
        self.register_buffer("blurs", torch.stack([cubemap.blur(size, k) for k in kernels]).float(), persistent=False)
        self.register_buffer("cosine", cubemap.blur(size, between.clamp(min=0)).float() * math.pi, persistent=False)
        weighted = sh.sh_basis(d, sh.ORDER).T * cubemap.solid_angles(size)
        self.register_buffer("harmonics", weighted.float(), persistent=False)
        self.raw = nn.Parameter(torch.full((len(d), 3), math.log(math.expm1(max(start, 1e-4)))))

    def texels(self) -> Tensor:
        """The map (T, 3)."""
        return functional.softplus(self.raw)

    def forward(self) -> Tensor:
        """SH coefficients of order 10 of the map, (121, 3), for the other stages."""
        out: Tensor = self.harmonics @ self.texels()
        return out

    def uniform_gradient(self, order: int) -> None:
        """Make the gradient equal for all colours, while only the light is optimised. A map has no order."""
        if self.raw.grad is not None:
            self.raw.grad.copy_(self.raw.grad.mean(-1, keepdim=True).expand_as(self.raw.grad))

    def irradiance(self, n: Tensor) -> Tensor:
        """E(n), (N, 3)."""
        return cubemap.lookup((self.cosine @ self.texels())[None], n, torch.zeros_like(n[:, 0]))

    def reflected(self, w_r: Tensor, width: Tensor, attenuation: str = "") -> Tensor:
        """Radiance averaged over the lobe of `width` (N,) around w_r, (N, 3). A map needs no attenuation."""
        t = self.texels()
        levels = torch.cat([t[None], self.blurs @ t])
        return cubemap.lookup(levels, w_r, self.level(width))

    def level(self, width: Tensor) -> Tensor:
        """Fractional level (N,) of a width: linear up to the first width (level 1), then logarithmic, then constant."""
        steps = torch.tensor(self.widths, device=width.device, dtype=width.dtype)
        log = torch.log(width.clamp(min=self.widths[0]))
        edges = torch.log(steps)
        k = torch.bucketize(log.detach(), edges, right=True).clamp(1, len(steps) - 1)
        share = ((log - edges[k - 1]) / (edges[k] - edges[k - 1])).clamp(max=1)
        return torch.where(width < self.widths[0], width / self.widths[0], k.to(width) + share)
