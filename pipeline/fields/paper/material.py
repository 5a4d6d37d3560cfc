"""The material integral without the low-rank prior, for the paper's comparisons. [NeuFace eq. 6]

Both classes replace `pipeline.fields.appearance.IntegratedBasis` and implement `integral`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from pipeline.fields.appearance import mlp
from pipeline.fields.paper.sinusoidal import positional_encoding

OCTAVES, FEATURES = 6, 256


def start_at_one(net: nn.Sequential) -> None:
    """Initialise the last bias so that softplus of the output starts near 1, like c . B."""
    last = net[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.bias.add_(math.log(math.expm1(1.0)))


def angles(wo: Tensor, n: Tensor) -> Tensor:
    """(wo, n, wo . n), the cosine kept >= 0: (N, 7)."""
    return torch.cat([wo, n, (wo * n).sum(-1, keepdim=True).clamp(min=0)], -1)


class DirectIntegral(nn.Module):
    """F(x, wo, n) by one network: 'directly fitting'. [NeuFace section 5.2, Table 3]"""

    centre: Tensor

    def __init__(self, centre: Tensor, radius: float, width: int, depth: int) -> None:
        super().__init__()
        self.radius = radius
        self.register_buffer("centre", centre.float().clone())
        self.net = mlp(3 + 6 * OCTAVES + 7, width, depth, 1)
        start_at_one(self.net)

    def integral(self, x: Tensor, c: Tensor, wo: Tensor, n: Tensor) -> Tensor:
        """F >= 0, (N,). c is not used."""
        u = (x - self.centre) / self.radius
        inputs = torch.cat([u, positional_encoding(u, OCTAVES), angles(wo, n)], -1)
        return functional.softplus(self.net(inputs)).squeeze(-1)


class FeatureIntegral(nn.Module):
    """F(f(x), wo, n) with a feature of 256 numbers from the Spatial MLP: '256-D feature'. [NeuFace section 5.2]"""

    def __init__(self, width: int, depth: int) -> None:
        super().__init__()
        self.net = mlp(FEATURES + 7, width, depth, 1)
        start_at_one(self.net)

    def integral(self, x: Tensor, c: Tensor, wo: Tensor, n: Tensor) -> Tensor:
        """F >= 0, (N,). c is the feature."""
        return functional.softplus(self.net(torch.cat([c, angles(wo, n)], -1))).squeeze(-1)
