"""SDF(x) = I(x) + D(x): a prior and a learnt displacement. [NeuFace eq. 17]

Values and normals are computed in one pass, with automatic differentiation.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.fields.appearance import mlp
from pipeline.fields.paper.priors import Prior
from pipeline.fields.paper.sinusoidal import positional_encoding
from pipeline.maths.tracing import aggressive_trace

OCTAVES = 6  # L of [NeuFace section B]
HEAD = 0.15  # metres: radius of Omega around a head, for which the paper gives its lengths
THRESHOLD, TRUNCATION = 5e-5 / HEAD, 0.05 / HEAD  # of Omega's radius [NeuFace section B]
FACTOR = 1.2  # [NeuFace section 4.4]
CELLS = 160  # nominal number of cells across Omega


class Displacement(nn.Module):
    """D(u): positional encoding of 6 octaves, ReLU layers, one output. [NeuFace eq. 17]

    The last layer is initialised to zero, so that the first step traces the prior itself.
    """

    def __init__(self, width: int = 256, depth: int = 3) -> None:
        super().__init__()
        self.net = mlp(6 * OCTAVES, width, depth, 1)
        last = self.net[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.zero_()
            last.bias.zero_()

    def forward(self, u: Tensor) -> Tensor:
        """(N, 3) in Omega's units -> (N,) in Omega's units."""
        out: Tensor = self.net(positional_encoding(u, OCTAVES)).squeeze(-1)
        return out


class DisplacedSdf(nn.Module):
    """A prior, its displacement, and the learnt width beta of the Laplace density.

    Lengths are in units of Omega's radius: neither learning rates nor tracing depend on the size of the subject.

    Differs: the paper's lengths are metres of a head. Here they are the same shares of Omega for every subject.
    """

    BETA_START, BETA_MIN = 0.01, 1e-4

    def __init__(self, prior: nn.Module, width: int = 256, depth: int = 3) -> None:
        super().__init__()
        self.prior = prior
        self.displacement = Displacement(width, depth)
        self.beta_raw = nn.Parameter(torch.tensor(self.BETA_START))

    @property
    def known(self) -> Prior:
        """The prior, with its type."""
        return self.prior  # type: ignore[return-value]

    @property
    def cell(self) -> float:
        """Nominal edge of the finest cell."""
        return 2 * self.known.sphere()[1] / CELLS

    def beta(self) -> Tensor:
        """Width of the Laplace density, asset units, > 0. [NeuFace section 4.4]"""
        return (self.beta_raw.abs() + self.BETA_MIN) * self.known.sphere()[1]

    def box(self) -> tuple[Tensor, Tensor]:
        """(3,) corners of the cube around Omega."""
        centre, radius = self.known.sphere()
        return centre - radius, centre + radius

    def parts(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """I(x) and D(x), (N,) each, asset units. [NeuFace eq. 17]"""
        centre, radius = self.known.sphere()
        return self.known.sdf(x), self.displacement((x - centre) / radius) * radius

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """SDF (N,) and gradient (N, 3) at x (N, 3); differentiable in the parameters if gradients are enabled."""
        s, g, _ = self.with_displacement(x)
        return s, g

    def with_displacement(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """SDF (N,), its gradient (N, 3) and the displacement D(x) (N,)."""
        wanted = torch.is_grad_enabled()
        with torch.enable_grad():
            at = x.detach().requires_grad_()
            known, moved = self.parts(at)
            s = known + moved
            (g,) = torch.autograd.grad(s.sum(), at, create_graph=wanted)
        return (s, g, moved) if wanted else (s.detach(), g.detach(), moved.detach())

    def trace(self, o: Tensor, d: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """t, hit and SDF by aggressive sphere tracing inside Omega. [NeuFace section 4.4]"""

        def sdf(p: Tensor) -> Tensor:
            known, moved = self.parts(p)
            return known + moved

        with torch.no_grad():
            unit = self.known.sphere()[1]
            return aggressive_trace(
                sdf, o, d, near, far, threshold=THRESHOLD * unit, truncation=TRUNCATION * unit, factor=FACTOR
            )
