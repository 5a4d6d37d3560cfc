"""Geometry priors: the initial surface and the region in which the surface is searched. [NeuFace section 4.3]

A prior is a network module with three functions, all in asset units and coordinates:

    sdf(x)        (N, 3) -> (N,), differentiable in x and in its parameters
    sphere()      centre and radius of Omega, the sphere inside which it is defined [NeuFace section 4.4]
    embeddings()  what [NeuFace eq. 24] regularises, or None

`share` is the factor of its learning rate: 0.01 for ImFace as in the paper (section B), 1 for a network that starts as
a sphere, 0 for the hull, which is frozen.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from pipeline.maths.sdf import spline_sdf


class Prior(Protocol):
    """Interface of a prior; see above."""

    share: float

    def sdf(self, x: Tensor) -> Tensor:
        """(N, 3) -> (N,)."""
        ...

    def sphere(self) -> tuple[Tensor, float]:
        """Centre (3,) and radius of Omega."""
        ...

    def embeddings(self) -> Tensor | None:
        """(E,) or None."""
        ...


class HullPrior(nn.Module):
    """The visual hull's distance on a spline grid. It is frozen; only the displacement network is learnt.

    Differs: the paper starts from ImFace, whose weights need a licence. The hull needs none and has the subject's size.
    """

    share = 0.0
    edge: Tensor
    values: Tensor
    lo: Tensor

    def __init__(self, values: Tensor, lo: Tensor, cell: float) -> None:
        super().__init__()
        self.register_buffer("edge", torch.tensor(cell, dtype=torch.float64))
        self.register_buffer("values", values.float().clone())
        self.register_buffer("lo", lo.float().clone())

    @property
    def cell(self) -> float:
        """Edge of a cell."""
        return float(self.edge)

    def sdf(self, x: Tensor) -> Tensor:
        """Spline value; outside the grid, that of its border plus the distance to it."""
        hi = self.lo + (torch.tensor(self.values.shape, device=x.device) - 1) * self.cell
        inside = torch.minimum(torch.maximum(x, self.lo), hi)
        beyond = torch.sqrt(((x - inside) ** 2).sum(-1) + 1e-16) - 1e-8
        return spline_sdf(self.values, inside, self.lo, self.cell)[0] + beyond

    def sphere(self) -> tuple[Tensor, float]:
        """Sphere around the hull's solid, with 1.1 times half its diagonal as radius."""
        near = torch.nonzero(self.values < self.cell)
        if not len(near):
            near = torch.tensor([[0, 0, 0], list(self.values.shape)], device=self.values.device)
        a, b = (self.lo + near.amin(0) * self.cell), (self.lo + near.amax(0) * self.cell)
        return (a + b) / 2, 0.55 * float((b - a).norm())

    def embeddings(self) -> Tensor | None:
        """None."""
        return None


class SpherePrior(nn.Module):
    """A network that is initialised to a sphere, for general objects. [NeuFace section 5.3]

    Geometric initialisation of IDR: softplus(100 .) layers, initialised so that the output is |u| - r; the weights of
    the positional encoding start at zero.
    """

    share = 1.0
    centre: Tensor

    def __init__(self, centre: Tensor, radius: float, width: int = 256, depth: int = 4, octaves: int = 6) -> None:
        super().__init__()
        self.radius, self.octaves = radius, octaves
        self.register_buffer("centre", centre.float().clone())
        sizes = [3 + 6 * octaves] + [width] * depth
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False))
        self.last = nn.Linear(width, 1)
        with torch.no_grad():
            for i, layer in enumerate(self.layers):
                assert isinstance(layer, nn.Linear)
                layer.bias.zero_()
                layer.weight.normal_(0, math.sqrt(2 / layer.out_features))
                if i == 0:
                    layer.weight[:, 3:] = 0
            self.last.weight.normal_(math.sqrt(math.pi / width), 1e-4)
            self.last.bias.fill_(-self.START)

    START = 0.6  # radius of the initial sphere over that of Omega

    def sdf(self, x: Tensor) -> Tensor:
        """Network value (N,), asset units."""
        from pipeline.fields.paper.sinusoidal import positional_encoding

        u = (x - self.centre) / self.radius
        h = torch.cat([u, positional_encoding(u, self.octaves)], -1)
        for layer in self.layers:
            h = functional.softplus(layer(h), beta=100)
        out: Tensor = self.last(h).squeeze(-1) * self.radius
        return out

    def sphere(self) -> tuple[Tensor, float]:
        """As given."""
        return self.centre, self.radius

    def embeddings(self) -> Tensor | None:
        """None."""
        return None
