"""Our rendering of a ray's samples: weights by the crossing of the surface, shaded once at the expected point.

Differs from [NeuFace eq. 18], which shades every sample: over a shell of less than a millimetre the radiance is nearly
linear, so the mean of the values is the value at the mean. pipeline.fields.paper.rendering has the paper's way;
docs/benchmarks.md compares both.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from pipeline.fields.parts import RayPoints, Shaded
from pipeline.maths.density import crossing_weights


class ExpectedPoint:
    """`pipeline.fields.parts.RayRendering`."""

    def weights(self, s: Tensor, half_width: Tensor, hit: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
        """By the survival of the Laplace density along the SDF, unbiased at the zero crossing."""
        return crossing_weights(s, beta)

    def shade(self, model: Callable[[Tensor, Tensor, Tensor], Shaded], at: RayPoints) -> Shaded:
        """At the expected point."""
        return model(at.x, at.n, at.wo)
