"""CPU kernels for the gathers that dominate the fit's time: spline SDF, ray march, hash encoding, patches of photos.

Each has a reference in plain torch (pipeline.maths.sdf, pipeline.maths.tracing, pipeline.fields.encodings), with which
the tests compare it. A fit is reproducible bit by bit, for two reasons. The order of sums does not depend on timing:
scatters run in parallel only over disjoint regions (slabs of the grid, levels of the table). And arithmetic is strict,
without `fastmath`: with it, a process that compiles a kernel and one that loads it from the cache round differently
(observed in the first step of a fit). This costs a quarter of the kernels' speed.
"""

# mypy: disable-error-code=no-untyped-def
# ruff: noqa: E741
from __future__ import annotations

import numpy as np
from numba import njit, prange

SLAB = 4  # nodes; a stencil reaches one node outside its slab, so slabs of one parity never overlap
HALF, THREE_QUARTERS, ONE, ZERO = np.float32(0.5), np.float32(0.75), np.float32(1), np.float32(0)


@njit(inline="always", error_model="numpy")
def _axis(u, top):
    """Nearest node that is not on the border, and f in [-1/2, 1/2]."""
    node = int(np.floor(u + HALF))
    node = min(max(node, 1), top - 2)
    f = np.float32(u - np.float32(node))
    return node, min(max(f, -HALF), HALF)


@njit(inline="always", error_model="numpy")
def _value(values, lo, inv, x, y, z):
    sx, sy, sz = values.shape
    i, fx = _axis((x - lo[0]) * inv, sx)
    j, fy = _axis((y - lo[1]) * inv, sy)
    k, fz = _axis((z - lo[2]) * inv, sz)
    z0, z1, z2 = HALF * (HALF - fz) ** 2, THREE_QUARTERS - fz * fz, HALF * (HALF + fz) ** 2
    total = ZERO
    for a in range(3):
        wx = HALF * (HALF - fx) ** 2 if a == 0 else (THREE_QUARTERS - fx * fx if a == 1 else HALF * (HALF + fx) ** 2)
        for b in range(3):
            wy = (
                HALF * (HALF - fy) ** 2 if b == 0 else (THREE_QUARTERS - fy * fy if b == 1 else HALF * (HALF + fy) ** 2)
            )
            ii, jj = i + a - 1, j + b - 1
            line = z0 * values[ii, jj, k - 1] + z1 * values[ii, jj, k] + z2 * values[ii, jj, k + 1]
            total += wx * wy * line
    return total


@njit(parallel=True, error_model="numpy", cache=True)
def spline_forward(values, lo, inv, x, s, g):
    """SDF s (N,) and gradient g (N, 3) at x (N, 3)."""
    sx, sy, sz = values.shape
    for n in prange(x.shape[0]):
        i, fx = _axis((x[n, 0] - lo[0]) * inv, sx)
        j, fy = _axis((x[n, 1] - lo[1]) * inv, sy)
        k, fz = _axis((x[n, 2] - lo[2]) * inv, sz)
        z0, z1, z2 = HALF * (HALF - fz) ** 2, THREE_QUARTERS - fz * fz, HALF * (HALF + fz) ** 2
        e0, e1, e2 = fz - HALF, np.float32(-2) * fz, fz + HALF
        t, gx, gy, gz = ZERO, ZERO, ZERO, ZERO
        for a in range(3):
            if a == 0:
                wx, dx = HALF * (HALF - fx) ** 2, fx - HALF
            elif a == 1:
                wx, dx = THREE_QUARTERS - fx * fx, np.float32(-2) * fx
            else:
                wx, dx = HALF * (HALF + fx) ** 2, fx + HALF
            for b in range(3):
                if b == 0:
                    wy, dy = HALF * (HALF - fy) ** 2, fy - HALF
                elif b == 1:
                    wy, dy = THREE_QUARTERS - fy * fy, np.float32(-2) * fy
                else:
                    wy, dy = HALF * (HALF + fy) ** 2, fy + HALF
                v0 = values[i + a - 1, j + b - 1, k - 1]
                v1 = values[i + a - 1, j + b - 1, k]
                v2 = values[i + a - 1, j + b - 1, k + 1]
                line = z0 * v0 + z1 * v1 + z2 * v2
                t += wx * wy * line
                gx += dx * wy * line
                gy += wx * dy * line
                gz += wx * wy * (e0 * v0 + e1 * v1 + e2 * v2)
        s[n] = t
        g[n, 0], g[n, 1], g[n, 2] = gx * inv, gy * inv, gz * inv


