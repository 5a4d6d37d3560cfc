"""Per-image colour response. [NeuFace eq. 19]"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from pipeline.fields.appearance import mlp

WIDTH, EMBEDDING = 32, 8


class Calibration(nn.Module):
    """A_n = I + M_n - mean of all M_n: (views, 3, 3). M_n is a small network on a learnt embedding.

    The last layer is initialised to zero, so that every A_n starts at the identity. The mean is subtracted because one
    colour transform is ambiguous between albedo, light and the A_n; with the mean A fixed at I, it is in the light.

    A second capture under a light of its own has a mean of its own. `own`: whether the photos of either capture have
    matrices; those of the other have the identity.
    """

    def __init__(self, views: int, second: int = 0, own: tuple[bool, bool] = (True, True)) -> None:
        super().__init__()
        self.views, self.own = views, own
        self.embedding = nn.Parameter(torch.randn(views + second, EMBEDDING) * 0.1)
        self.net = mlp(EMBEDDING, WIDTH, 1, 9)
        self.reset()

    def forward(self) -> Tensor:
        """All A_n, (views, 3, 3)."""
        m = self.net(self.embedding).reshape(-1, 3, 3)
        if len(m) == self.views:
            out: Tensor = torch.eye(3, device=m.device) + m - m.mean(0)
            return out
        parts = zip((m[: self.views], m[self.views :]), self.own, strict=True)
        return torch.eye(3, device=m.device) + torch.cat([(p - p.mean(0)) * float(own) for p, own in parts])

    def of(self, second: bool) -> Calibration:
        """A copy for the photos of the first or the second capture alone."""
        out = copy.deepcopy(self)
        rows = slice(self.views, None) if second else slice(self.views)
        out.embedding = nn.Parameter(self.embedding.detach()[rows].clone())
        out.views = len(out.embedding)
        if not self.own[int(second)]:
            out.reset()
        return out

    def reset(self) -> None:
        """Set every matrix to the identity."""
        last = self.net[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.zero_()
            last.bias.zero_()
