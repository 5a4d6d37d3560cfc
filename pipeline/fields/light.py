"""The captured light: learnable SH coefficients, constant over the subject. [NeuFace eq. 2]"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from pipeline.maths.brdf import light_integral
from pipeline.maths.sh import count, irradiance


class ShLight(nn.Module):
    """Coefficients (K, 3). Initialised to a uniform white light of the given radiance."""

    def __init__(self, order: int, start: float) -> None:
        super().__init__()
        c = torch.zeros(count(order), 3)
        c[0] = start * math.sqrt(4 * math.pi)  # Y_00 = 1 / sqrt(4 pi)
        self.coefficients = nn.Parameter(c)

    def forward(self) -> Tensor:
        """The coefficients (K, 3)."""
        return self.coefficients

    def uniform_gradient(self, order: int) -> None:
        """Restrict the gradient while only the light is optimised: equal for all colours, no orders above `order`."""
        grad = self.coefficients.grad
        if grad is not None:
            grad.copy_(grad.mean(-1, keepdim=True).expand_as(grad))
            grad[count(order) :] = 0

    def irradiance(self, n: Tensor) -> Tensor:
        """E(n), (N, 3) for normals (N, 3)."""
        return irradiance(self.coefficients, n)

    def reflected(self, w_r: Tensor, width: Tensor, attenuation: str) -> Tensor:
        """Radiance averaged over a lobe of 1/kappa = `width` (N,) around w_r, (N, 3). [NeuFace eq. 11]"""
        return light_integral(w_r, width, self.coefficients, attenuation)
