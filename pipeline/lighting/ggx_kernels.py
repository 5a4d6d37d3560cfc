"""Compiled loops of the standard material under lamps: a GGX layer over a diffuse base.

    f_s   = D(n.h) V(n.l, n.v) F(h.v),   D = q / (pi ((n.h)^2 (q - 1) + 1)^2),   q = alpha^2 + s / (2 (h.v)^2)
    V     = 1 / (2 (n.l sqrt((n.v)^2 (1 - a2) + a2) + n.v sqrt((n.l)^2 (1 - a2) + a2))),   a2 = alpha^2
    F     = F0 (1 - c) + c,   c = (1 - h.v)^5

D is Trowbridge and Reitz' (GGX), V the height-correlated masking of Smith, F Schlick's. s is a lamp's spread: a lamp is
an area of the sky, whose variance widens the lobe; a half vector turns by half of what the light turns, over h.v. A
lobe narrower than the lamps' distance would show them as dots: q is at least SMOOTH s / (h.v)^2.
[Walter 2007; Heitz 2014; Schlick 1994]

A sum over lamps of solid angles W is a rough quadrature of a narrow lobe, above all at grazing angles. Under a sky of
radiance 1 its result is known: the shares F0 a + b that the layer reflects (maths/microfacet.py). So both parts are
scaled to that,

    plain part   times a / sum_k D V n.l (1 - c) W_k,      rim   times b / sum_k D V n.l c W_k,

each factor between 1 / MOST and MOST. Lamps without a solid angle (points) are not scaled. The loops over lamps are
in parts: lamps below the horizon, about half, are left out first, and what is needed of the others is gathered once;
then a loop has neither gathers nor sums, so that it vectorises under strict arithmetic.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

ONE, ZERO, HALF, TWO = np.float32(1), np.float32(0), np.float32(0.5), np.float32(2)
PI = np.float32(np.pi)
SMOOTH = np.float32(1)
MOST = np.float32(4)
BLOCK = 256  # observations of one task of a thread
LEAST_COSINE = np.float32(1e-3)  # of n.v: the masking's limit at 0 is finite, its terms are not


@njit(error_model="numpy", cache=True)
def _cosines(x, y, z, lamp, out):
    """Cosines (N,) between a direction and the lamps."""
    for i in range(lamp.shape[1]):
        out[i] = x * lamp[0, i] + y * lamp[1, i] + z * lamp[2, i]


@njit(error_model="numpy", cache=True)
def _above(every, which, cosine):
    """The lamps above the horizon, in their order: writes their indices and n.l, returns their number. The others would
    add 0. every (N,): n.l of all lamps; which, cosine (N + 1,): the place after the last one is written too, because a
    loop without a branch is faster."""
    count = 0
    for i in range(len(every)):
        which[count], cosine[count] = i, every[i]
        count += every[i] > ZERO
    return count


@njit(error_model="numpy", cache=True)
def _half(nl, nv, lv):
    """n.h, h.v and Schlick's c of one lamp. lv: l.v."""
    h2 = max(TWO + TWO * lv, np.float32(1e-6))
    length = np.sqrt(h2)
    nh, hv = min((nl + nv) / length, ONE), HALF * length
    c = max(ONE - hv, ZERO)
    c2 = c * c
    return nh, hv, c2 * c2 * c


@njit(error_model="numpy", cache=True)
def _reflected(nl, nv, nh, hv, a2, spread):
    """D V n.l of one lamp."""
    q = max(a2 + spread / (TWO * hv * hv), SMOOTH * spread / (hv * hv))
    t = nh * nh * (q - ONE) + ONE
    masked = nl * np.sqrt(nv * nv * (ONE - a2) + a2) + nv * np.sqrt(nl * nl * (ONE - a2) + a2)
    return q / (PI * t * t) * HALF / masked * nl


@njit(error_model="numpy", cache=True)
def _scale(share, total):
    """Factor that takes the sum over a uniform sky to what it should be; 1 for point lamps."""
    if not total > ZERO:
        return ONE
    return min(max(share / total, ONE / MOST), MOST)


@njit(error_model="numpy", cache=True)
def _parts(cosine, nv, nh, hv, fresnel, a2, spread, plain, rim):
    """Write D V n.l (1 - c) and D V n.l c of n lamps, (n,) each."""
    for j in range(len(plain)):
        w, c = _reflected(cosine[j], nv, nh[j], hv[j], a2, spread[j]), fresnel[j]
        plain[j], rim[j] = w * (ONE - c), w * c


@njit(error_model="numpy", cache=True)
def _totals(plain, rim, light):
    """Sums over n lamps of both parts (n,) times their light (n, 4): flux and solid angle."""
    p0, p1, p2, c0, c1, c2, ps, cs = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    for j in range(len(plain)):
        e0, e1, e2, solid = light[j, 0], light[j, 1], light[j, 2], light[j, 3]
        ps, cs = ps + plain[j] * solid, cs + rim[j] * solid
        p0, p1, p2 = p0 + plain[j] * e0, p1 + plain[j] * e1, p2 + plain[j] * e2
        c0, c1, c2 = c0 + rim[j] * e0, c1 + rim[j] * e1, c2 + rim[j] * e2
    return p0, p1, p2, c0, c1, c2, ps, cs


