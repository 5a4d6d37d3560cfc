"""Compiled version of the light contractions in pipeline.maths.sh, for float32 on the CPU.

bands[n, l, c] = sum_m coefficients[l m, c] Y_lm(d_n), with derivatives by the coefficients and by d. The outer loop is
over m and the inner one over l, so that Q_l^m needs only its two predecessors; the innermost loop is over LANES
directions and vectorises. Directions are summed in fixed chunks, so that results do not depend on the number of
threads.
"""

# mypy: disable-error-code=no-untyped-def
# ruff: noqa: E741
from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from pipeline.maths.sh_recurrence import tables

LANES = 128


@njit(parallel=True, error_model="numpy", cache=True)
def _forward(c, d, q0, a, b, out):
    order = q0.shape[0] - 1
    blocks = (d.shape[0] + LANES - 1) // LANES
    for block in prange(blocks):
        first = block * LANES
        n = min(LANES, d.shape[0] - first)
        x, y, z = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
        for i in range(n):
            x[i], y[i], z[i] = d[first + i, 0], d[first + i, 1], d[first + i, 2]
        cm, sm = np.ones(LANES, np.float32), np.zeros(LANES, np.float32)
        p, pp = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
        acc = np.zeros((order + 1, 3, LANES), np.float32)
        for m in range(order + 1):
            for l in range(m, order + 1):
                if l == m:
                    for i in range(n):
                        p[i], pp[i] = q0[m], np.float32(0)
                else:
                    al, bl = a[l, m], b[l, m]
                    for i in range(n):
                        p[i], pp[i] = al * z[i] * p[i] - bl * pp[i], p[i]
                at = l * (l + 1)
                for k in range(3):
                    plus, minus = c[at + m, k], (c[at - m, k] if m else np.float32(0))
                    for i in range(n):
                        acc[l, k, i] += p[i] * (plus * cm[i] + minus * sm[i])
            for i in range(n):
                cm[i], sm[i] = x[i] * cm[i] - y[i] * sm[i], x[i] * sm[i] + y[i] * cm[i]
        for i in range(n):
            for l in range(order + 1):
                for k in range(3):
                    out[first + i, l, k] = acc[l, k, i]


@njit(inline="always", error_model="numpy")
def _sum(v):
    """Sum of LANES numbers, which are overwritten. The pairwise sum is explicit: arithmetic is strict
    (pipeline.fields.kernels_numba), so the compiler must not reorder a sum to vectorise it."""
    for i in range(64):
        v[i] += v[i + 64]
    for i in range(32):
        v[i] += v[i + 32]
    for i in range(16):
        v[i] += v[i + 16]
    for i in range(8):
        v[i] += v[i + 8]
    return ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7]))


@njit(parallel=True, error_model="numpy", cache=True)
def _backward(c, d, q0, a, b, g, grad_d, grad_c):
    """Write grad_d (N, 3), and grad_c (blocks, K, 3), one partial sum per block."""
    order = q0.shape[0] - 1
    for block in prange(grad_c.shape[0]):
        first = block * LANES
        n = min(LANES, d.shape[0] - first)
        x, y, z = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
        gb = np.zeros((order + 1, 3, LANES), np.float32)
        for i in range(n):
            x[i], y[i], z[i] = d[first + i, 0], d[first + i, 1], d[first + i, 2]
            for l in range(order + 1):
                for k in range(3):
                    gb[l, k, i] = g[first + i, l, k]
        gx, gy, gz = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
        cm, sm = np.ones(LANES, np.float32), np.zeros(LANES, np.float32)
        cl, sl = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)  # of m - 1
        p, pp = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)  # 0 beyond n: they add nothing
        up, um = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
        s, ss = np.empty(LANES, np.float32), np.empty(LANES, np.float32)  # derivatives of p, pp by z
        for m in range(order + 1):
            fm = np.float32(m)
            for l in range(m, order + 1):
                if l == m:
                    for i in range(n):
                        p[i], pp[i], s[i], ss[i] = q0[m], np.float32(0), np.float32(0), np.float32(0)
                else:
                    al, bl = a[l, m], b[l, m]
                    for i in range(n):
                        s[i], ss[i] = al * (p[i] + z[i] * s[i]) - bl * ss[i], s[i]
                        p[i], pp[i] = al * z[i] * p[i] - bl * pp[i], p[i]
                at = l * (l + 1)
                c0, c1, c2 = c[at + m, 0], c[at + m, 1], c[at + m, 2]
                e0, e1, e2 = c[at - m, 0], c[at - m, 1], c[at - m, 2]
                if m == 0:
                    e0, e1, e2 = np.float32(0), np.float32(0), np.float32(0)
                for i in range(n):
                    plus = c0 * gb[l, 0, i] + c1 * gb[l, 1, i] + c2 * gb[l, 2, i]
                    minus = e0 * gb[l, 0, i] + e1 * gb[l, 1, i] + e2 * gb[l, 2, i]
                    gx[i] += fm * p[i] * (plus * cl[i] + minus * sl[i])
                    gy[i] += fm * p[i] * (minus * cl[i] - plus * sl[i])
                    gz[i] += s[i] * (plus * cm[i] + minus * sm[i])
                for k in range(3):
                    for i in range(LANES):
                        v = p[i] * gb[l, k, i]
                        up[i], um[i] = v * cm[i], v * sm[i]
                    grad_c[block, at + m, k] = _sum(up)
                    if m:
                        grad_c[block, at - m, k] = _sum(um)
            for i in range(n):
                cl[i], sl[i] = cm[i], sm[i]
                cm[i], sm[i] = x[i] * cl[i] - y[i] * sl[i], x[i] * sl[i] + y[i] * cl[i]
        for i in range(n):
            grad_d[first + i, 0], grad_d[first + i, 1], grad_d[first + i, 2] = gx[i], gy[i], gz[i]


class BandRadiance(torch.autograd.Function):
    """(K, 3) coefficients and (N, 3) directions -> (N, L + 1, 3)."""

    @staticmethod
    def forward(ctx: Any, c: Tensor, d: Tensor, order: int) -> Tensor:
        ctx.save_for_backward(c, d)
        ctx.order = order
        out = torch.empty(len(d), order + 1, 3)
        _forward(_np(c), _np(d), *tables(order), out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        c, d = ctx.saved_tensors
        grad_d = torch.empty(len(d), 3)
        share = torch.zeros((len(d) + LANES - 1) // LANES, len(c), 3)
        _backward(_np(c), _np(d), *tables(ctx.order), _np(grads[0]), grad_d.numpy(), share.numpy())
        return share.sum(0), grad_d, None


def _np(x: Tensor) -> Any:
    return x.detach().contiguous().numpy()
