"""Compiled inner loops of dense stereo: plane sweep, semi-global aggregation, refinement.

Symbols: inverse depth w = 1 / z, z along the optical axis of the reference view. A pixel (u, v) of the reference view
is seen by another view at the homogeneous position A (u, v, 1) + w b, with A (3, 3) and b (3,) of that pair. A plane in
space has an inverse depth that is affine in (u, v). Pictures are padded to one size with NaN, so that samples beyond a
frame are NaN. All kernels release the GIL: views run in several threads.
"""

# mypy: disable-error-code=no-untyped-def
from __future__ import annotations

import numpy as np
from numba import njit

PATCH = 25  # samples of a patch of the refinement, 5 x 5
FAILED = np.float32(-1.0)  # score where fewer than MIN_OTHERS views can be compared
MIN_OTHERS = 2
FORBIDDEN = np.float32(2.5)  # matching cost of a depth outside the range of its ray; others are at most 2


@njit(inline="always")
def _sample(image, x, y):
    """Bilinear sample at x, y in pixel indices that lie inside the picture."""
    c, r = int(x), int(y)
    fx, fy = np.float32(x - c), np.float32(y - r)
    upper = image[r, c] + fx * (image[r, c + 1] - image[r, c])
    lower = image[r + 1, c] + fx * (image[r + 1, c + 1] - image[r + 1, c])
    return upper + fy * (lower - upper)


