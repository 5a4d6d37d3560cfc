"""Multi-resolution hash encoding of positions: dense tables for coarse levels, hashed ones for fine levels.

Symbols: level i has nodes every h_i = coarse * ratio^-i; a position has 2 features per level, interpolated trilinearly
from its 8 corners. A corner of a hashed level has the index (i ^ 2654435761 j ^ 805459861 k) mod 2^log2_size.
Collisions are not resolved; they matter little, because a surface uses only a thin shell of the volume.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.fields import kernels

nb: Any = kernels.nb

PRIMES = (1, 2654435761, 805459861)
FEATURES = 2


class HashEncoding(nn.Module):
    """(N, 3) positions in a box -> (N, 2 L) features."""

    offset: Tensor
    size: Tensor
    hashed: Tensor
    window: Tensor
    lo: Tensor
    inv: Tensor

    def __init__(self, lo: Tensor, hi: Tensor, coarse: float, fine: float, levels: int, log2_size: int) -> None:
        super().__init__()
        ratio = (coarse / fine) ** (1 / max(levels - 1, 1))
        cells = [coarse * ratio**-i for i in range(levels)]
        extent = (hi - lo).tolist()
        sizes = [[max(math.ceil(e / h) + 2, 2) for e in extent] for h in cells]
        rows = [min(s[0] * s[1] * s[2], 2**log2_size) for s in sizes]
        self.log2_size = log2_size
        self.register_buffer("offset", torch.tensor(np.cumsum([0, *rows[:-1]]), dtype=torch.int64))
        self.register_buffer("size", torch.tensor(sizes, dtype=torch.int64))
        self.register_buffer("hashed", torch.tensor([s[0] * s[1] * s[2] > 2**log2_size for s in sizes]))
        self.register_buffer("window", torch.ones(FEATURES * levels))
        self.register_buffer("lo", lo.float().clone())
        self.register_buffer("inv", torch.tensor([1 / h for h in cells], dtype=torch.float32))
        self.table = nn.Parameter(torch.empty(sum(rows), FEATURES).uniform_(-1e-4, 1e-4))

    @property
    def width(self) -> int:
        """Number of output features."""
        return FEATURES * len(self.offset)

    def forward(self, x: Tensor) -> Tensor:
        """Features (N, 2 L) at x (N, 3), differentiable in the table and in x."""
        out: Tensor = _Hash.apply(x, self.table, self) if kernels.compiled(x) else self.reference(x)  # type: ignore[no-untyped-call]
        return out * self.window

    def open_levels(self, share: float) -> None:
        """Use only the coarsest `share` of the levels, the last of them in part; finer ones give 0."""
        count = len(self.offset)
        level = torch.arange(count, device=self.window.device).repeat_interleave(FEATURES)
        self.window.copy_((share * count - level).clamp(0, 1))

    def reference(self, x: Tensor) -> Tensor:
        """The same in plain torch, differentiated by autograd."""
        columns = []
        mask = 2**self.log2_size - 1
        for level in range(len(self.offset)):
            size = self.size[level]
            u = (x - self.lo.to(x)) * self.inv[level].to(x)
            node = torch.minimum(torch.floor(u.detach()).long().clamp(min=0), size - 2)
            f = (u - node).clamp(0, 1)
            total = x.new_zeros(len(x), FEATURES)
            for c in range(8):
                step = torch.tensor([c >> 2, (c >> 1) & 1, c & 1], device=x.device)
                i, j, k = (node + step).unbind(-1)
                at = (
                    ((i ^ (j * PRIMES[1]) ^ (k * PRIMES[2])) & mask)
                    if self.hashed[level]
                    else ((i * size[1] + j) * size[2] + k)
                )
                w = torch.where(step.bool(), f, 1 - f).prod(-1, keepdim=True)
                total = total + w * self.table[self.offset[level] + at].to(x)
            columns.append(total)
        return torch.cat(columns, -1)

    def tables(self) -> tuple[Any, ...]:
        """Input of the compiled kernels."""
        return (
            self.offset.numpy(),
            self.size.numpy(),
            self.hashed.numpy(),
            np.uint32(2**self.log2_size - 1),
            self.lo.numpy(),
            self.inv.numpy(),
        )


class _Hash(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, table: Tensor, encoding: HashEncoding) -> Tensor:
        ctx.save_for_backward(x, table)
        ctx.encoding = encoding
        out = torch.empty(len(x), encoding.width)
        nb.hash_forward(table.detach().numpy(), *encoding.tables(), x.detach().contiguous().numpy(), out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, table = ctx.saved_tensors
        encoding: HashEncoding = ctx.encoding
        grad_table = torch.zeros_like(table)
        grad_x = torch.empty(len(encoding.offset), len(x), 3)
        nb.hash_backward(
            table.detach().numpy(),
            *encoding.tables(),
            x.detach().contiguous().numpy(),
            grads[0].contiguous().numpy(),
            grad_table.numpy(),
            grad_x.numpy(),
        )
        return grad_x.sum(0) if ctx.needs_input_grad[0] else None, grad_table, None
