"""Feature matching: mutual nearest neighbours, then geometric verification."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
import numpy.typing as npt

from stages.poses.features import F32, Features

F64 = npt.NDArray[np.float64]
U32 = npt.NDArray[np.uint32]
Pair = tuple[int, int]

FARTHEST = 0.8  # largest distance of the unit descriptors of a match
SCOUTS = 300  # strongest features of each photo, matched first to select the pairs for a full match
NEIGHBOURS = 14  # most promising partners per photo
EXHAUSTIVE_UP_TO = 20  # photos; up to here every pair gets a full match
MIN_INLIERS = 15
EPIPOLAR_LIMIT = 1.5 / 1024  # of the photo's longest edge
REPEAT = 2 / 640  # of the longest edge: matches nearer than this at both ends count as one
RANSAC_CONFIDENCE, RANSAC_TRIALS = 0.999, 3000


@dataclass(frozen=True, slots=True)
class Verified:
    """Matches of one pair that fit a fundamental matrix. F: (3, 3), second^T F first = 0. matches: (M, 2) feature
    indices."""

    F: F64
    matches: U32


def match(a: F32, b: F32, ratio: float) -> U32:
    """(M, 2) indices into descriptors a (N, 128) and b (K, 128), unit length: mutual nearest and unambiguous.

    ratio: Lowe's ratio test; `verify` removes the remaining wrong matches.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.uint32)
    return unambiguous(a @ b.T, ratio)


def unambiguous(similarity: F32, ratio: float) -> U32:
    """(M, 2) rows and columns of cosines (N, K) of unit descriptors: mutual nearest, by Lowe's ratio test. Cosines of
    -1 are no candidates. `similarity` is overwritten."""
    best = similarity.argmax(1)
    every = np.arange(len(similarity))
    top = similarity[every, best]
    mutual = top >= similarity.max(0)[best]
    similarity[every, best] = -1
    kept = mutual & _distinct(top, similarity.max(1), ratio)
    return np.stack([every[kept], best[kept]], 1).astype(np.uint32)