@njit(error_model="numpy", nogil=True, cache=True)
def _best_half(scores, count):
    """Mean of the better half of scores[:count], which gets sorted; FAILED if there are too few."""
    if count < MIN_OTHERS:
        return FAILED
    for i in range(1, count):
        s, j = scores[i], i - 1
        while j >= 0 and scores[j] < s:
            scores[j + 1] = scores[j]
            j -= 1
        scores[j + 1] = s
    half = max((count + 1) // 2, MIN_OTHERS)
    total = np.float32(0.0)
    for i in range(half):
        total += scores[i]
    return total / half


@njit(error_model="numpy", nogil=True, cache=True)
def _warped_row(other, a, b, w, y, x0, x1, row):
    """Samples of another view at the pixels x0..x1-1 of row y on the plane w; NaN beyond its frame."""
    h, width = other.shape
    v = y + 0.5
    for x in range(x0, x1):
        u = x + 0.5
        qz = a[2, 0] * u + a[2, 1] * v + a[2, 2] + w * b[2]
        row[x] = np.nan
        if qz > 1e-9:
            px = (a[0, 0] * u + a[0, 1] * v + a[0, 2] + w * b[0]) / qz - 0.5
            py = (a[1, 0] * u + a[1, 1] * v + a[1, 2] + w * b[1]) / qz - 0.5
            if px >= 0 and py >= 0 and px < width - 1 and py < h - 1:
                row[x] = _sample(other, px, py)


@njit(error_model="numpy", nogil=True, cache=True)
def _plane_scores(grey, mask, other, a, b, w, box, half, floor, out):
    """NCC of windows of (2 half + 1)^2 pixels on one plane, within the box (y0, y1, x0, x1); NaN beyond the frame.

    Only pixels of the mask count. Sums over windows are running sums: along columns, then along the row.
    """
    y0, y1, x0, x1 = box
    height, width = grey.shape
    size = 2 * half + 1
    top, bottom, left, right = max(y0 - half, 0), min(y1 + half, height), max(x0 - half, 0), min(x1 + half, width)
    ring = np.zeros((size, width), np.float32)
    sums = np.zeros((6, width))  # n, r, r r, s, s s, r s of each column
    for y in range(top, bottom + half):
        if y - size >= top:
            _add_row(grey, mask, ring[(y - size) % size], y - size, left, right, -1.0, sums)
        if y < bottom:
            _warped_row(other, a, b, w, y, left, right, ring[y % size])
            _add_row(grey, mask, ring[y % size], y, left, right, 1.0, sums)
        centre = y - half
        if centre >= y0 and centre < y1:
            _score_row(sums, left, right, x0, x1, half, floor, out[centre])


@njit(error_model="numpy", nogil=True, cache=True)
def _add_row(grey, mask, row, y, left, right, sign, sums):
    for x in range(left, right):
        s = row[x]
        if mask[y, x] and s == s:
            r = grey[y, x]
            sums[0, x] += sign
            sums[1, x] += sign * r
            sums[2, x] += sign * r * r
            sums[3, x] += sign * s
            sums[4, x] += sign * s * s
            sums[5, x] += sign * r * s


@njit(error_model="numpy", nogil=True, cache=True)
def _score_row(sums, left, right, x0, x1, half, floor, out):
    n, r, rr, s, ss, rs = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for x in range(left, min(x1 + half, right) + half):
        for sign in (1.0, -1.0):
            c = x if sign > 0 else x - 2 * half - 1
            if c >= left and c < right:
                n += sign * sums[0, c]
                r += sign * sums[1, c]
                rr += sign * sums[2, c]
                s += sign * sums[3, c]
                ss += sign * sums[4, c]
                rs += sign * sums[5, c]
        centre = x - half
        if centre >= x0 and centre < x1:
            out[centre] = np.nan
            if n > 0.5 * (2 * half + 1) ** 2 * 0.5:
                flat = floor * np.sqrt(n)
                length = (np.sqrt(max(rr - r * r / n, 0.0)) + flat) * (np.sqrt(max(ss - s * s / n, 0.0)) + flat)
                out[centre] = (rs - r * s / n) / length


@njit(error_model="numpy", nogil=True, cache=True)
def sweep(grey, mask, nearest, farthest, planes, others, a, b, half, floor, cost):
    """Matching costs 1 - score (H, W, D) of the planes (D,), inverse depths; FORBIDDEN outside a ray's range.

    grey (H, W), mask (H, W); nearest, farthest (H, W) inverse depths, nearest >= farthest; others (M, H, W); a
    (M, 3, 3) and b (M, 3) of the pairs; floor: standard deviation of the noise.
    """
    height, width = grey.shape
    scores = np.empty((len(others), height, width), np.float32)
    found = np.empty(len(others), np.float32)
    slack = abs(planes[1] - planes[0]) if len(planes) > 1 else 0.0
    for i in range(len(planes)):
        w = planes[i]
        y0, y1, x0, x1 = height, 0, width, 0
        for y in range(height):
            for x in range(width):
                cost[y, x, i] = FORBIDDEN
                if mask[y, x] and w <= nearest[y, x] + slack and w >= farthest[y, x] - slack:
                    y0, y1, x0, x1 = min(y0, y), max(y1, y + 1), min(x0, x), max(x1, x + 1)
        if y1 <= y0:
            continue
        for k in range(len(others)):
            _plane_scores(grey, mask, others[k], a[k], b[k], w, (y0, y1, x0, x1), half, floor, scores[k])
        for y in range(y0, y1):
            for x in range(x0, x1):
                if mask[y, x] and w <= nearest[y, x] + slack and w >= farthest[y, x] - slack:
                    count = 0
                    for k in range(len(others)):
                        if scores[k, y, x] == scores[k, y, x]:
                            found[count] = scores[k, y, x]
                            count += 1
                    cost[y, x, i] = 1 - _best_half(found, count)


@njit(error_model="numpy", nogil=True, cache=True)
def _step(cost, before, p1, p2, out):
    """One step along a path: out_d = cost_d + min(before_d, before_d+-1 + p1, min(before) + p2) - min(before)."""
    depths = len(cost)
    least = before[0]
    for d in range(1, depths):
        least = min(least, before[d])
    for d in range(depths):
        best = min(before[d], least + p2)
        if d > 0:
            best = min(best, before[d - 1] + p1)
        if d < depths - 1:
            best = min(best, before[d + 1] + p1)
        out[d] = cost[d] + best - least


@njit(error_model="numpy", nogil=True, cache=True)
def aggregate(cost, mask, p1, p2, total):
    """Semi-global aggregation of costs (H, W, D) along eight directions, summed into total (H, W, D), zeros before.

    p1: penalty of a step of one plane between neighbouring pixels; p2: of any larger step. Paths begin anew outside
    the mask. Source: Hirschmueller, Stereo processing by semiglobal matching and mutual information (2008), eq. 13.
    """
    height, width, depths = cost.shape
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        for sign in (1, -1):
            rows = np.zeros((2, width, depths), np.float32)
            sy, sx = sign * dy, sign * dx
            for j in range(height):
                y = j if sign > 0 else height - 1 - j
                now, last = rows[j % 2], rows[(j + 1) % 2] if dy else rows[j % 2]
                for i in range(width):
                    x = i if sx > 0 or (sx == 0 and sign > 0) else width - 1 - i
                    if not mask[y, x]:
                        continue
                    py, px = y - sy, x - sx
                    if py < 0 or py >= height or px < 0 or px >= width or not mask[py, px]:
                        now[x] = cost[y, x]
                    else:
                        _step(cost[y, x], last[px], p1, p2, now[x])
                    total[y, x] += now[x]


@njit(error_model="numpy", nogil=True, cache=True)
def winners(total, cost, mask, planes, found, score):
    """Inverse depth (H, W) of the smallest aggregated cost, refined by a parabola, and its own score 1 - cost.

    NaN where no plane is allowed.
    """
    height, width, depths = total.shape
    for y in range(height):
        for x in range(width):
            found[y, x], score[y, x] = np.nan, FAILED
            best = -1
            if mask[y, x]:
                for d in range(depths):
                    if cost[y, x, d] < FORBIDDEN and (best < 0 or total[y, x, d] < total[y, x, best]):
                        best = d
            if best < 0:
                continue
            shift = 0.0
            if 0 < best < depths - 1:
                before, peak, after = total[y, x, best - 1], total[y, x, best], total[y, x, best + 1]
                bend = before - 2 * peak + after
                if bend > 1e-9:
                    shift = min(max(0.5 * (before - after) / bend, -0.5), 0.5)
            step = planes[1] - planes[0] if depths > 1 else 0.0
            found[y, x], score[y, x] = planes[best] + shift * step, 1 - cost[y, x, best]


@njit(error_model="numpy", nogil=True, cache=True)
def _gather_patch(grey, mask, x, y, stride, patch):
    """Copy the samples around a pixel to patch (PATCH,) with their mean removed, NaN outside the mask. Returns their
    number and length."""
    height, width = grey.shape
    n, total, square, at = 0, np.float32(0.0), np.float32(0.0), 0
    for j in range(-2, 3):
        for i in range(-2, 3):
            row, column = y + j * stride, x + i * stride
            patch[at] = np.nan
            if 0 <= row < height and 0 <= column < width and mask[row, column]:
                patch[at] = grey[row, column]
                total += patch[at]
                n += 1
            at += 1
    mean = total / np.float32(max(n, 1))
    for k in range(PATCH):
        patch[k] -= mean
        if patch[k] == patch[k]:
            square += patch[k] * patch[k]
    return n, np.sqrt(square)


@njit(error_model="numpy", nogil=True, cache=True)
def _pair_score(patch, n, length, other, a, b, x, y, w, wx, wy, stride, floor):
    """NCC of a patch with another view on the plane of inverse depth w + wx dx + wy dy; NaN beyond its frame."""
    right, low = np.float32(other.shape[1] - 1), np.float32(other.shape[0] - 1)
    half = np.float32(0.5)
    u, v = np.float32(x) + half, np.float32(y) + half
    one = np.float32(stride)
    ix, iy, iz = one * (a[0, 0] + wx * b[0]), one * (a[1, 0] + wx * b[1]), one * (a[2, 0] + wx * b[2])
    jx, jy, jz = one * (a[0, 1] + wy * b[0]), one * (a[1, 1] + wy * b[1]), one * (a[2, 1] + wy * b[2])
    qx = a[0, 0] * u + a[0, 1] * v + a[0, 2] + w * b[0]
    qy = a[1, 0] * u + a[1, 1] * v + a[1, 2] + w * b[1]
    qz = a[2, 0] * u + a[2, 1] * v + a[2, 2] + w * b[2]
    s1, s2, product, at = np.float32(0.0), np.float32(0.0), np.float32(0.0), 0
    middle = np.float32(np.nan)
    for j in range(-2, 3):
        down, two = np.float32(j), np.float32(2.0)
        rx, ry, rz = qx + down * jx - two * ix, qy + down * jy - two * iy, qz + down * jz - two * iz
        for _ in range(5):
            r = patch[at]
            at += 1
            if r == r:
                inverse = np.float32(1.0) / rz
                px, py = rx * inverse - half, ry * inverse - half
                if not (rz > 0 and px >= 0 and py >= 0 and px < right and py < low):
                    return np.float32(np.nan)
                s = _sample(other, px, py)
                if middle != middle:
                    middle = s  # sums of differences from one sample keep their digits
                s -= middle
                s1 += s
                s2 += s * s
                product += r * s
            rx += ix
            ry += iy
            rz += iz
    flat = floor * np.sqrt(np.float32(n))
    spread = np.sqrt(max(s2 - s1 * s1 / np.float32(n), np.float32(0.0)))
    return product / ((length + flat) * (spread + flat))


@njit(error_model="numpy", nogil=True, cache=True)
def _patch_score(patch, n, length, others, a, b, x, y, w, wx, wy, stride, floor, scores):
    """Agreement of a patch with the better half of the other views."""
    if 2 * n <= PATCH:
        return FAILED
    count = 0
    for k in range(len(others)):
        s = _pair_score(patch, n, length, others[k], a[k], b[k], x, y, w, wx, wy, stride, floor)
        if s == s:
            scores[count] = s
            count += 1
    return _best_half(scores, count)


@njit(error_model="numpy", nogil=True, cache=True)
def refine(grey, mask, nearest, farthest, others, a, b, floor, stride, rounds, step, pull, seed, plane, score):
    """PatchMatch on slanted planes, in place. plane (H, W, 3): inverse depth and its slopes per pixel; score (H, W).

    Each round tries the planes of four neighbours, and three random changes of up to `step` (inverse depth), smaller in
    each round. pull: loss of score for a distance of `step` from the depth at the beginning, so that blank surfaces
    stay as smooth as they are. Source: Bleyer, PatchMatch stereo (2011); checkerboard of Galliani, Gipuma (2015).
    """
    np.random.seed(seed)
    height, width = grey.shape
    scores = np.empty(max(len(others), 1), np.float32)
    patch = np.empty(PATCH, np.float32)
    origin = plane[:, :, 0].copy()
    for turn in range(2 * rounds + 1):  # at first only the scores
        reach = step * np.float32(0.5) ** ((turn - 1) // 2)
        for y in range(height):
            for x in range(width):
                if turn == 0:
                    score[y, x] = FAILED
                if not mask[y, x] or origin[y, x] != origin[y, x] or (turn > 0 and (x + y + turn) % 2):
                    continue
                n, length = _gather_patch(grey, mask, x, y, stride, patch)
                if turn == 0:
                    p = plane[y, x]
                    score[y, x] = _patch_score(
                        patch, n, length, others, a, b, x, y, p[0], p[1], p[2], stride, floor, scores
                    )
                    continue
                best = score[y, x] - pull * abs(plane[y, x, 0] - origin[y, x]) / step
                for k in range(7):
                    w, wx, wy = _candidate(plane, score, x, y, k, reach)
                    if not (w <= nearest[y, x] and w >= farthest[y, x]):
                        continue
                    s = _patch_score(patch, n, length, others, a, b, x, y, w, wx, wy, stride, floor, scores)
                    value = s - pull * abs(w - origin[y, x]) / step
                    if s > FAILED and value > best:
                        best = value
                        score[y, x] = s
                        plane[y, x, 0], plane[y, x, 1], plane[y, x, 2] = w, wx, wy


@njit(error_model="numpy", nogil=True, cache=True)
def _candidate(plane, score, x, y, k, reach):
    """The k-th plane to try at a pixel: of a neighbour (k < 4; NaN if it has none), or the pixel's own one changed."""
    height, width = score.shape
    w, wx, wy = plane[y, x, 0], plane[y, x, 1], plane[y, x, 2]
    if k < 4:
        dx, dy = (k % 2) * (2 * (k // 2) - 1), (1 - k % 2) * (2 * (k // 2) - 1)
        py, px = y + dy, x + dx
        if py < 0 or py >= height or px < 0 or px >= width or score[py, px] <= FAILED:
            return np.float32(np.nan), wx, wy
        wx, wy = plane[py, px, 1], plane[py, px, 2]
        return plane[py, px, 0] - wx * np.float32(dx) - wy * np.float32(dy), wx, wy
    if k != 5:
        w += reach * np.float32(2 * np.random.random() - 1)
    if k != 4:
        wx += np.float32(0.15) * reach * np.float32(2 * np.random.random() - 1)
        wy += np.float32(0.15) * reach * np.float32(2 * np.random.random() - 1)
    return w, wx, wy
