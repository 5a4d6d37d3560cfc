"""Compiled: albedo, lobes and normal of each texel from its samples; what of the light arrives; what is left over.

Symbols (texel t, camera c, light i)
    y            sample: radiance over the light's intensity and e (lobe_kernels)
    V            share of the light that arrives
    m            model: V (a n.l / pi + specular)
Samples of texel t are rows first[t] to first[t + 1] of `samples` (P, L, 3); camera and weight are per row. NaN: the
camera has no picture under that light.

The colours of y - m are split into their mean, along white, and the rest. A dielectric's highlight is white: only the
mean can be wrong because of it. So the rest counts fully, and the mean less where the highlight is strong [Mallick
2005: colour space that turns white into one axis].
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

from stages.reflectance.lobe_kernels import FLAT, geometry, lobe, specular

STEP = 0.004  # of the normal, for its derivative
TURN = 0.1  # largest change of the normal in one step, radians
DARK = 0.02  # in y: below it errors count alike
GRAZING = 0.05  # least n.l and n.v of samples that are fitted
TRUST = 0.3  # weight of the mean where all is highlight
SWEEPS = 60
NARROW = 1e-3  # weight of the lobes' squares: as errors of .001 in y for an F0 of .03


@njit(error_model="numpy", cache=True)
def _not_negative(m, r, x, bounded):
    """Least squares with x[:bounded] >= 0, in place, by coordinate descent on the normal equations m x = r."""
    for _ in range(SWEEPS):
        change = 0.0
        for j in range(len(r)):
            g = r[j]
            for k in range(len(r)):
                if k != j:
                    g -= m[j, k] * x[k]
            v = g / (m[j, j] + 1e-20)
            if j < bounded and v < 0:
                v = 0.0
            change = max(change, abs(v - x[j]))
            x[j] = v
        if change < 1e-7:
            break


@njit(parallel=True, error_model="numpy", cache=True)
def fit(points, start, first, camera, weight, samples, arrives, rest, lights, axes, eyes, alphas, steps, prior, spread,
        albedo, lobes, normals):  # fmt: skip
    """Gauss-Newton steps for a (3), s (J) and the normal (2) of every texel; albedo (T, 3), lobes (T, J) and normals
    (T, 3) are read and written. Returns (T,) the weighted RMS error along white, 0 where nothing was fitted.

    start (T, 3): the geometry's normals, of which `prior` is the weight. samples (P, L, 3): y. arrives (T, L): V; only
    samples with V of nearly 1 are used. rest (T, L, 3): what the model does not describe, subtracted. spread: errors
    much larger than this share of the value are taken for outliers (Cauchy). The first two steps keep the normal.
    """
    count, width = len(lights), len(alphas)
    size = 3 + width + 2
    error = np.zeros(len(points))
    for t in prange(len(points)):
        n = normals[t].copy()
        m, r, x = np.zeros((size, size)), np.zeros(size), np.zeros(size)
        turned, value = np.zeros((3, 3)), np.zeros((3, 3))
        base, row = np.zeros(2 + width), np.zeros((3, size))
        off = np.zeros(3)
        for step in range(steps):
            m[:] = 0
            r[:] = 0
            side = np.zeros(3)
            side[0 if abs(n[0]) < 0.6 else 1] = 1.0
            t1 = np.cross(n, side)
            t1 /= np.sqrt((t1 * t1).sum())
            t2 = np.cross(n, t1)
            turned[0] = n
            turned[1] = n + STEP * t1
            turned[2] = n + STEP * t2
            squares, weights = 0.0, 0.0
            for k in range(first[t], first[t + 1]):
                for i in range(count):
                    if arrives[t, i] < 0.999:
                        continue
                    usable = samples[k, i, 0] == samples[k, i, 0]  # not a number: there is no picture
                    shine = 0.0
                    for z in range(3 if usable else 0):
                        _, nl, nv, nh, vh = geometry(points[t], turned[z], lights[i], axes[i], eyes[camera[k], i])
                        if nl < GRAZING or nv < GRAZING:
                            usable = False
                            break
                        total = 0.0
                        for j in range(width):
                            f = lobe(alphas[j], nl, nv, nh, vh) * nl
                            total += f * lobes[t, j]
                            if z == 0:
                                base[1 + j] = f
                        if z == 0:
                            base[0] = nl / np.pi
                            shine = total
                        for c in range(3):
                            value[z, c] = albedo[t, c] * nl / np.pi + total
                    if not usable:
                        continue
                    level = (value[0, 0] + value[0, 1] + value[0, 2]) / 3
                    for c in range(3):
                        off[c] = samples[k, i, c] - rest[t, i, c] - value[0, c]
                    mean = (off[0] + off[1] + off[2]) / 3
                    own = weight[k] / (level + DARK)
                    along = own / (1 + (mean / (spread * (level + 0.03))) ** 2)
                    along *= TRUST + (1 - TRUST) * ((level - shine) / (level + shine + 1e-6))
                    for c in range(3):
                        row[c, :] = 0
                        row[c, c] = base[0]
                        for j in range(width):
                            row[c, 3 + j] = base[1 + j]
                        row[c, size - 2] = (value[1, c] - value[0, c]) / STEP
                        row[c, size - 1] = (value[2, c] - value[0, c]) / STEP
                    for a in range(size):
                        ma = (row[0, a] + row[1, a] + row[2, a]) / 3
                        r[a] += along * 3 * ma * mean
                        for c in range(3):
                            r[a] += own * (row[c, a] - ma) * (off[c] - mean)
                        for b in range(a + 1):
                            mb = (row[0, b] + row[1, b] + row[2, b]) / 3
                            m[a, b] += along * 3 * ma * mb
                            for c in range(3):
                                m[a, b] += own * (row[c, a] - ma) * (row[c, b] - mb)
                    squares += along * mean * mean
                    weights += along
            if weights <= 0:
                break
            for a in range(size):
                for b in range(a):
                    m[b, a] = m[a, b]
            for c in range(3):
                x[c] = albedo[t, c]
            for j in range(width):
                x[3 + j] = lobes[t, j]
            x[size - 2] = 0.0
            x[size - 1] = 0.0
            for a in range(size):  # from changes to values, which can't be negative
                for b in range(size - 2):
                    r[a] += m[a, b] * x[b]
            for j in range(width):
                m[3 + j, 3 + j] += NARROW * weights  # a lobe that no sample meets stays dark
            back = start[t] - n
            for q, across in ((size - 2, t1), (size - 1, t2)):
                m[q, q] += prior * weights
                r[q] += prior * weights * (back * across).sum()
                if step < 2:
                    m[q, :] = 0
                    m[:, q] = 0
                    m[q, q] = 1
                    r[q] = 0
            _not_negative(m, r, x, size - 2)
            for c in range(3):
                albedo[t, c] = x[c]
            for j in range(width):
                lobes[t, j] = x[3 + j]
            u, v = x[size - 2], x[size - 1]
            far = np.sqrt(u * u + v * v)
            if far > TURN:
                u, v = u * TURN / far, v * TURN / far
            n = n + u * t1 + v * t2
            n /= np.sqrt((n * n).sum())
            error[t] = np.sqrt(squares / weights)
        normals[t] = n
    return error


@njit(parallel=True, error_model="numpy", cache=True)
def observe(points, normals, first, camera, weight, samples, lights, axes, eyes, alphas, albedo, lobes, least, share,
            trust):  # fmt: skip
    """What of each light arrived at each texel: share (T, L) of the model's radiance, 0 to 1; trust (T, L), 0 for n.l
    below `least`, where nothing can be said."""
    for t in prange(len(points)):
        for i in range(len(lights)):
            above, below, cosine = 0.0, 0.0, -1.0
            for k in range(first[t], first[t + 1]):
                _, nl, nv, nh, vh = geometry(points[t], normals[t], lights[i], axes[i], eyes[camera[k], i])
                cosine = nl
                if nl < least:
                    break
                if samples[k, i, 0] != samples[k, i, 0]:
                    continue
                shine = specular(lobes[t], alphas, nl, nv, nh, vh)
                for c in range(3):
                    matt = albedo[t, c] * nl / np.pi
                    value = matt + shine
                    w = weight[k] / (value + DARK) / (1 + (shine / (matt + 0.01)) ** 2)
                    above += w * samples[k, i, c] * value
                    below += w * value * value
            share[t, i], trust[t, i] = 0.0, 0.0
            if below > 0 and cosine >= least:
                share[t, i] = min(max(above / below, 0.0), 1.0)
                trust[t, i] = min((cosine - least) / 0.15, 1.0)


@njit(parallel=True, error_model="numpy", cache=True)
def left_over(points, normals, first, camera, weight, samples, arrives, lights, axes, eyes, alphas, albedo, lobes, most,
              out):  # fmt: skip
    """out (T, L, 3): mean of y - m over the cameras, at most `most`. Cameras that see the highlight count less."""
    for t in prange(len(points)):
        for i in range(len(lights)):
            total, r0, r1, r2 = 0.0, 0.0, 0.0, 0.0
            for k in range(first[t], first[t + 1]):
                if samples[k, i, 0] != samples[k, i, 0]:
                    continue
                _, nl, nv, nh, vh = geometry(points[t], normals[t], lights[i], axes[i], eyes[camera[k], i])
                shine = arrives[t, i] * specular(lobes[t], alphas, nl, max(nv, FLAT), nh, vh)
                matt = arrives[t, i] * max(nl, 0.0) / np.pi
                w = weight[k] / (1 + (shine / 0.05) ** 2)
                r0 += w * (samples[k, i, 0] - albedo[t, 0] * matt - shine)
                r1 += w * (samples[k, i, 1] - albedo[t, 1] * matt - shine)
                r2 += w * (samples[k, i, 2] - albedo[t, 2] * matt - shine)
                total += w
            if total > 0:
                out[t, i, 0] = min(max(r0 / total, -most), most)
                out[t, i, 1] = min(max(r1 / total, -most), most)
                out[t, i, 2] = min(max(r2 / total, -most), most)


@njit(parallel=True, error_model="numpy", cache=True)
def smooth_terms(values, count_of, basis, penalty, scale, rounds, out):
    """out (T, K, 3): coefficients of smooth functions of the light, basis (L, K), for values (T, L, 3) that count
    count_of (T, L), with a penalty (K,), robust against shadows that the model places wrongly (Cauchy, `scale`)."""
    count, size = basis.shape
    for t in prange(len(values)):
        x = np.zeros((size, 3))
        w = count_of[t].copy()
        for step in range(rounds):
            m, r = np.zeros((size, size)), np.zeros((size, 3))
            for i in range(count):
                if step > 0:
                    e = 0.0
                    for c in range(3):
                        p = 0.0
                        for k in range(size):
                            p += basis[i, k] * x[k, c]
                        e += (values[t, i, c] - p) ** 2
                    w[i] = count_of[t, i] / (1 + e / (3 * scale * scale))
                for a in range(size):
                    for k in range(a + 1):
                        m[a, k] += w[i] * basis[i, a] * basis[i, k]
                    for c in range(3):
                        r[a, c] += w[i] * basis[i, a] * values[t, i, c]
            for a in range(size):
                for k in range(a):
                    m[k, a] = m[a, k]
                m[a, a] += penalty[a]
            x = np.linalg.solve(m, r)
        out[t] = x
