"""Differentiable gathers with three back ends: compiled CPU kernels if numba is installed, compiled GPU kernels
(pipeline.maths.cuda_kernels), else plain torch.

The torch path is the reference. Tests select it by removing `nb`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.maths import cuda_kernels
from pipeline.maths.sdf import spline_sdf, spline_stencil
from pipeline.maths.tracing import MAX_STEPS, REFINE_STEPS, sphere_trace

MIN_EPS = 1e-12  # of the optimiser: distances are in metres, so that gradients can be as small as 1e-8

nb: Any
try:
    from pipeline.fields import kernels_numba as nb
except ImportError:  # a minimal GPU machine only has torch, numpy and scipy
    nb = None


def compiled(x: Tensor) -> bool:
    """Whether the compiled kernels support this tensor: float32 on the CPU, and numba is installed."""
    return nb is not None and x.device.type == "cpu" and x.dtype == torch.float32


def _np(x: Tensor) -> Any:
    return x.detach().contiguous().numpy()


class SplineSdf(torch.autograd.Function):
    """SDF and gradient of a spline grid; the gradient of the coefficients is added to `sink` (X, Y, Z).

    The sink avoids a dense gradient tensor per call. Positions get no gradient: samples are placed, not learnt.
    A gradient that is not finite is not added. Instead the sink's first node, which is on the border and never learnt,
    becomes NaN, so that the optimiser can detect the error by reading one number.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, values: Tensor, sink: Tensor, lo: Tensor, cell: float) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(x)
        ctx.grid = (values.shape, sink, lo, cell)
        if cuda_kernels.usable(x, values):
            return cuda_kernels.spline_forward(values.detach(), lo, cell, x)
        if not compiled(x):
            return spline_sdf(values.detach(), x, lo, cell)
        s, g = torch.empty(len(x)), torch.empty(len(x), 3)
        nb.spline_forward(_np(values), _np(lo), np.float32(1 / cell), _np(x), s.numpy(), g.numpy())
        return s, g

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (x,) = ctx.saved_tensors
        shape, sink, lo, cell = ctx.grid
        gs, gg = grads
        if not bool(torch.isfinite(gs.sum() + gg.sum())):
            sink[0, 0, 0] = float("nan")
        elif compiled(x):
            nb.spline_backward(sink.numpy(), _np(lo), np.float32(1 / cell), _np(x), _np(gs), _np(gg))
        elif cuda_kernels.usable(x, sink):
            cuda_kernels.spline_backward(sink, lo, cell, x, gs, gg)
        else:
            index, w, dw = spline_stencil(x, lo, cell, shape)
            share = gs[:, None] * w + torch.einsum("nc,nkc->nk", gg, dw)
            sink.view(-1).index_add_(0, index.reshape(-1), share.reshape(-1))
        return None, None, None, None, None


def trace(
    values: Tensor,
    lo: Tensor,
    cell: float,
    o: Tensor,
    d: Tensor,
    t_near: Tensor,
    t_far: Tensor,
    *,
    min_step: float,
    factor: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """`pipeline.maths.tracing.sphere_trace` on a spline grid: t, hit, sdf there. No gradients."""
    values, o, d = values.detach(), o.detach(), d.detach()
    if cuda_kernels.usable(values, o, d, t_near, t_far):
        steps = (MAX_STEPS, REFINE_STEPS)
        return cuda_kernels.march(values, lo, cell, (o, d, t_near, t_far), factor, min_step, steps)
    if not compiled(o):
        with torch.no_grad():
            return sphere_trace(
                lambda p: spline_sdf(values, p, lo, cell)[0], o, d, t_near, t_far, min_step=min_step, factor=factor
            )
    t, s, hit = torch.empty(len(o)), torch.empty(len(o)), torch.empty(len(o), dtype=torch.bool)
    nb.march(
        _np(values),
        _np(lo),
        np.float32(1 / cell),
        _np(o),
        _np(d),
        _np(t_near),
        _np(t_far),
        np.float32(factor),
        np.float32(min_step),
        MAX_STEPS,
        REFINE_STEPS,
        t.numpy(),
        hit.numpy(),
        s.numpy(),
    )
    return t, hit, s


def adam_on_band(
    values: Tensor,
    grad: Tensor,
    m: Tensor,
    v: Tensor,
    active: Tensor,
    step: int,
    lr: float,
    betas: tuple[float, float],
    eps: float = MIN_EPS,
) -> None:
    """One Adam step, in place, on the coefficients `active` (flat indices); clears their gradient.

    Coefficients that no ray touched are not changed, nor is their momentum: a batch touches a few per cent of the band,
    and moving the others by old gradients would take most of the time and add noise.

    eps is added to the root of the second moment; it is far below any useful gradient, unless it is used for damping.
    """
    if cuda_kernels.usable(values, grad):
        cuda_kernels.band_adam(values, grad, m, v, active, lr, betas, eps, step)
        return
    b1, b2 = betas
    c1, c2 = 1 - b1**step, 1 - b2**step
    if compiled(values):
        f = np.float32
        nb.band_adam(
            _np(values), grad.numpy(), m.numpy(), v.numpy(), active.numpy(), f(lr), f(b1), f(b2), f(eps), f(c1), f(c2)
        )
        return
    flat = [x.detach().view(-1) for x in (values, grad, m, v)]
    active = active[flat[1][active] != 0]
    g = flat[1][active]
    flat[1][active] = 0
    flat[2][active] = mi = b1 * flat[2][active] + (1 - b1) * g
    flat[3][active] = vi = b2 * flat[3][active] + (1 - b2) * g * g
    flat[0][active] -= lr * (mi / c1) / (torch.sqrt(vi / c2) + eps)


def look_up(grey: Tensor, first: Tensor, width: Tensor, height: Tensor, view: Tensor, q: Tensor) -> Tensor:
    """Bilinear samples (N, V, K) of photos, clamped to their border.

    grey: the rows of all photos in one array; first, width, height (M,): offset and size in pixels of each photo.
    view (N, V): index of the photo; q (N, V, 3, K): homogeneous image positions, pixel centres at +0.5. Photos have at
    least 2 x 2 pixels; positions at infinity (third coordinate 0) are not allowed.
    """
    if compiled(grey) and compiled(q):
        out = torch.empty(*q.shape[:2], q.shape[3])
        nb.look_up(_np(grey), _np(first), _np(width), _np(height), _np(view), _np(q), out.numpy())
        return out
    wide = width[view][..., None]
    zero = torch.zeros((), device=q.device)
    x = (q[..., 0, :] / q[..., 2, :] - 0.5).clamp(min=zero, max=wide - 1.001)
    y = (q[..., 1, :] / q[..., 2, :] - 0.5).clamp(min=zero, max=height[view][..., None] - 1.001)
    column, row = x.long(), y.long()
    at = first[view][..., None] + row * wide + column
    upper = torch.lerp(grey[at], grey[at + 1], x - column)
    lower = torch.lerp(grey[at + wide], grey[at + wide + 1], x - column)
    return torch.lerp(upper, lower, y - row)
