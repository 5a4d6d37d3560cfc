"""The specular term with neural bases under the captured light, from which the asset is baked."""

from __future__ import annotations

from torch import Tensor

from pipeline.fields.appearance import IntegratedBasis
from pipeline.fields.parts import Light, Skin
from pipeline.fields.protocol import F32
from pipeline.maths import brdf


class BasisShading:
    """L_s = rho (c . B) int D L. [NeuFace eq. 12]"""

    def __init__(self, basis: IntegratedBasis, light: Light, attenuation: str) -> None:
        self.basis, self.light, self.attenuation = basis, light, attenuation

    @property
    def rank(self) -> int:
        """k."""
        return self.basis.rank

    def diffuse_albedo(self, skin: Skin) -> Tensor:
        """The albedo (N, 3), unchanged."""
        return skin.albedo

    def specular(self, skin: Skin, x: Tensor, n: Tensor, wo: Tensor) -> Tensor:
        """L_s (N, 3)."""
        incident = self.light.reflected(brdf.reflect(wo, n), skin.inv_kappa, self.attenuation)
        return brdf.specular(skin.rho, self.basis.integral(x, skin.c, wo, n), incident)

    def coefficients(self, c: F32) -> F32:
        """The coefficients (N, k), unchanged."""
        return c

    def bases(self, wo: Tensor, n: Tensor) -> Tensor:
        """B(wo, n), (N, k). [NeuFace eq. 9]"""
        out: Tensor = self.basis(wo, n)
        return out
