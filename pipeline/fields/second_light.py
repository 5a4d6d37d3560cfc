"""The light of a second capture of the same subject, with its shadows; geometry and reflectance are shared.

Two photos of one point under two lights have two irradiances and one albedo, so that what changes between them can
only be the light. A model under two lights is fitted to the photos of both captures; `FaceModel.of_light` then gives
the model of either capture, which is one like any other.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.fields.light import ShLight
from pipeline.fields.parts import Integral, Light, Shading, System
from pipeline.fields.shadowing import Shadowing
from pipeline.fields.spec import FaceSpec
from pipeline.maths import brdf


class SecondLight(nn.Module):
    """light: SH coefficients, at the start uniform and of the spec's colour. shading: the specular term under it.
    shadowing: as the model's own."""

    def __init__(self, spec: FaceSpec, system: System, basis: Integral) -> None:
        super().__init__()
        start = ShLight(spec.light_order, 1.0)
        with torch.no_grad():
            start.coefficients.mul_(torch.tensor(spec.second_light_start))
        self.light: Light = start
        self.shading: Shading = system.shading(spec, basis, start)
        self.shadowing = Shadowing(spec.lo, spec.hi) if spec.shadows else None

    def diffuse(self, albedo: Tensor, x: Tensor, n: Tensor) -> Tensor:
        """L_d (N, 3), including shadows if they are modelled."""
        open_light = brdf.lambertian(albedo, self.light.irradiance(n))
        return open_light if self.shadowing is None else open_light * self.shadowing(x)


def chosen(second: Tensor | None, first_value: Tensor, second_value: Tensor) -> Tensor:
    """(N, 3) second_value where `second` (N,), first_value elsewhere."""
    return first_value if second is None else torch.where(second[:, None], second_value, first_value)