@njit(error_model="numpy", cache=True)
def _by_slab(lo, inv, x, sx):
    """Samples in slab order: start (slabs + 1,) and order (N,), a stable counting sort."""
    slabs = (sx + SLAB - 1) // SLAB
    start = np.zeros(slabs + 1, np.int64)
    which = np.empty(x.shape[0], np.int32)
    for n in range(x.shape[0]):
        i, _ = _axis((x[n, 0] - lo[0]) * inv, sx)
        which[n] = i // SLAB
        start[which[n] + 1] += 1
    start = np.cumsum(start)
    fill = start[:-1].copy()
    order = np.empty(x.shape[0], np.int64)
    for n in range(x.shape[0]):
        order[fill[which[n]]] = n
        fill[which[n]] += 1
    return start, order


@njit(inline="always", error_model="numpy")
def _scatter_one(out, lo, inv, x, gs, gg, n):
    sx, sy, sz = out.shape
    i, fx = _axis((x[n, 0] - lo[0]) * inv, sx)
    j, fy = _axis((x[n, 1] - lo[1]) * inv, sy)
    k, fz = _axis((x[n, 2] - lo[2]) * inv, sz)
    z0, z1, z2 = HALF * (HALF - fz) ** 2, THREE_QUARTERS - fz * fz, HALF * (HALF + fz) ** 2
    e0, e1, e2 = fz - HALF, np.float32(-2) * fz, fz + HALF
    s, px, py, pz = gs[n], gg[n, 0] * inv, gg[n, 1] * inv, gg[n, 2] * inv
    for a in range(3):
        if a == 0:
            wx, dx = HALF * (HALF - fx) ** 2, fx - HALF
        elif a == 1:
            wx, dx = THREE_QUARTERS - fx * fx, np.float32(-2) * fx
        else:
            wx, dx = HALF * (HALF + fx) ** 2, fx + HALF
        for b in range(3):
            if b == 0:
                wy, dy = HALF * (HALF - fy) ** 2, fy - HALF
            elif b == 1:
                wy, dy = THREE_QUARTERS - fy * fy, np.float32(-2) * fy
            else:
                wy, dy = HALF * (HALF + fy) ** 2, fy + HALF
            flat = s * wx * wy + px * dx * wy + py * wx * dy
            deep = pz * wx * wy
            out[i + a - 1, j + b - 1, k - 1] += flat * z0 + deep * e0
            out[i + a - 1, j + b - 1, k] += flat * z1 + deep * e1
            out[i + a - 1, j + b - 1, k + 1] += flat * z2 + deep * e2


