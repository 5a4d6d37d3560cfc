"""The paper's networks over positions: a sinusoidal Spatial MLP and positional encoding. [NeuFace section 4.1, B]

Symbols: u = (x - centre) / radius, the position in the sphere Omega that holds the subject, so that |u| <= 1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from pipeline.fields.appearance import heads, start_heads

FREQUENCY = 30.0  # [Sitzmann et al. 2020, section 3.2]
SKIP = 4


class SineLayer(nn.Module):
    """sin(30 (W x + b)), initialised so that the variance of activations is the same in all layers.

    Differs: biases are random instead of 0. With zero biases the initial network is an odd function, so that the two
    halves of a face would start as negatives of each other.
    """

    def __init__(self, width_in: int, width: int, first: bool = False) -> None:
        super().__init__()
        self.linear = nn.Linear(width_in, width)
        bound = 1 / width_in if first else math.sqrt(6 / width_in) / FREQUENCY
        with torch.no_grad():
            self.linear.weight.uniform_(-bound, bound)
            self.linear.bias.uniform_(-1 / math.sqrt(width_in), 1 / math.sqrt(width_in))

    def forward(self, x: Tensor) -> Tensor:
        """(N, in) -> (N, width)."""
        return torch.sin(FREQUENCY * self.linear(x))


class SinusoidalField(nn.Module):
    """x (N, 3) -> albedo (N, 3), rho (N,), c (N, k), 1/kappa (N,): the paper's Spatial MLP.

    `columns` k: coefficients of the bases, or features; `positive`: keep them >= 0.
    """

    centre: Tensor

    def __init__(
        self,
        centre: Tensor,
        radius: float,
        columns: int,
        positive: bool,
        albedo: tuple[float, float, float] = (0.4, 0.4, 0.4),
        width: int = 256,
        depth: int = 8,
    ) -> None:
        super().__init__()
        self.columns, self.positive, self.radius = columns, positive, radius
        self.register_buffer("centre", centre.float().clone())
        sizes = [3 if i == 0 else width + 3 if i == SKIP else width for i in range(depth)]
        self.layers = nn.ModuleList(SineLayer(n, width, first=i == 0) for i, n in enumerate(sizes))
        self.last = nn.Linear(width, 5 + columns)
        start_heads(self.last, albedo)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Material at x (N, 3)."""
        u = (x - self.centre) / self.radius
        h = u
        for i, layer in enumerate(self.layers):
            h = layer(torch.cat([h, u], -1) if i == SKIP else h)
        return heads(self.last(h), self.positive)


def positional_encoding(u: Tensor, octaves: int) -> Tensor:
    """gamma(u) = (sin 2^0 pi u, cos 2^0 pi u, ..., cos 2^(L-1) pi u): (N, D) -> (N, 2 L D). [NeuFace section B]"""
    scaled = u[:, None, :] * (math.pi * 2.0 ** torch.arange(octaves, device=u.device, dtype=u.dtype))[:, None]
    return torch.cat([torch.sin(scaled), torch.cos(scaled)], -1).flatten(1)