@njit(parallel=True, error_model="numpy", cache=True)
def lobes(order, vertex, normal, wo, arriving, lamp, alphas, share, out):
    """Write the specular radiance of each of M observations for K widths, in two parts: out (M, K, 2, 3), such that the
    layer of F0 reflects F0 out[:, :, 0] + out[:, :, 1].

    order (M,): the observations; those of one vertex with one normal, one after the other, share what arrives there.
    The result does not depend on it. vertex (M,); normal, wo (M, 3) unit; arriving (V, N, 3) flux of each lamp at the
    vertices; lamp (5, N): direction, spread, solid angle; alphas (K,); share (2, M, K): a and b. All float32.
    """
    for block in prange((len(order) + BLOCK - 1) // BLOCK):
        some = order[block * BLOCK : min((block + 1) * BLOCK, len(order))]
        _lobes(some, vertex, normal, wo, arriving, lamp, alphas, share, out)


@njit(error_model="numpy", cache=True)
def _lobes(some, vertex, normal, wo, arriving, lamp, alphas, share, out):
    """A block of `lobes`."""
    count = lamp.shape[1]
    room, which = np.empty((11, count + 1), np.float32), np.empty(count + 1, np.int64)
    cosine, spread, nh, hv, fresnel = room[0], room[1], room[2], room[3], room[4]
    lx, ly, lz, every = room[5], room[6], room[7], room[8, :count]
    light = np.empty((count, 4), np.float32)
    lit, last = 0, -1
    for at in range(len(some)):
        m = some[at]
        nx, ny, nz = normal[m, 0], normal[m, 1], normal[m, 2]
        same = last >= 0 and vertex[m] == vertex[last]
        if not (same and nx == normal[last, 0] and ny == normal[last, 1] and nz == normal[last, 2]):
            _cosines(nx, ny, nz, lamp, every)
            lit = _above(every, which, cosine)
            v = vertex[m]
            for j in range(lit):
                i = which[j]
                lx[j], ly[j], lz[j], spread[j] = lamp[0, i], lamp[1, i], lamp[2, i], lamp[3, i]
                for c in range(3):
                    light[j, c] = arriving[v, i, c]
                light[j, 3] = lamp[4, i]
        last = m
        vx, vy, vz = wo[m, 0], wo[m, 1], wo[m, 2]
        nv = max(nx * vx + ny * vy + nz * vz, LEAST_COSINE)
        for j in range(lit):
            nh[j], hv[j], fresnel[j] = _half(cosine[j], nv, vx * lx[j] + vy * ly[j] + vz * lz[j])
        plain, rim = room[9, :lit], room[10, :lit]
        for k in range(len(alphas)):
            _parts(cosine, nv, nh, hv, fresnel, alphas[k] * alphas[k], spread, plain, rim)
            p0, p1, p2, c0, c1, c2, ps, cs = _totals(plain, rim, light)
            ps, cs = _scale(share[0, m, k], ps), _scale(share[1, m, k], cs)
            out[m, k, 0, 0], out[m, k, 0, 1], out[m, k, 0, 2] = p0 * ps, p1 * ps, p2 * ps
            out[m, k, 1, 0], out[m, k, 1, 1], out[m, k, 1, 2] = c0 * cs, c1 * cs, c2 * cs


@njit(parallel=True, error_model="numpy", cache=True)
def shade(normal, wo, corner, weights, f0, alpha, arriving, lamp, share, diffuse, specular):
    """Write irradiance and specular radiance (M, 3) of M points inside triangles.

    corner (M, 3) vertices of each point's triangle, weights (M, 3) barycentric; f0, alpha (M,); share (2, M): a and b;
    the others as in `lobes`.
    """
    count = lamp.shape[1]
    for m in prange(len(normal)):
        pa, pb, pc = arriving[corner[m, 0]], arriving[corner[m, 1]], arriving[corner[m, 2]]
        wa, wb, wc = weights[m, 0], weights[m, 1], weights[m, 2]
        vx, vy, vz = wo[m, 0], wo[m, 1], wo[m, 2]
        nv = max(normal[m, 0] * vx + normal[m, 1] * vy + normal[m, 2] * vz, LEAST_COSINE)
        every, which, cosine = (
            np.empty(count, np.float32),
            np.empty(count + 1, np.int64),
            np.empty(count + 1, np.float32),
        )
        _cosines(normal[m, 0], normal[m, 1], normal[m, 2], lamp, every)
        lit = _above(every, which, cosine)
        _cosines(vx, vy, vz, lamp, every)
        nh, hv, fresnel = np.empty(lit, np.float32), np.empty(lit, np.float32), np.empty(lit, np.float32)
        spread, light = np.empty(lit, np.float32), np.empty((lit, 4), np.float32)
        for j in range(lit):
            i = which[j]
            nh[j], hv[j], fresnel[j] = _half(cosine[j], nv, every[i])
            spread[j] = lamp[3, i]
            for c in range(3):
                light[j, c] = wa * pa[i, c] + wb * pb[i, c] + wc * pc[i, c]
            light[j, 3] = lamp[4, i]
        plain, rim = np.empty(lit, np.float32), np.empty(lit, np.float32)
        _parts(cosine, nv, nh, hv, fresnel, alpha[m] * alpha[m], spread, plain, rim)
        ps, cs, d0, d1, d2 = ZERO, ZERO, ZERO, ZERO, ZERO
        for j in range(lit):
            ps, cs = ps + plain[j] * light[j, 3], cs + rim[j] * light[j, 3]
            d0, d1, d2 = d0 + cosine[j] * light[j, 0], d1 + cosine[j] * light[j, 1], d2 + cosine[j] * light[j, 2]
        ps, cs = f0[m] * _scale(share[0, m], ps), _scale(share[1, m], cs)
        s0, s1, s2 = ZERO, ZERO, ZERO
        for j in range(lit):
            glossy = ps * plain[j] + cs * rim[j]
            s0, s1, s2 = s0 + glossy * light[j, 0], s1 + glossy * light[j, 1], s2 + glossy * light[j, 2]
        diffuse[m, 0], diffuse[m, 1], diffuse[m, 2] = d0, d1, d2
        specular[m, 0], specular[m, 1], specular[m, 2] = s0, s1, s2
