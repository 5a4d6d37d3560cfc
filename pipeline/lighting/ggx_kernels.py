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
in parts: lamps below the horizon, about half, are left out first; then a loop has no sums, so that it vectorises
under strict arithmetic.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

ONE, ZERO, HALF, TWO = np.float32(1), np.float32(0), np.float32(0.5), np.float32(2)
PI = np.float32(np.pi)
SMOOTH = np.float32(1)
MOST = np.float32(4)
LEAST_COSINE = np.float32(1e-3)  # of n.v: the masking's limit at 0 is finite, its terms are not


@njit(error_model="numpy", cache=True)
def _above(normal, lamp, which, cosine):
    """The lamps above the horizon of a normal (3,), in their order: writes their indices and n.l, returns their
    number. The others would add 0."""
    count = 0
    for i in range(lamp.shape[1]):
        nl = normal[0] * lamp[0, i] + normal[1] * lamp[1, i] + normal[2] * lamp[2, i]
        if nl > ZERO:
            which[count], cosine[count] = i, nl
            count += 1
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


@njit(parallel=True, error_model="numpy", cache=True)
def lobes(vertex, normal, wo, arriving, lamp, alphas, share, out):
    """Write the specular radiance of each of M observations for K widths, in two parts: out (M, K, 2, 3), such that the
    layer of F0 reflects F0 out[:, :, 0] + out[:, :, 1].

    vertex (M,); normal, wo (M, 3) unit; arriving (V, N, 3) flux of each lamp at the vertices; lamp (5, N): direction,
    spread, solid angle; alphas (K,); share (2, M, K): a and b. All float32.
    """
    count = lamp.shape[1]
    for m in prange(len(vertex)):
        own = arriving[vertex[m]]
        nx, ny, nz = normal[m, 0], normal[m, 1], normal[m, 2]
        vx, vy, vz = wo[m, 0], wo[m, 1], wo[m, 2]
        nv = max(nx * vx + ny * vy + nz * vz, LEAST_COSINE)
        which, cosine = np.empty(count, np.int64), np.empty(count, np.float32)
        lit = _above(normal[m], lamp, which, cosine)
        nh, hv, fresnel = np.empty(lit, np.float32), np.empty(lit, np.float32), np.empty(lit, np.float32)
        for j in range(lit):
            i = which[j]
            lv = vx * lamp[0, i] + vy * lamp[1, i] + vz * lamp[2, i]
            nh[j], hv[j], fresnel[j] = _half(cosine[j], nv, lv)
        plain, rim = np.empty(lit, np.float32), np.empty(lit, np.float32)
        for k in range(len(alphas)):
            a2 = alphas[k] * alphas[k]
            for j in range(lit):
                w, c = _reflected(cosine[j], nv, nh[j], hv[j], a2, lamp[3, which[j]]), fresnel[j]
                plain[j], rim[j] = w * (ONE - c), w * c
            p0, p1, p2, c0, c1, c2, ps, cs = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
            for j in range(lit):
                i = which[j]
                e0, e1, e2, solid = own[i, 0], own[i, 1], own[i, 2], lamp[4, i]
                ps, cs = ps + plain[j] * solid, cs + rim[j] * solid
                p0, p1, p2 = p0 + plain[j] * e0, p1 + plain[j] * e1, p2 + plain[j] * e2
                c0, c1, c2 = c0 + rim[j] * e0, c1 + rim[j] * e1, c2 + rim[j] * e2
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
        nx, ny, nz = normal[m, 0], normal[m, 1], normal[m, 2]
        vx, vy, vz = wo[m, 0], wo[m, 1], wo[m, 2]
        nv = max(nx * vx + ny * vy + nz * vz, LEAST_COSINE)
        a2 = alpha[m] * alpha[m]
        which, cosine = np.empty(count, np.int64), np.empty(count, np.float32)
        lit = _above(normal[m], lamp, which, cosine)
        plain, rim = np.empty(lit, np.float32), np.empty(lit, np.float32)
        ps, cs = ZERO, ZERO
        for j in range(lit):
            i = which[j]
            lv = vx * lamp[0, i] + vy * lamp[1, i] + vz * lamp[2, i]
            nh, hv, c = _half(cosine[j], nv, lv)
            w = _reflected(cosine[j], nv, nh, hv, a2, lamp[3, i])
            plain[j], rim[j] = w * (ONE - c), w * c
        for j in range(lit):
            solid = lamp[4, which[j]]
            ps, cs = ps + plain[j] * solid, cs + rim[j] * solid
        ps, cs = f0[m] * _scale(share[0, m], ps), _scale(share[1, m], cs)
        d0, d1, d2, s0, s1, s2 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        for j in range(lit):
            i = which[j]
            e0 = wa * pa[i, 0] + wb * pb[i, 0] + wc * pc[i, 0]
            e1 = wa * pa[i, 1] + wb * pb[i, 1] + wc * pc[i, 1]
            e2 = wa * pa[i, 2] + wb * pb[i, 2] + wc * pc[i, 2]
            d0, d1, d2 = d0 + cosine[j] * e0, d1 + cosine[j] * e1, d2 + cosine[j] * e2
            glossy = ps * plain[j] + cs * rim[j]
            s0, s1, s2 = s0 + glossy * e0, s1 + glossy * e1, s2 + glossy * e2
        diffuse[m, 0], diffuse[m, 1], diffuse[m, 2] = d0, d1, d2
        specular[m, 0], specular[m, 1], specular[m, 2] = s0, s1, s2
