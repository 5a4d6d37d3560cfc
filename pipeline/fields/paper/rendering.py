"""The paper's rendering of a ray's samples, over our thin shell around the traced surface. [NeuFace eq. 18]

density      crossing | laplace     laplace: VolSDF's density and quadrature
volumetric   every sample is shaded, then averaged; otherwise one shading at the expected point
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import torch
from torch import Tensor

from pipeline.fields.parts import RayPoints, RayRendering, Shaded
from pipeline.fields.rendering import ExpectedPoint
from pipeline.fields.spec import FaceSpec
from pipeline.maths.density import laplace_density, ray_weights


class LaplaceDensity(ExpectedPoint):
    """Weights by the Laplace density."""

    def weights(self, s: Tensor, half_width: Tensor, hit: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
        """The last sample of a ray that hits represents the solid behind it too."""
        delta = (2 * half_width / s.shape[1])[:, None].expand_as(s).clone()
        delta[:, -1] += torch.where(hit, 2 * half_width, torch.zeros_like(half_width))
        return ray_weights(laplace_density(s, beta), delta)


class EverySample:
    """Shades every sample; the weights are those of another rendering."""

    def __init__(self, weighted: RayRendering) -> None:
        self.weights = weighted.weights

    def shade(self, model: Callable[[Tensor, Tensor, Tensor], Shaded], at: RayPoints) -> Shaded:
        """The mean over the samples by their shares."""
        x, n, share = at.samples()
        wo = at.wo.repeat_interleave(share.shape[1], 0)
        every = model(x.reshape(-1, 3), n.reshape(-1, 3), wo)
        return Shaded(**{f.name: _mean(getattr(every, f.name), share) for f in fields(Shaded)})


def rendering(spec: FaceSpec) -> RayRendering:
    """The rendering of a compared system."""
    weighted: RayRendering = LaplaceDensity() if spec.density == "laplace" else ExpectedPoint()
    return EverySample(weighted) if spec.volumetric else weighted


def _mean(values: Tensor, share: Tensor) -> Tensor:
    """Weighted mean over the samples: (M * S, ...), (M, S) -> (M, ...)."""
    every = values.reshape(*share.shape, *values.shape[1:])
    return (share.reshape(*share.shape, *[1] * (values.dim() - 1)) * every).sum(1)
