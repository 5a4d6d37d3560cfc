"""The compiled kernels on a GPU: cuda_kernels.cu, compiled by torch's own NVRTC when the first of them is needed.

In plain torch a step of the fit is some ten thousand small operations, most of them in the ray march, and a GPU then
takes longer than two processor cores: it waits for each of them to be started. Where the kernels can't be compiled, a
warning says so, and plain torch is used.

Shapes and meaning are those of pipeline.fields.kernels_numba and pipeline.maths.sh; all floats are float32, and all
tensors are on one GPU.
"""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pipeline.maths.sh_recurrence import tables

log = logging.getLogger(__name__)
SOURCE = Path(__file__).with_suffix(".cu")
THREADS = 128  # of a block
MOST = 2**31 - THREADS  # elements of one launch: they are counted in 32 bits
HashGrid = tuple[Tensor, Tensor, Tensor, int, Tensor, Tensor]  # offset, size, hashed, mask, lo, inverse cells


def usable(*tensors: Tensor) -> bool:
    """Whether the kernels support these tensors: float32 on a GPU for which they can be compiled."""
    return all(x.is_cuda and x.dtype == torch.float32 for x in tensors) and available()


@lru_cache(maxsize=1)
def available() -> bool:
    """Whether the kernels can be compiled here; the reason is logged if not."""
    try:
        _kernel("spline_forward")
    except Exception as e:  # NVRTC is missing, or does not know the GPU: torch raises errors of several kinds
        log.warning("the GPU's kernels can't be compiled, and the fit will be slow: %s", e)
        return False
    return True


@lru_cache(maxsize=16)
def _kernel(name: str) -> Any:
    return torch.cuda._compile_kernel(SOURCE.read_text(), name)  # type: ignore[no-untyped-call, unused-ignore]


def launch(name: str, count: int, *arguments: Tensor | int | float) -> None:
    """Run a kernel of the source for `count` elements, on the device of its tensors. Tensors must be contiguous."""
    if not 0 <= count <= MOST:
        raise ValueError(f"{name}: {count} elements; one launch has at most {MOST}")
    if count:
        device = next(a.device for a in arguments if isinstance(a, Tensor))
        with torch.cuda.device(device):
            grid = (-(-count // THREADS), 1, 1)
            _kernel(name)(grid=grid, block=(THREADS, 1, 1), args=[count, *arguments])


def spline_forward(values: Tensor, lo: Tensor, cell: float, x: Tensor) -> tuple[Tensor, Tensor]:
    """SDF (N,) and gradient (N, 3) of a spline grid (X, Y, Z) at x (N, 3)."""
    s, g = x.new_empty(len(x)), x.new_empty(len(x), 3)
    launch("spline_forward", len(x), values.contiguous(), *values.shape, lo, 1 / cell, x.contiguous(), s, g)
    return s, g


def spline_backward(sink: Tensor, lo: Tensor, cell: float, x: Tensor, gs: Tensor, gg: Tensor) -> None:
    """Add the gradient of the coefficients to sink (X, Y, Z), from those of the SDF (N,) and its gradient (N, 3)."""
    x, gs, gg = x.contiguous(), gs.contiguous(), gg.contiguous()
    launch("spline_backward", len(x), sink, *sink.shape, lo, 1 / cell, x, gs, gg)


def march(
    values: Tensor, lo: Tensor, cell: float, rays: tuple[Tensor, Tensor, Tensor, Tensor],
    factor: float, min_step: float, steps: tuple[int, int],
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """t, hit, SDF (N,) of pipeline.maths.tracing.sphere_trace. rays: o, d (N, 3), t_near, t_far (N,). steps: largest
    number of the march, and of the refinement."""
    o, d, near, far = (a.contiguous() for a in rays)
    t, s, hit = o.new_empty(len(o)), o.new_empty(len(o)), o.new_empty(len(o), dtype=torch.bool)
    grid = (values.contiguous(), *values.shape, lo, 1 / cell)
    launch("march", len(o), *grid, o, d, near, far, float(factor), float(min_step), *steps, t, hit, s)
    return t, hit, s


def band_adam(
    values: Tensor, grad: Tensor, m: Tensor, v: Tensor, active: Tensor,
    lr: float, betas: tuple[float, float], eps: float, step: int,
) -> None:  # fmt: skip
    """One Adam step, in place, on the coefficients `active` (flat indices) that have a gradient, which it clears."""
    b1, b2 = betas
    scalars = (float(lr), b1, b2, float(eps), 1 - b1**step, 1 - b2**step)
    launch("band_adam", len(active), values.detach(), grad, m, v, active, *scalars)


def hash_forward(table: Tensor, grid: HashGrid, x: Tensor) -> Tensor:
    """Features (N, 2 L) at x (N, 3)."""
    levels = len(grid[0])
    out = x.new_empty(len(x), 2 * levels)
    launch("hash_forward", len(x) * levels, levels, table.detach(), *grid, x.contiguous(), out)
    return out


def hash_backward(table: Tensor, grid: HashGrid, x: Tensor, grad: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the table and of x (N, 3), from that of the features (N, 2 L)."""
    levels = len(grid[0])
    of_table, of_x = torch.zeros_like(table), torch.zeros_like(x)
    x, grad = x.contiguous(), grad.contiguous()
    launch("hash_backward", len(x) * levels, levels, table.detach(), *grid, x, grad, of_table, of_x)
    return of_table, of_x


class ShBasis(torch.autograd.Function):
    """Y_lm (N, (order + 1)^2) at d (N, 3)."""

    @staticmethod
    def forward(ctx: Any, d: Tensor, order: int) -> Tensor:
        ctx.save_for_backward(d)
        ctx.order = order
        out = d.new_empty(len(d), (order + 1) ** 2)
        launch("sh_forward", len(d), order, *_tables(order, d.device), d.contiguous(), out)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (d,) = ctx.saved_tensors
        out = torch.empty_like(d, memory_format=torch.contiguous_format)
        launch(
            "sh_backward", len(d), ctx.order, *_tables(ctx.order, d.device), d.contiguous(), grads[0].contiguous(), out
        )
        return out, None


@lru_cache(maxsize=16)
def _tables(order: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    start, a, b = (torch.from_numpy(t).to(device) for t in tables(order))
    return start, a, b
