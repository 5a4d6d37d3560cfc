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
BLOCK = 64  # points per block: they share the order in which photos are asked


@njit(error_model="numpy", cache=True)
def _facing(cameras, v, x, y, z, nx, ny, nz):
    """Cosine between a normal and the direction from a point to camera v, 0 below MIN_COSINE, and the distance.

    Rows and points are passed as numbers: a slice of an array in a loop costs more than this function.
    """
    dx, dy, dz = cameras[v, 27] - x, cameras[v, 28] - y, cameras[v, 29] - z
    height = dx * nx + dy * ny + dz * nz
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    cosine = height / distance
    return (cosine if cosine >= MIN_COSINE else 0.0), distance


@njit(error_model="numpy", cache=True)
def _look(cameras, v, depth, clipped, x, y, z, cosine, distance):
    """Column and row of a point in photo v; -1 if the photo does not see it, or if one of the four pixels of the
    bilinear lookup is clipped."""
    a = cameras[v, 0] * x + cameras[v, 1] * y + cameras[v, 2] * z + cameras[v, 3]
    b = cameras[v, 4] * x + cameras[v, 5] * y + cameras[v, 6] * z + cameras[v, 7]
    c = cameras[v, 8] * x + cameras[v, 9] * y + cameras[v, 10] * z + cameras[v, 11]
    if c <= 0:
        return -1.0, -1.0
    a, b = a / c, b / c
    r2 = a * a + b * b
    radial = 1 + r2 * (cameras[v, 22] + r2 * (cameras[v, 23] + r2 * cameras[v, 26]))
    p1, p2 = cameras[v, 24], cameras[v, 25]
    s = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    t = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    column = cameras[v, 12] * s + cameras[v, 13] * t + cameras[v, 14]
    row = cameras[v, 15] * t + cameras[v, 16]
    if not (1 <= column < cameras[v, 18] - 1 and 1 <= row < cameras[v, 19] - 1):
        return -1.0, -1.0
    i, j = int(column * cameras[v, 17]), int(row * cameras[v, 17])
    i, j = min(i, int(cameras[v, 20]) - 1), min(j, int(cameras[v, 21]) - 1)
    # the depth of a tilted surface varies within one pixel of the depth picture
    slack = 1 + DEPTH_SLACK + np.sqrt(max(1 - cosine * cosine, 0.0)) / (cosine * cameras[v, 12] * cameras[v, 17])
    if distance > depth[int(cameras[v, 42]) + j * int(cameras[v, 20]) + i] * slack:
        return -1.0, -1.0
    if len(clipped) > 0:
        width = int(cameras[v, 18])
        first = int(cameras[v, 41]) + int(row - 0.5) * width + int(column - 0.5)
        if clipped[first] or clipped[first + 1] or clipped[first + width] or clipped[first + width + 1]:
            return -1.0, -1.0
    return column, row


@njit(error_model="numpy", cache=True)
def _colour(cameras, v, pixels, column, row, out):
    """Write the linear colour (3,) at a position in photo v, without its colour response; bilinear."""
    x, y = column - 0.5, row - 0.5
    x0, y0 = int(x), int(y)
    fx, fy = x - x0, y - y0
    width, start = int(cameras[v, 18]), int(cameras[v, 41])
    first = start + y0 * width + x0
    scale = cameras[v, 39] / (65535.0 * 65535.0)
    r0, r1, r2 = 0.0, 0.0, 0.0
    for k in range(4):
        p = first + (k & 1) + (k >> 1) * width
        w = (fx if k & 1 else 1 - fx) * (fy if k >> 1 else 1 - fy) * scale
        a, b, c = float(pixels[p, 0]), float(pixels[p, 1]), float(pixels[p, 2])
        r0, r1, r2 = r0 + w * a * a, r1 + w * b * b, r2 + w * c * c
    for i in range(3):
        out[i] = cameras[v, 30 + 3 * i] * r0 + cameras[v, 31 + 3 * i] * r1 + cameras[v, 32 + 3 * i] * r2


@njit(error_model="numpy", cache=True)
def _seen(cameras, v, pixels, depth, clipped, x, n, out):
    """Cosine of a point x with normal n (3,) in photo v, 0 if the photo does not see it; writes its colour (3,)."""
    cosine, distance = _facing(cameras, v, x[0], x[1], x[2], n[0], n[1], n[2])
    if cosine == 0:
        return 0.0
    column, row = _look(cameras, v, depth, clipped, x[0], x[1], x[2], cosine, distance)
    if column < 0:
        return 0.0
    _colour(cameras, v, pixels, column, row, out)
    return cosine


@njit(parallel=True, error_model="numpy", cache=True)
def observed(cameras, pixels, depth, clipped, x, n, colour, cosines):
    """Linear colour (views, N, 3) of every point (N, 3) in every photo, and the cosines (views, N), 0 where a photo
    does not see the point."""
    for v in prange(len(cameras)):
        found = np.empty(3)
        for i in range(len(x)):
            cosine = _seen(cameras, v, pixels, depth, clipped, x[i], n[i], found)
            cosines[v, i] = cosine
            if cosine > 0:
                for k in range(3):
                    colour[v, i, k] = found[k]


