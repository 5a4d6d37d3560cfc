"""Check of given cameras against the photos: matches of neighbouring photos must satisfy the epipolar constraint.

Symbols: x_i (N, 2) undistorted positions on camera i's plane z = 1; E the essential matrix of two cameras,
(x_j, 1)^T E (x_i, 1) = 0 for the same point. Only pairs are used whose matches fit some fundamental matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence, Set
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.transforms import F64, inverse_rigid, matrix, undistort
from stages.poses.features import PLAIN, Features, detect, grey8
from stages.poses.matching import match, verify

EDGE, FEATURES = 400, 600  # pixels, number: fast, and the reduction averages noise
PARTNERS = 4  # photos that each is compared with
FAR = 0.01  # of the longest edge: largest distance of a consistent match from its epipolar line
IMPERFECT = 0.03  # the same for inexact cameras that are refined afterwards
AGREE = 0.3  # smallest share of consistent matches of a correct view
MIN_MATCHES = 20  # fewest matches of a view over all its pairs for a decision


@dataclass(frozen=True, slots=True)
class Verdict:
    """share: (N,) consistent matches of each view, NaN if it has too few matches."""

    share: F64

    @property
    def wrong(self) -> list[int]:
        """Indices of views whose photo contradicts its camera."""
        return [int(i) for i in np.flatnonzero(self.share < AGREE)]

    @property
    def known(self) -> int:
        """Number of views with enough matches."""
        return int(np.isfinite(self.share).sum())


def check_cameras(
    cameras: Sequence[Camera], features: Sequence[Features], seed: int, tick: Callable[[int, int], None],
    far: float = FAR, held: Set[int] = frozenset(),
) -> Verdict:  # fmt: skip
    """Compare each view with its nearest ones. The worst view is excluded first, with its pairs, so that it does not
    make its neighbours look wrong. tick: done, total. far: as a share of the longest edge, see FAR. held: views that
    are held out; they are compared with the others that are right, and say nothing about these."""
    pairs = near_pairs(cameras, held)
    counts: dict[tuple[int, int], tuple[int, int]] = {}
    for n, (i, j) in enumerate(pairs):
        tick(n, len(pairs))
        found = match(features[i].descriptors, features[j].descriptors, PLAIN.ratio)
        edge = max(cameras[i].width, cameras[i].height)
        pair = verify(features[i], features[j], found, edge, seed)
        if pair is None:
            continue
        uv_i = np.asarray(features[i].uv[pair.matches[:, 0]], np.float64)
        uv_j = np.asarray(features[j].uv[pair.matches[:, 1]], np.float64)
        good = epipolar_pixels(cameras[i], cameras[j], uv_i, uv_j) < far * edge
        counts[i, j] = (int(good.sum()), len(good))
    share = _shares({p: c for p, c in counts.items() if held.isdisjoint(p)}, len(cameras))
    right = {i for i in range(len(cameras)) if share[i] >= AGREE}
    for view in held:
        share[view] = _share(c for p, c in counts.items() if view in p and right.intersection(p))
    return Verdict(share)


class Picture(Protocol):
    """A photo for feature detection: see stages.poses.photos.StoredPhoto."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    def pixels(self) -> npt.NDArray[np.generic]: ...

    def inside(self) -> npt.NDArray[np.float32] | None: ...


def features_of(photos: Sequence[Picture], tick: Callable[[int, int], None]) -> list[Features]:
    """Features of every photo; with a mask, on the subject only. tick: done, total."""
    found = []
    for n, photo in enumerate(photos):
        tick(n, len(photos))
        grey, alpha = grey8(photo.pixels(), EDGE), photo.inside()
        inside = None
        if alpha is not None:
            small = np.asarray(cv2.resize(alpha, grey.shape[::-1], interpolation=cv2.INTER_AREA))
            inside = (small > 0.5).astype(np.uint8)
        found.append(detect(grey, (photo.width, photo.height), FEATURES, PLAIN, inside))
    return found


def near_pairs(cameras: Sequence[Camera], held: Set[int] = frozenset()) -> list[tuple[int, int]]:
    """Pairs of each view with the PARTNERS fitted views of the most similar direction, first < second."""
    axes = np.stack([matrix(c.world_from_cam)[:3, 2] for c in cameras])
    likeness = axes @ axes.T
    np.fill_diagonal(likeness, -np.inf)
    likeness[:, sorted(held)] = -np.inf
    order = np.argsort(-likeness, axis=1, kind="stable")[:, :PARTNERS]
    found = {(i, int(j)) for i, row in enumerate(order) for j in row if np.isfinite(likeness[i, j])}
    return sorted({(min(p), max(p)) for p in found})


def epipolar_pixels(a: Camera, b: Camera, uv_a: F64, uv_b: F64) -> F64:
    """(N,) Sampson distances in pixels of matches uv_a, uv_b (N, 2) under the two cameras."""
    b_from_a = inverse_rigid(matrix(b.world_from_cam)) @ matrix(a.world_from_cam)
    R, t = b_from_a[:3, :3], b_from_a[:3, 3]
    E = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ R
    x_a, x_b = _on_plane(a, uv_a), _on_plane(b, uv_b)
    line_b, line_a = x_a @ E.T, x_b @ E
    value = np.abs((x_b * line_b).sum(1))
    norm = np.sqrt((line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1))
    return np.asarray(value / np.maximum(norm, 1e-15) * np.sqrt(a.K[0][0] * b.K[0][0]), np.float64)


def _on_plane(camera: Camera, uv: F64) -> F64:
    """(N, 3) undistorted positions on the plane z = 1 of pixels uv (N, 2)."""
    K = matrix(camera.K)
    flat = np.asarray(np.linalg.solve(K[:2, :2], (uv - K[:2, 2]).T).T, np.float64)
    xy = undistort(flat, np.array(camera.distortion, np.float64))
    return np.concatenate([xy, np.ones((len(xy), 1))], 1)


def _share(counts: Iterable[tuple[int, int]]) -> float:
    """Share of consistent matches over pairs of (consistent, all); NaN if all are fewer than MIN_MATCHES."""
    good, every = np.sum([(0, 0), *counts], axis=0)
    return float(good / every) if every >= MIN_MATCHES else float("nan")


def _shares(counts: dict[tuple[int, int], tuple[int, int]], views: int) -> F64:
    """(views,) share of consistent matches; the worst view is excluded before its neighbours are judged again. counts:
    consistent matches and all matches of each pair."""
    out, left = np.full(views, np.nan), dict(counts)
    while True:
        good, every = np.zeros(views), np.zeros(views)
        for (i, j), (g, n) in left.items():
            for k in (i, j):
                good[k] += g
                every[k] += n
        share = np.where(every >= MIN_MATCHES, good / np.maximum(every, 1), np.nan)
        fresh = np.isnan(out) | (out >= AGREE)
        out = np.where(fresh & np.isfinite(share), share, out)
        if not np.isfinite(share).any() or np.nanmin(share) >= AGREE:
            return out
        worst = int(np.nanargmin(share))
        left = {pair: c for pair, c in left.items() if worst not in pair}
