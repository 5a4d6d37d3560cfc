"""A signed distance as a uniform quadratic B-spline, in plain torch. The reference for pipeline.fields.kernels.

Symbols: coefficients v (X, Y, Z) are at nodes lo + i h. At u = (x - lo) / h with nearest node i and f = u - i in
[-1/2, 1/2], the three weights an axis are (1/2 - f)^2 / 2, 3/4 - f^2, (1/2 + f)^2 / 2. Value and gradient are C1 and
C0, from one gather of 27 coefficients. (The normals of a trilinear grid are discontinuous, which is visible in
highlights.)
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.maths.precision import full_precision


@full_precision
def axis_weights(f: Tensor) -> tuple[Tensor, Tensor]:
    """Weights and their derivatives by u: (...) -> (..., 3), (..., 3)."""
    w = torch.stack([0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2], -1)
    dw = torch.stack([f - 0.5, -2 * f, f + 0.5], -1)
    return w, dw


def locate(x: Tensor, lo: Tensor, cell: float, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Nearest node (N, 3) int64, at least one node from the border, and f (N, 3). Outside the grid f is clamped, so
    that the value is that of the border; distances there are not needed."""
    u = (x - lo) / cell
    top = torch.tensor(shape, device=x.device) - 2
    node = torch.minimum(torch.round(u).long().clamp(min=1), top)
    return node, (u - node).clamp(-0.5, 0.5)


def neighbour_offsets(shape: tuple[int, int, int], device: torch.device) -> Tensor:
    """Flat index offsets of the 27 neighbours, x slowest: (27,)."""
    r = torch.arange(-1, 2, device=device)
    return (r[:, None, None] * shape[1] * shape[2] + r[None, :, None] * shape[2] + r[None, None, :]).reshape(27)


def spline_stencil(x: Tensor, lo: Tensor, cell: float, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Flat indices (N, 27), weights (N, 27) and weight gradients (N, 27, 3) by x."""
    node, f = locate(x, lo, cell, shape)
    flat = (node[:, 0] * shape[1] + node[:, 1]) * shape[2] + node[:, 2]
    w, dw = axis_weights(f)
    wx, wy, wz = w.unbind(1)
    dx, dy, dz = dw.unbind(1)

    def outer(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return (a[:, :, None, None] * b[:, None, :, None] * c[:, None, None, :]).reshape(-1, 27)

    gradient = torch.stack([outer(dx, wy, wz), outer(wx, dy, wz), outer(wx, wy, dz)], -1) / cell
    return flat[:, None] + neighbour_offsets(shape, x.device), outer(wx, wy, wz), gradient


@full_precision
def spline_sdf(values: Tensor, x: Tensor, lo: Tensor, cell: float) -> tuple[Tensor, Tensor]:
    """SDF (N,) and gradient (N, 3) at x (N, 3); differentiable in `values` (X, Y, Z)."""
    shape = (values.shape[0], values.shape[1], values.shape[2])
    index, w, dw = spline_stencil(x, lo, cell, shape)
    v = values.reshape(-1)[index]
    return (v * w).sum(-1), torch.einsum("nk,nkc->nc", v, dw)


@full_precision
def refine(values: Tensor) -> Tensor:
    """Coefficients of the same function at half the spacing: (X, Y, Z) -> (2X, 2Y, 2Z), first node at lo - h / 4.

    The subdivision rule of the quadratic B-spline, (1, 3, 3, 1) / 4 an axis; exact away from the border.
    """
    for axis in range(3):
        before = torch.cat([values.narrow(axis, 0, 1), values.narrow(axis, 0, values.shape[axis] - 1)], axis)
        after = torch.cat([values.narrow(axis, 1, values.shape[axis] - 1), values.narrow(axis, -1, 1)], axis)
        pair = torch.stack([0.75 * values + 0.25 * before, 0.75 * values + 0.25 * after], axis + 1)
        values = pair.flatten(axis, axis + 1)
    return values


@full_precision
def unit(g: Tensor) -> Tensor:
    """n = g / |g| as g rsqrt(|g|^2 + 1e-12): value and derivative finite at g = 0. [NeuFace section 4.3]"""
    return g * torch.rsqrt((g * g).sum(-1, keepdim=True) + 1e-12)