@njit(error_model="numpy", cache=True, nogil=True)
def residual(cameras, v, pixels, depth, clipped, x, n, corner, weights, gloss, albedo, shade, out, cosines):
    """Photo v's albedo minus the field's at N points (N, 3), clamped to OUTLIER, and the cosines (N,), 0 where it
    does not see the points.

    gloss (V, 3): specular radiance at the mesh's vertices; corner, weights (N, 3); shade (N, 3): radiance of albedo 1.
    """
    found = np.empty(3)
    for i in range(len(x)):
        cosine = _seen(cameras, v, pixels, depth, clipped, x[i], n[i], found)
        cosines[i] = cosine
        if cosine > 0:
            for k in range(3):
                g = 0.0
                for j in range(3):
                    g += weights[i, j] * gloss[corner[i, j], k]
                out[i, k] = min(max((found[k] - g) / shade[i, k] - albedo[i, k], -OUTLIER), OUTLIER)


@njit(parallel=True, error_model="numpy", cache=True)
def fine(cameras, pixels, depth, clipped, order, x, n, corner, weights, bands, relative, albedo, shade, out, support):
    """The finest band at N points: robust mean over photos of their albedo minus the field's, without their low band.

    order (N,): the points, neighbours on the surface one after the other, whose numbers lie together in memory; the
    result does not depend on it. bands (V, views, 6): at the mesh's vertices, specular radiance, and the low band of
    the photo's residual. relative (views, V, 3): the photo's light over that of `shade`; (0, 0, 3) if it is the same in
    all photos.
    Writes out (N, 3), and support (N, 2): the sum of the weights (1 for one sharp photo from straight ahead), and the
    root mean square difference of the photos from their mean.
    """
    for block in prange((len(order) + BLOCK - 1) // BLOCK):
        some = order[block * BLOCK : min((block + 1) * BLOCK, len(order))]
        _fine(
            cameras, pixels, depth, clipped, some, x, n, corner, weights, bands, relative, albedo, shade, out, support
        )  # fmt: skip


@njit(error_model="numpy", cache=True)
def _by_weight(cameras, x, n, i):
    """The photos, those with the largest weight at point i first."""
    found = np.empty(len(cameras))
    for v in range(len(cameras)):
        cosine, distance = _facing(cameras, v, x[i, 0], x[i, 1], x[i, 2], n[i, 0], n[i, 1], n[i, 2])
        found[v] = -cosine * cameras[v, 40] / distance
    return np.argsort(found)


@njit(error_model="numpy", cache=True)
def _best(cameras, photos, depth, clipped, x, n, i, chosen, views, places):
    """The photos that see point i with the largest weights, of equal ones the first: writes weights, numbers and places
    (MAX_PHOTOS,) in the order of their numbers, and returns how many.

    Whatever the order `photos` in which they are asked, the result is the same. If the best come first, a photo that
    faces the point but can't be among the chosen is not looked up, which costs several times as much as its weight.
    """
    x0, x1, x2, n0, n1, n2 = x[i, 0], x[i, 1], x[i, 2], n[i, 0], n[i, 1], n[i, 2]
    count = 0
    for at in range(len(photos)):
        v = photos[at]
        cosine, distance = _facing(cameras, v, x0, x1, x2, n0, n1, n2)
        if cosine == 0:
            continue
        # the resolution of a photo on the surface falls with the cosine and the distance
        w = cosine * cameras[v, 40] / distance
        w = w * w * w * w
        slot = count
        if count == MAX_PHOTOS:
            slot = 0
            for j in range(1, MAX_PHOTOS):
                if chosen[j] < chosen[slot] or (chosen[j] == chosen[slot] and views[j] > views[slot]):
                    slot = j
            if chosen[slot] > w or (chosen[slot] == w and views[slot] < v):
                continue
        column, row = _look(cameras, v, depth, clipped, x0, x1, x2, cosine, distance)
        if column < 0:
            continue
        count = min(count + 1, MAX_PHOTOS)
        chosen[slot], views[slot], places[slot, 0], places[slot, 1] = w, v, column, row
    for j in range(1, count):
        w, v, column, row = chosen[j], views[j], places[j, 0], places[j, 1]
        k = j
        while k > 0 and views[k - 1] > v:
            chosen[k], views[k], places[k] = chosen[k - 1], views[k - 1], places[k - 1]
            k -= 1
        chosen[k], views[k], places[k, 0], places[k, 1] = w, v, column, row
    return count


@njit(error_model="numpy", cache=True)
def _fine(cameras, pixels, depth, clipped, some, x, n, corner, weights, bands, relative, albedo, shade, out, support):
    """A block of `fine`. It is a function of its own because the bodies of parallel loops compile slowly."""
    values, chosen, found, between = np.empty((MAX_PHOTOS, 3)), np.empty(MAX_PHOTOS), np.empty(3), np.empty(6)
    views, places = np.empty(MAX_PHOTOS, np.int64), np.empty((MAX_PHOTOS, 2))
    photos = _by_weight(cameras, x, n, some[len(some) // 2])
    for at in range(len(some)):
        i = some[at]
        count = _best(cameras, photos, depth, clipped, x, n, i, chosen, views, places)
        total = 0.0
        for j in range(count):
            v = views[j]
            _colour(cameras, v, pixels, places[j, 0], places[j, 1], found)
            between[:] = 0.0
            for c in range(3):
                weight, vertex = weights[i, c], corner[i, c]
                for k in range(6):
                    between[k] += weight * bands[vertex, v, k]
            for k in range(3):
                lit = shade[i, k]
                if len(relative) > 0:
                    lit = 0.0
                    for c in range(3):
                        lit += weights[i, c] * relative[v, corner[i, c], k]
                    lit *= shade[i, k]
                values[j, k] = (found[k] - between[k]) / lit - albedo[i, k] - between[3 + k]
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


@njit(error_model="numpy", cache=True, nogil=True)
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
