"""The captured light: learnable SH coefficients, constant over the subject. [NeuFace eq. 2]"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from pipeline.maths.sh import count


class ShLight(nn.Module):
    """Coefficients (K, 3). Starts as an even white light of the given radiance."""

    def __init__(self, order: int, start: float) -> None:
        super().__init__()
        c = torch.zeros(count(order), 3)
        c[0] = start * math.sqrt(4 * math.pi)  # Y_00 = 1 / sqrt(4 pi)
        self.coefficients = nn.Parameter(c)

    def forward(self) -> Tensor:
        """The coefficients."""
        return self.coefficients
