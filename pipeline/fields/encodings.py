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
from pipeline.maths import cuda_kernels

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
        fast = kernels.compiled(x) or cuda_kernels.usable(x, self.table)
        out: Tensor = _Hash.apply(x, self.table, self) if fast else self.reference(x)  # type: ignore[no-untyped-call]
        return out * self.window

    def open_levels(self, share: float) -> None:
        """Use only the coarsest `share` of the levels, the last of them in part; finer ones give 0."""
        count = len(self.offset)
        level = torch.arange(count, device=self.window.device).repeat_interleave(FEATURES)
        self.window.copy_((share * count - level).clamp(0, 1))

    def reference(self, x: Tensor) -> Tensor:
        """The same in plain torch, differentiated by autograd."""
        mask = 2**self.log2_size - 1
        corner = torch.arange(8, device=x.device)
        step = torch.stack([corner >> 2, (corner >> 1) & 1, corner & 1], -1)  # (8, 3)
        u = (x - self.lo.to(x))[:, None] * self.inv.to(x)[:, None]  # (N, L, 3)
        node = torch.minimum(torch.floor(u.detach()).long().clamp(min=0), self.size - 2)
        f = (u - node).clamp(0, 1)[:, :, None]
        i, j, k = (node[:, :, None] + step).unbind(-1)  # (N, L, 8) each
        hashed = (i ^ (j * PRIMES[1]) ^ (k * PRIMES[2])) & mask
        dense = (i * self.size[:, 1:2] + j) * self.size[:, 2:] + k
        at = torch.where(self.hashed[:, None], hashed, dense) + self.offset[:, None]
        w = torch.where(step.bool(), f, 1 - f).prod(-1)
        return torch.einsum("nlc,nlcf->nlf", w, self.table[at].to(x)).reshape(len(x), -1)

    def grid(self) -> cuda_kernels.HashGrid:
        """Input of the GPU's kernels."""
        return self.offset, self.size, self.hashed, 2**self.log2_size - 1, self.lo, self.inv

    def tables(self) -> tuple[Any, ...]:
        """Input of the compiled kernels on the CPU."""
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
        if cuda_kernels.usable(x, table):
            return cuda_kernels.hash_forward(table, encoding.grid(), x.detach())
        out = torch.empty(len(x), encoding.width)
        nb.hash_forward(table.detach().numpy(), *encoding.tables(), x.detach().contiguous().numpy(), out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, table = ctx.saved_tensors
        encoding: HashEncoding = ctx.encoding
        if cuda_kernels.usable(x, table):
            of_table, of_x = cuda_kernels.hash_backward(table, encoding.grid(), x, grads[0])
            return of_x if ctx.needs_input_grad[0] else None, of_table, None
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
