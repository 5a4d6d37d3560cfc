"""The specular terms with which the paper compares its own. [NeuFace section 5.2]"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import StageError
from pipeline.fields.parts import Integral, Light, Skin
from pipeline.fields.protocol import F32
from pipeline.fields.spec import FaceSpec
from pipeline.maths import brdf, ggx_width, split_sum

DIELECTRIC = 0.04  # F0 of non-metals


class IntegralShading:
    """L_s = rho F int D L with a material integral F that is not of low rank, so that textures can't represent it."""

    def __init__(self, spec: FaceSpec, integral: Integral, light: Light) -> None:
        self.spec, self.integral, self.light = spec, integral, light

    @property
    def rank(self) -> int:
        """k of the spec; it is not used."""
        return self.spec.rank

    def diffuse_albedo(self, skin: Skin) -> Tensor:
        """As it is."""
        return skin.albedo

    def specular(self, skin: Skin, x: Tensor, n: Tensor, wo: Tensor) -> Tensor:
        """L_s (N, 3)."""
        incident = self.light.reflected(brdf.reflect(wo, n), skin.inv_kappa, self.spec.attenuation)
        return brdf.specular(skin.rho, self.integral.integral(x, skin.c, wo, n), incident)

    def coefficients(self, c: F32) -> F32:
        """As they are."""
        return c

    def bases(self, wo: Tensor, n: Tensor) -> Tensor:
        """Raises StageError: there are no bases."""
        raise StageError(
            "this model has no specular bases to bake",
            where="inverse_rendering.shading, inverse_rendering.integral",
            value=f"{self.spec.shading}, {self.spec.integral}",
            limit="shading neural or phong, and integral low_rank",
            remedy="such models are for comparisons (neuface bench ablations); fit one with bases for an asset",
        )


class PhongShading(IntegralShading):
    """L_s = rho int D L: one lobe, like a basis that is 1 everywhere."""

    @property
    def rank(self) -> int:
        """1."""
        return 1

    def specular(self, skin: Skin, x: Tensor, n: Tensor, wo: Tensor) -> Tensor:
        """L_s (N, 3)."""
        incident = self.light.reflected(brdf.reflect(wo, n), skin.inv_kappa, self.spec.attenuation)
        return brdf.specular(skin.rho, torch.ones_like(skin.rho), incident)

    def coefficients(self, c: F32) -> F32:
        """(N, 1) ones."""
        return np.ones((len(c), 1), np.float32)

    def bases(self, wo: Tensor, n: Tensor) -> Tensor:
        """(N, 1) ones."""
        return super().bases(wo, n) if self.spec.integral != "low_rank" else torch.ones_like(wo[:, :1])


class DisneyShading(IntegralShading):
    """Split-sum GGX with a metallic parameter, for which the output rho is used."""

    def diffuse_albedo(self, skin: Skin) -> Tensor:
        """(N, 3): albedo of the non-metallic part."""
        return skin.albedo * (1 - skin.rho[:, None])

    def specular(self, skin: Skin, x: Tensor, n: Tensor, wo: Tensor) -> Tensor:
        """L_s (N, 3)."""
        m, alpha = skin.rho[:, None], ggx_width.gauge_alpha(skin.inv_kappa)
        f0 = DIELECTRIC * (1 - m) + skin.albedo * m
        width = alpha if self.spec.light == "cubemap" else skin.inv_kappa
        incident = self.light.reflected(brdf.reflect(wo, n), width, self.spec.attenuation)
        return split_sum.environment_brdf(f0, (n * wo).sum(-1), alpha) * incident
