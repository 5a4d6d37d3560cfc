"""Compiled inner loops of the photo detail: lookup of a surface point in each photo, and the robust mean over photos.

All photos are in one flat array, as the square root of linear radiance in 16 bits: dark skin keeps its precision, and
decoding is one product. A camera is a row of numbers:

    0..11   rows of [R t], camera from asset          18..21  columns and rows of the photo, of its depth picture
    12..17  fx, skew, cx, fy, cy, pixels of depth per pixel of the photo
    22..26  k1 k2 p1 p2 k3                            27..29  camera's centre
    30..38  inverse of the colour response, row by row
    39      radiance of code 65535                    40      weight of the photo: its sharpness
    41, 42  offsets of its pixels and its depths

`clipped` has one number per pixel, not 0 where the pixel is clipped; it is empty if no photo has clipped pixels.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit, prange

ROW = 43
MAX_PHOTOS = 8  # photos that are used for one texel: those of the largest weight
MIN_COSINE = 0.2  # photos at more grazing angles are ignored
DEPTH_SLACK = 0.0015  # of the distance: depth tolerance of the visibility test
MIN_SPREAD = 0.004  # of albedo: smaller differences are noise of the photos
OUTLIER = 0.25  # of albedo: no detail of skin differs more from its surroundings
HUBER = 1.5  # spreads from which a photo is an outlier
ROUNDS = 3
BLOCK = 1024  # points per block


@njit(error_model="numpy", cache=True)
def _look(camera, depth, clipped, x, n):
    """Cosine, distance, column and row of point x with normal n in a photo. The cosine is 0 if the photo does not see
    the point, or if one of the four pixels of the bilinear lookup is clipped."""
    dx, dy, dz = camera[27] - x[0], camera[28] - x[1], camera[29] - x[2]
    height = dx * n[0] + dy * n[1] + dz * n[2]
    if height <= 0:
        return 0.0, 0.0, 0.0, 0.0
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    cosine = height / distance
    if cosine < MIN_COSINE:
        return 0.0, distance, 0.0, 0.0
    a = camera[0] * x[0] + camera[1] * x[1] + camera[2] * x[2] + camera[3]
    b = camera[4] * x[0] + camera[5] * x[1] + camera[6] * x[2] + camera[7]
    c = camera[8] * x[0] + camera[9] * x[1] + camera[10] * x[2] + camera[11]
    if c <= 0:
        return 0.0, distance, 0.0, 0.0
    a, b = a / c, b / c
    r2 = a * a + b * b
    radial = 1 + r2 * (camera[22] + r2 * (camera[23] + r2 * camera[26]))
    u = a * radial + 2 * camera[24] * a * b + camera[25] * (r2 + 2 * a * a)
    v = b * radial + camera[24] * (r2 + 2 * b * b) + 2 * camera[25] * a * b
    column = camera[12] * u + camera[13] * v + camera[14]
    row = camera[15] * v + camera[16]
    if not (1 <= column < camera[18] - 1 and 1 <= row < camera[19] - 1):
        return 0.0, distance, 0.0, 0.0
    i, j = int(column * camera[17]), int(row * camera[17])
    i, j = min(i, int(camera[20]) - 1), min(j, int(camera[21]) - 1)
    # the depth of a tilted surface varies within one pixel of the depth picture
    slack = 1 + DEPTH_SLACK + np.sqrt(max(1 - cosine * cosine, 0.0)) / (cosine * camera[12] * camera[17])
    if distance > depth[int(camera[42]) + j * int(camera[20]) + i] * slack:
        return 0.0, distance, 0.0, 0.0
    if len(clipped) > 0:
        width = int(camera[18])
        first = int(camera[41]) + int(row - 0.5) * width + int(column - 0.5)
        if clipped[first] or clipped[first + 1] or clipped[first + width] or clipped[first + width + 1]:
            return 0.0, distance, 0.0, 0.0
    return cosine, distance, column, row


@njit(error_model="numpy", cache=True)
def _colour(camera, pixels, column, row, out):
    """Write the linear colour (3,) at a position in a photo, without its colour response; bilinear."""
    x, y = column - 0.5, row - 0.5
    x0, y0 = int(x), int(y)
    fx, fy = x - x0, y - y0
    width, start = int(camera[18]), int(camera[41])
    first = start + y0 * width + x0
    scale = camera[39] / (65535.0 * 65535.0)
    r0, r1, r2 = 0.0, 0.0, 0.0
    for k in range(4):
        p = first + (k & 1) + (k >> 1) * width
        w = (fx if k & 1 else 1 - fx) * (fy if k >> 1 else 1 - fy) * scale
        a, b, c = float(pixels[p, 0]), float(pixels[p, 1]), float(pixels[p, 2])
        r0, r1, r2 = r0 + w * a * a, r1 + w * b * b, r2 + w * c * c
    for i in range(3):
        out[i] = camera[30 + 3 * i] * r0 + camera[31 + 3 * i] * r1 + camera[32 + 3 * i] * r2


@njit(parallel=True, error_model="numpy", cache=True)
def observed(cameras, pixels, depth, clipped, x, n, colour, cosines):
    """Linear colour (views, N, 3) of every point (N, 3) in every photo, and the cosines (views, N), 0 where a photo
    does not see the point."""
    for v in prange(len(cameras)):
        found = np.empty(3)
        for i in range(len(x)):
            cosine, _, column, row = _look(cameras[v], depth, clipped, x[i], n[i])
            cosines[v, i] = cosine
            if cosine > 0:
                _colour(cameras[v], pixels, column, row, found)
                for k in range(3):
                    colour[v, i, k] = found[k]


@njit(error_model="numpy", cache=True)
def residual(camera, pixels, depth, clipped, x, n, corner, weights, gloss, albedo, shade, out, cosines):
    """One photo's albedo minus the field's at N points (N, 3), clamped to OUTLIER, and the cosines (N,), 0 where it
    does not see the points.

    gloss (V, 3): specular radiance at the mesh's vertices; corner, weights (N, 3); shade (N, 3): radiance of albedo 1.
    """
    found = np.empty(3)
    for i in range(len(x)):
        cosine, _, column, row = _look(camera, depth, clipped, x[i], n[i])
        cosines[i] = cosine
        if cosine > 0:
            _colour(camera, pixels, column, row, found)
            for k in range(3):
                g = 0.0
                for j in range(3):
                    g += weights[i, j] * gloss[corner[i, j], k]
                out[i, k] = min(max((found[k] - g) / shade[i, k] - albedo[i, k], -OUTLIER), OUTLIER)


@njit(parallel=True, error_model="numpy", cache=True)
def fine(cameras, pixels, depth, clipped, x, n, corner, weights, gloss, low, relative, albedo, shade, out, support):
    """The finest band at N points: robust mean over photos of their albedo minus the field's, without their low band.

    gloss, low (views, V, 3): specular radiance, and the low band of the photo's residual, at the mesh's vertices.
    relative (views, V, 3): the photo's light over that of `shade`; (0, 0, 3) if it is the same in all photos.
    Writes out (N, 3), and support (N, 2): the sum of the weights (1 for one sharp photo from straight ahead), and the
    root mean square difference of the photos from their mean.
    """
    for block in prange((len(x) + BLOCK - 1) // BLOCK):
        rows = slice(block * BLOCK, min((block + 1) * BLOCK, len(x)))
        _fine(
            cameras, pixels, depth, clipped, x[rows], n[rows], corner[rows], weights[rows], gloss, low,
            relative, albedo[rows], shade[rows], out[rows], support[rows],
        )  # fmt: skip


@njit(error_model="numpy", cache=True)
def _fine(cameras, pixels, depth, clipped, x, n, corner, weights, gloss, low, relative, albedo, shade, out, support):
    """A block of `fine`. It is a function of its own because the bodies of parallel loops compile slowly."""
    values, chosen, found = np.empty((MAX_PHOTOS, 3)), np.empty(MAX_PHOTOS), np.empty(3)
    views, places = np.empty(MAX_PHOTOS, np.int64), np.empty((MAX_PHOTOS, 2))
    for i in range(len(x)):
        count = 0
        for v in range(len(cameras)):
            camera = cameras[v]
            cosine, distance, column, row = _look(camera, depth, clipped, x[i], n[i])
            if cosine == 0:
                continue
            # the resolution of a photo on the surface falls with the cosine and the distance
            w = cosine * camera[40] / distance
            w = w * w * w * w
            slot = count
            if count < MAX_PHOTOS:
                count += 1
            else:
                slot = 0
                for j in range(1, MAX_PHOTOS):
                    if chosen[j] < chosen[slot]:
                        slot = j
                if chosen[slot] >= w:
                    continue
            chosen[slot], views[slot], places[slot, 0], places[slot, 1] = w, v, column, row
        total = 0.0
        for j in range(count):
            v = views[j]
            _colour(cameras[v], pixels, places[j, 0], places[j, 1], found)
            for k in range(3):
                g, b, lit = 0.0, 0.0, shade[i, k]
                for c in range(3):
                    g += weights[i, c] * gloss[v, corner[i, c], k]
                    b += weights[i, c] * low[v, corner[i, c], k]
                if len(relative) > 0:
                    lit = 0.0
                    for c in range(3):
                        lit += weights[i, c] * relative[v, corner[i, c], k]
                    lit *= shade[i, k]
                values[j, k] = (found[k] - g) / lit - albedo[i, k] - b
                if abs(values[j, k]) > OUTLIER:  # a highlight, or something in front of the head
                    chosen[j] = 0.0
            total += chosen[j]
        support[i, 0] = total
        if total == 0:
            continue
        _robust_mean(values, chosen, count, out[i])
        square = 0.0
        for j in range(count):
            for k in range(3):
                square += chosen[j] * (values[j, k] - out[i, k]) ** 2
        support[i, 1] = np.sqrt(square / (3 * total))


@njit(error_model="numpy", cache=True)
def _weighted_median(values, weights, count, k):
    """Weighted median of a column of values; between two, the lower one."""
    half, best = 0.0, np.inf
    for j in range(count):
        half += 0.5 * weights[j]
    for j in range(count):
        below = 0.0
        for other in range(count):
            if values[other, k] <= values[j, k]:
                below += weights[other]
        if below >= half and values[j, k] < best:
            best = values[j, k]
    return best


@njit(error_model="numpy", cache=True)
def _robust_mean(values, weights, count, out):
    """Write the Huber mean (3,) of values (count, 3): weighted median, then reweighting. A weight must be above 0."""
    for k in range(3):
        centre = _weighted_median(values, weights, count, k)
        spread, total = 0.0, 0.0
        for j in range(count):
            spread += weights[j] * abs(values[j, k] - centre)
            total += weights[j]
        limit = HUBER * max(1.2533 * spread / total, MIN_SPREAD)  # of a normal distribution: sigma / mean |x|
        for _ in range(ROUNDS):
            total, mean = 0.0, 0.0
            for j in range(count):
                far = abs(values[j, k] - centre) / limit
                w = weights[j] if far <= 1 else weights[j] / far
                total += w
                mean += w * values[j, k]
            centre = mean / total
        out[k] = centre


@njit(error_model="numpy", cache=True)
def splat(corner, weights, values, share, sums, total):
    """Add values (N, 3) times share (N,) to the vertices `corner` (N, 3), in order: sums (V, 3), total (V,)."""
    for i in range(len(corner)):
        if share[i] > 0:
            for j in range(3):
                w = share[i] * weights[i, j]
                v = corner[i, j]
                total[v] += w
                for k in range(3):
                    sums[v, k] += w * values[i, k]