@njit(parallel=True, error_model="numpy", cache=True)
def spline_backward(out, lo, inv, x, gs, gg):
    """Add the gradient of the coefficients to out (X, Y, Z), from those of s (N,) and g (N, 3)."""
    start, order = _by_slab(lo, inv, x, out.shape[0])
    slabs = start.shape[0] - 1
    for parity in range(2):
        for half in prange((slabs + 1 - parity) // 2):
            slab = 2 * half + parity
            for p in range(start[slab], start[slab + 1]):
                _scatter_one(out, lo, inv, x, gs, gg, order[p])


@njit(parallel=True, error_model="numpy", cache=True)
def march(values, lo, inv, o, d, t_near, t_far, factor, min_step, max_steps, refine_steps, t_out, hit, s_out):
    """Sphere tracing, one ray at a time; see pipeline.maths.tracing.sphere_trace."""
    for n in prange(o.shape[0]):
        t = t_near[n]
        s = _value(values, lo, inv, o[n, 0] + t * d[n, 0], o[n, 1] + t * d[n, 1], o[n, 2] + t * d[n, 2])
        best_t, best_s, found = t, s, False
        if t_far[n] > t and s > 0:
            for _ in range(max_steps):
                t1 = min(t + max(factor * s, min_step), t_far[n])
                s1 = _value(values, lo, inv, o[n, 0] + t1 * d[n, 0], o[n, 1] + t1 * d[n, 1], o[n, 2] + t1 * d[n, 2])
                if s1 <= 0:
                    t0, s0, last = t, s, 0
                    for _ in range(refine_steps):
                        best_t = t0 + (t1 - t0) * (s0 / max(s0 - s1, np.float32(1e-12)))
                        best_s = _value(
                            values,
                            lo,
                            inv,
                            o[n, 0] + best_t * d[n, 0],
                            o[n, 1] + best_t * d[n, 1],
                            o[n, 2] + best_t * d[n, 2],
                        )
                        if abs(best_s) < np.float32(1e-3) * min_step:
                            break
                        if best_s > 0:
                            t0, s0, s1 = best_t, best_s, HALF * s1 if last == 1 else s1
                            last = 1
                        else:
                            t1, s1, s0 = best_t, best_s, HALF * s0 if last == -1 else s0
                            last = -1
                    found = True
                    break
                if s1 < best_s:
                    best_t, best_s = t1, s1
                t, s = t1, s1
                if t >= t_far[n]:
                    break
        t_out[n], hit[n], s_out[n] = best_t, found, best_s


@njit(parallel=True, error_model="numpy", cache=True)
def band_adam(values, grad, m, v, active, lr, b1, b2, eps, c1, c2):
    """One Adam step on the active coefficients (flat indices) that have a gradient, which it clears."""
    p, g0, m0, v0 = values.reshape(-1), grad.reshape(-1), m.reshape(-1), v.reshape(-1)
    for q in prange(active.shape[0]):
        i = active[q]
        g = g0[i]
        if g == ZERO:
            continue
        g0[i] = ZERO
        m0[i] = b1 * m0[i] + (ONE - b1) * g
        v0[i] = b2 * v0[i] + (ONE - b2) * g * g
        p[i] -= lr * (m0[i] / c1) / (np.sqrt(v0[i] / c2) + eps)


@njit(inline="always", error_model="numpy")
def _corner(i, j, k, size, hashed, mask):
    if hashed:
        return (np.uint32(i) ^ (np.uint32(j) * np.uint32(2654435761)) ^ (np.uint32(k) * np.uint32(805459861))) & mask
    return np.uint32((i * size[1] + j) * size[2] + k)


@njit(parallel=True, error_model="numpy", cache=True)
def hash_forward(table, offset, size, hashed, mask, lo, inv, x, out):
    """Trilinear features: x (N, 3) -> out (N, 2 L). One level of the table at a time inside a sample."""
    for n in prange(x.shape[0]):
        for level in range(offset.shape[0]):
            ux, uy, uz = (
                (x[n, 0] - lo[0]) * inv[level],
                (x[n, 1] - lo[1]) * inv[level],
                (x[n, 2] - lo[2]) * inv[level],
            )
            i, j, k = (
                min(max(int(np.floor(ux)), 0), size[level, 0] - 2),
                min(max(int(np.floor(uy)), 0), size[level, 1] - 2),
                min(max(int(np.floor(uz)), 0), size[level, 2] - 2),
            )
            fx, fy, fz = (
                min(max(ux - np.float32(i), ZERO), ONE),
                min(max(uy - np.float32(j), ZERO), ONE),
                min(max(uz - np.float32(k), ZERO), ONE),
            )
            a0, a1 = ZERO, ZERO
            for c in range(8):
                di, dj, dk = c >> 2, (c >> 1) & 1, c & 1
                w = (fx if di else ONE - fx) * (fy if dj else ONE - fy) * (fz if dk else ONE - fz)
                at = offset[level] + _corner(i + di, j + dj, k + dk, size[level], hashed[level], mask)
                a0 += w * table[at, 0]
                a1 += w * table[at, 1]
            out[n, 2 * level], out[n, 2 * level + 1] = a0, a1


@njit(parallel=True, error_model="numpy", cache=True)
def hash_backward(table, offset, size, hashed, mask, lo, inv, x, grad_out, grad_table, grad_x):
    """Gradients of the table (added) and of x, (L, N, 3) to be summed over levels. Levels own disjoint table rows."""
    levels = offset.shape[0]
    half = (levels + 1) // 2
    for p in prange(levels):
        level = 2 * p if p < half else 2 * (p - half) + 1  # coarse levels are faster, and each thread gets some
        for n in range(x.shape[0]):
            ux, uy, uz = (
                (x[n, 0] - lo[0]) * inv[level],
                (x[n, 1] - lo[1]) * inv[level],
                (x[n, 2] - lo[2]) * inv[level],
            )
            i, j, k = (
                min(max(int(np.floor(ux)), 0), size[level, 0] - 2),
                min(max(int(np.floor(uy)), 0), size[level, 1] - 2),
                min(max(int(np.floor(uz)), 0), size[level, 2] - 2),
            )
            fx, fy, fz = (
                min(max(ux - np.float32(i), ZERO), ONE),
                min(max(uy - np.float32(j), ZERO), ONE),
                min(max(uz - np.float32(k), ZERO), ONE),
            )
            g0, g1 = grad_out[n, 2 * level], grad_out[n, 2 * level + 1]
            gx, gy, gz = ZERO, ZERO, ZERO
            for c in range(8):
                di, dj, dk = c >> 2, (c >> 1) & 1, c & 1
                wx, wy, wz = (fx if di else ONE - fx), (fy if dj else ONE - fy), (fz if dk else ONE - fz)
                at = offset[level] + _corner(i + di, j + dj, k + dk, size[level], hashed[level], mask)
                w = wx * wy * wz
                grad_table[at, 0] += w * g0
                grad_table[at, 1] += w * g1
                v = g0 * table[at, 0] + g1 * table[at, 1]
                gx += (v if di else -v) * wy * wz
                gy += (v if dj else -v) * wx * wz
                gz += (v if dk else -v) * wx * wy
            inside_x, inside_y, inside_z = ZERO < fx < ONE, ZERO < fy < ONE, ZERO < fz < ONE
            grad_x[level, n, 0] = gx * inv[level] if inside_x else ZERO
            grad_x[level, n, 1] = gy * inv[level] if inside_y else ZERO
            grad_x[level, n, 2] = gz * inv[level] if inside_z else ZERO


@njit(parallel=True, error_model="numpy", cache=True)
def look_up(grey, first, width, height, view, q, out):
    """Bilinear samples (N, V, K) of the photos `view` (N, V) at homogeneous image positions q (N, V, 3, K)."""
    n_views, n = q.shape[1], q.shape[3]
    border = np.float32(1.001)
    for i in prange(q.shape[0]):
        for j in range(n_views):
            k = view[i, j]
            w, h, start = width[k], height[k], first[k]
            for s in range(n):
                depth = q[i, j, 2, s]
                x = min(max(q[i, j, 0, s] / depth - HALF, ZERO), np.float32(w) - border)
                y = min(max(q[i, j, 1, s] / depth - HALF, ZERO), np.float32(h) - border)
                column, row = int(x), int(y)
                fx, fy = x - np.float32(column), y - np.float32(row)
                at = start + row * w + column
                upper = grey[at] + fx * (grey[at + 1] - grey[at])
                lower = grey[at + w] + fx * (grey[at + w + 1] - grey[at + w])
                out[i, j, s] = upper + fy * (lower - upper)
