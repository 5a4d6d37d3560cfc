"""Per-image colour response. [NeuFace eq. 19]"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.fields.appearance import mlp

WIDTH, EMBEDDING = 32, 8


class Calibration(nn.Module):
    """A_n = I + M_n - mean of all M_n: (views, 3, 3). M_n is a small network on a learnt embedding.

    The last layer is initialised to zero, so that every A_n starts at the identity. The mean is subtracted because one
    colour transform is ambiguous between albedo, light and the A_n; with the mean A fixed at I, it is in the light.
    """

    def __init__(self, views: int) -> None:
        super().__init__()
        self.embedding = nn.Parameter(torch.randn(views, EMBEDDING) * 0.1)
        self.net = mlp(EMBEDDING, WIDTH, 1, 9)
        with torch.no_grad():
            last = self.net[-1]
            assert isinstance(last, nn.Linear)
            last.weight.zero_()
            last.bias.zero_()

    def forward(self) -> Tensor:
        """All A_n, (views, 3, 3)."""
        m = self.net(self.embedding).reshape(-1, 3, 3)
        out: Tensor = torch.eye(3, device=m.device) + m - m.mean(0)
        return out