def promising_pairs(
    features: Sequence[Features], ratio: float, neighbours: int = NEIGHBOURS, tick: Callable[[], None] = lambda: None,
    in_order: bool = False,
) -> list[Pair]:  # fmt: skip
    """Pairs (i < j) for a full match: each photo and its partners with the most matches of the strongest features.

    Up to EXHAUSTIVE_UP_TO photos, all pairs. in_order: the photos are frames of a video, so the next frames are always
    partners; they are half of the partners, and the other half allows loop closure. Cost: SCOUTS^2 x 128 products per
    pair, about a second for 50 photos.
    """
    n = len(features)
    if n <= EXHAUSTIVE_UP_TO:
        return list(combinations(range(n), 2))
    scouts = np.full((n, SCOUTS, 128), 0, np.float32)  # absent features are zero: never similar to anything
    for i, f in enumerate(features):
        scouts[i, : len(f.descriptors)] = f.descriptors[:SCOUTS]
    votes = np.zeros((n, n), int)
    for i in range(n - 1):
        tick()
        votes[i, i + 1 :] = votes[i + 1 :, i] = _votes(scouts[i], scouts[i + 1 :], ratio)
    following = max(1, neighbours // 4) if in_order else 0
    pairs = {(i, j) for i in range(n) for j in range(i + 1, min(i + 1 + following, n))}
    for i in range(n):
        order = [int(j) for j in np.argsort(-votes[i], kind="stable") if j != i][: neighbours - 2 * following]
        pairs |= {(min(i, j), max(i, j)) for j in order}
    return sorted(pairs)


def _votes(one: F32, others: F32, ratio: float) -> npt.NDArray[np.int64]:
    """(m,) number of mutual, unambiguous matches of (S, 128) with each of (m, S, 128)."""
    m, s = others.shape[:2]
    similarity = (one @ others.reshape(m * s, -1).T).reshape(s, m, s)
    best = similarity.argmax(2)[..., None]
    top = np.take_along_axis(similarity, best, 2)[..., 0]
    mutual = top >= np.take_along_axis(similarity.max(0), best[..., 0].T, 1).T
    np.put_along_axis(similarity, best, -1, 2)
    return np.asarray((mutual & _distinct(top, similarity.max(2), ratio)).sum(0), np.int64)


def _distinct(top: F32, second: F32, ratio: float) -> npt.NDArray[np.bool_]:
    """Lowe's ratio test and the limit on distance, from cosines; |a - b|^2 = 2 - 2 a.b for unit vectors."""
    nearest, next_nearest = (np.sqrt(np.maximum(2 - 2 * s, 0)) for s in (top, second))
    return np.asarray((nearest < ratio * next_nearest) & (nearest < FARTHEST))


def verify(
    a: Features, b: Features, matches: U32, edge: int, seed: int, least: int = MIN_INLIERS
) -> Verified | None:  # fmt: skip
    """The matches that fit one fundamental matrix (MAGSAC), or None if there are fewer than `least`.

    matches: (M, 2). edge: longest edge of the photos in pixels. Deterministic: the sampler is seeded.
    """
    if len(matches) < least:
        return None
    parameters = cv2.UsacParams()
    parameters.confidence, parameters.maxIterations = RANSAC_CONFIDENCE, RANSAC_TRIALS
    parameters.threshold = EPIPOLAR_LIMIT * edge
    parameters.randomGeneratorState = seed
    parameters.isParallel = False
    parameters.score, parameters.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    parameters.loMethod, parameters.loIterations = cv2.LOCAL_OPTIM_SIGMA, 5
    parameters.final_polisher = cv2.MAGSAC
    uv_a, uv_b = a.uv[matches[:, 0]], b.uv[matches[:, 1]]
    try:
        F, inliers = cv2.findFundamentalMat(uv_a, uv_b, parameters)
    except cv2.error:  # USAC's polisher asserts on some degenerate samples: such a pair is not used
        return None
    if F is None or F.shape != (3, 3) or inliers is None or int(inliers.sum()) < least:
        return None
    return Verified(np.asarray(F, np.float64), matches[inliers.ravel() > 0])


def without_repeats(pair: Verified, a: Features, b: Features, cell: float) -> Verified:
    """One match for each pair of positions: a spot is detected under several tilts. cell: pixels."""
    at = np.concatenate([a.uv[pair.matches[:, 0]], b.uv[pair.matches[:, 1]]], 1)
    _, first = np.unique(np.floor(at / cell), axis=0, return_index=True)
    return Verified(pair.F, pair.matches[np.sort(first)])


def joined(one: Mapping[Pair, Verified], other: Mapping[Pair, Verified], counts: Sequence[int]) -> dict[Pair, Verified]:
    """The union of two sets of matches; feature indices of `other` are shifted by counts[i], the number of features of
    photo i in `one`."""
    out = dict(one)
    for (i, j), pair in other.items():
        moved = pair.matches + np.array([counts[i], counts[j]], np.uint32)
        known = one.get((i, j))
        F = pair.F if known is None or len(pair.matches) > len(known.matches) else known.F
        out[i, j] = Verified(F, moved if known is None else np.concatenate([known.matches, moved]))
    return out


def homography_share(a: Features, b: Features, pair: Verified, edge: int, seed: int) -> float:
    """Share of a pair's matches that fit one homography: all, if the camera only rotated or the scene is flat. edge:
    longest edge of the photos in pixels."""
    cv2.setRNGSeed(seed)
    uv_a, uv_b = a.uv[pair.matches[:, 0]], b.uv[pair.matches[:, 1]]
    _, inliers = cv2.findHomography(uv_a, uv_b, cv2.RANSAC, 1.5 * EPIPOLAR_LIMIT * edge, None, RANSAC_TRIALS)
    return 0.0 if inliers is None else float(inliers.mean())
