"""Reflectance: where on the face (spatial network) and how it reflects (integrated bases).

Symbols: x -> (a, rho, c, 1/kappa) is the Spatial MLP and (wo, n, wo . n) -> B the Integrated Basis MLP of
[NeuFace section 4.1, 4.2]. c and B are kept >= 0, so that c . B is a reflectance by construction.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from pipeline.fields.encodings import HashEncoding

START_RHO = 0.05
LESSONS, LESSON_RATE = 500, 1e-2
TYPICAL_INV_KAPPA = 0.1  # kappa = 10, a GGX roughness of 0.44: typical for skin


def mlp(width_in: int, width: int, depth: int, width_out: int) -> nn.Sequential:
    """MLP with `depth` hidden ReLU layers."""
    layers: list[nn.Module] = []
    for i in range(depth):
        layers += [nn.Linear(width_in if i == 0 else width, width), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(width if depth else width_in, width_out))


def start_heads(last: nn.Linear, albedo: tuple[float, float, float]) -> None:
    """Initialise the last layer so that the field starts as skin of one colour and typical gloss."""
    with torch.no_grad():
        last.weight *= 0.1
        last.bias[:3] = torch.logit(torch.tensor(albedo))
        last.bias[3] = math.log(START_RHO / (1 - START_RHO))
        last.bias[4] = math.log(math.expm1(TYPICAL_INV_KAPPA))
        last.bias[5:] = math.log(math.expm1(1.0))


def restart_lobe(last: nn.Linear, rho: float) -> None:
    """Reset the last layer so that the lobe is the typical one of skin everywhere; the albedo is kept."""
    with torch.no_grad():
        last.weight[3:] = 0.0
        last.bias[3] = math.log(rho / (1 - rho))
        last.bias[4] = math.log(math.expm1(TYPICAL_INV_KAPPA))
        last.bias[5:] = math.log(math.expm1(1.0))


def heads(raw: Tensor, positive: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """albedo, rho, c, 1/kappa from the outputs of the last layer: sigmoid, sigmoid, softplus (or none), softplus."""
    return (
        torch.sigmoid(raw[:, :3]),
        torch.sigmoid(raw[:, 3]),
        functional.softplus(raw[:, 5:]) if positive else raw[:, 5:],
        functional.softplus(raw[:, 4]),
    )


class SpatialField(nn.Module):
    """x (N, 3) -> albedo (N, 3), rho (N,), c (N, k) of [NeuFace eq. 7], 1/kappa (N,).

    Differs: a hash encoding and a small ReLU network replace the paper's sinusoidal MLP (about 10 times faster per
    sample on a CPU, docs/benchmarks.md). Heads as in the paper: sigmoid, sigmoid, (softplus), softplus.

    level: factor of a and rho, 1 during the fit; it is changed together with the light, at the end.
    """

    level: Tensor

    def __init__(
        self,
        encoding: HashEncoding,
        rank: int,
        width: int,
        depth: int,
        albedo: tuple[float, float, float],
        positive: bool = True,
    ) -> None:
        super().__init__()
        self.encoding, self.rank, self.positive = encoding, rank, positive
        self.net = mlp(encoding.width, width, depth, 5 + rank)
        last = self.net[-1]
        assert isinstance(last, nn.Linear)
        start_heads(last, albedo)
        self.register_buffer("level", torch.ones(()))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Material at x (N, 3)."""
        albedo, rho, c, inv_kappa = heads(self.net(self.encoding(x)), self.positive)
        return albedo * self.level, rho * self.level, c, inv_kappa


class IntegratedBasis(nn.Module):
    """(wo, n, wo . n) -> B (N, k) >= 0. [NeuFace eq. 9]

    Differs: with `cosine_only` the input of the network is only wo . n. The integral of an isotropic lobe depends on
    nothing else; with the paper's inputs it also depends on the directions in the world, which no texture can
    represent.
    """

    def __init__(self, rank: int, width: int, depth: int, cosine_only: bool) -> None:
        super().__init__()
        self.cosine_only = cosine_only
        self.net = mlp(1 if cosine_only else 7, width, depth, rank)
        with torch.no_grad():
            last = self.net[-1]
            assert isinstance(last, nn.Linear)
            last.bias.add_(math.log(math.expm1(1.0 / rank)))

    @property
    def rank(self) -> int:
        """k."""
        last = self.net[-1]
        assert isinstance(last, nn.Linear)
        return last.out_features

    def forward(self, wo: Tensor, n: Tensor) -> Tensor:
        """B (N, k) at unit directions, (N, 3) each; wo . n is clamped to >= 0, as at visible points."""
        cosine = (wo * n).sum(-1, keepdim=True).clamp(min=0)
        out: Tensor = functional.softplus(self.net(cosine if self.cosine_only else torch.cat([wo, n, cosine], -1)))
        return out

    def learn(self, target: Callable[[Tensor], Tensor]) -> None:
        """Fit the sum of the bases to a function of n . wo, (N,) -> (N,)."""
        cosine = torch.linspace(0.0, 1.0, 101, device=next(self.net.parameters()).device)[:, None]
        wanted = target(cosine[:, 0])
        optimiser = torch.optim.Adam(self.net.parameters(), lr=LESSON_RATE)
        for _ in range(LESSONS):
            optimiser.zero_grad(set_to_none=True)
            loss = ((functional.softplus(self.net(cosine)).sum(-1) - wanted) ** 2 / wanted).mean()
            loss.backward()
            optimiser.step()
        self.zero_grad(set_to_none=True)

    def integral(self, x: Tensor, c: Tensor, wo: Tensor, n: Tensor) -> Tensor:
        """c(x) . B(wo, n): the integral of [NeuFace eq. 7], the low-rank prior, (N,). [NeuFace eq. 8]"""
        out: Tensor = (c * self(wo, n)).sum(-1)
        return out
