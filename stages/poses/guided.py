"""Guided matching: matches along the epipolar lines of cameras that are known (Hartley, Zisserman, Multiple View
Geometry, 2004, section 11.6).

Without cameras a match must stand out among all features of the other photo. With cameras only a narrow band around a
line is left to choose from, so that five to ten times as many features find their partner.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from pipeline.transforms import F64, inverse_rigid, undistort
from stages.poses.detect import WORKERS, Photo
from stages.poses.features import Features
from stages.poses.mapper import Pose
from stages.poses.matching import EPIPOLAR_LIMIT, REPEAT, U32, Pair, Verified, unambiguous, without_repeats

RATIO = 0.8  # of the nearest to the second nearest descriptor within the band
WIDEST = 40.0  # degrees between the viewing directions of two photos: beyond that SIFT finds no partners
PARTNERS = 14  # photos nearest in direction that each photo is matched with
FEWEST = 15  # matches of a pair; fewer are left out
SAME_PLACE = 1e-9  # distance of two centres, as a share of their coordinates
ROWS = 256  # features of a block


def fundamental(a: Pose, b: Pose) -> F64:
    """(3, 3) F with x_b^T F x_a = 0 for pixels of one point in both photos, without distortion. Its norm is 1.

    Raises:
        ValueError: both photos were taken from one place.
    """
    moved = inverse_rigid(b.world_from_cam) @ a.world_from_cam
    t = moved[:3, 3]
    if not np.linalg.norm(t) > SAME_PLACE * max(np.abs(p.world_from_cam[:3, 3]).max() for p in (a, b)):
        raise ValueError("the two photos have the same camera centre: there are no epipolar lines")
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(b.K).T @ cross @ moved[:3, :3] @ np.linalg.inv(a.K)
    return np.asarray(F / np.linalg.norm(F), np.float64)


def straight(features: Features, pose: Pose) -> Features:
    """The features where a lens without distortion would show them."""
    K = pose.K
    xy = (np.asarray(features.uv, np.float64) - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
    uv = undistort(xy, np.array(pose.distortion)) @ K[:2, :2].T + K[:2, 2]
    return Features(uv.astype(np.float32), features.descriptors)


def guided(a: Features, b: Features, F: F64, limit: float, ratio: float = RATIO) -> U32:
    """(M, 2) indices: mutual nearest descriptors, unambiguous among all features within `limit` pixels of the epipolar
    line, in both photos. F: `fundamental`; a, b: without distortion."""
    if len(a.uv) < 2 or len(b.uv) < 2:
        return np.zeros((0, 2), np.uint32)
    one, other = (np.concatenate([f.uv, np.ones((len(f.uv), 1))], 1) for f in (a, b))
    lines_b, lines_a = one @ F.T, other @ F
    near_b, near_a = (limit * np.hypot(n[:, 0], n[:, 1]) for n in (lines_b, lines_a))
    similarity = a.descriptors @ b.descriptors.T
    for start in range(0, len(one), ROWS):  # in blocks, which stay in the processor's cache
        rows = slice(start, start + ROWS)
        product = np.abs(lines_b[rows] @ other.T)  # distance from a line, times the length of the line's normal
        similarity[rows][(product > near_b[rows, None]) | (product > near_a)] = -1
    return unambiguous(similarity, ratio)


def near_pairs(poses: Mapping[int, Pose], partners: int = PARTNERS) -> list[Pair]:
    """Pairs (i < j) of photos with a camera: each with its `partners` nearest ones in direction, up to WIDEST."""
    numbers = sorted(poses)
    views = np.stack([poses[i].world_from_cam[:3, 2] for i in numbers])
    angles = np.degrees(np.arccos(np.clip(views @ views.T, -1, 1)))
    pairs = set()
    for n, i in enumerate(numbers):
        order = [int(m) for m in np.argsort(angles[n], kind="stable") if m != n][:partners]
        pairs |= {(min(i, numbers[m]), max(i, numbers[m])) for m in order if angles[n, m] <= WIDEST}
    return sorted(pairs)


def guided_pairs(
    poses: Mapping[int, Pose], photos: Sequence[Photo], features: Sequence[Features], pairs: Sequence[Pair],
    tick: Callable[[], None], widened: float = 1.0,
) -> dict[Pair, Verified]:  # fmt: skip
    """Guided matches of these pairs of photos with a camera; pairs with fewer than FEWEST, or from one place, are left
    out. tick: called before each pair; raises to stop. widened: factor of the band, for cameras that are less exact."""
    without = {i: straight(features[i], poses[i]) for i in sorted({i for p in pairs for i in p})}

    def one(pair: Pair) -> Verified | None:
        i, j = pair
        edge = max(photos[i].width, photos[i].height, photos[j].width, photos[j].height)
        try:
            F = fundamental(poses[i], poses[j])
        except ValueError:
            return None
        found = Verified(F, guided(without[i], without[j], F, widened * EPIPOLAR_LIMIT * edge))
        once = without_repeats(found, features[i], features[j], REPEAT * edge)
        return once if len(once.matches) >= FEWEST else None

    out = {}
    with ThreadPoolExecutor(WORKERS) as pool:
        tasks = [(p, pool.submit(one, p)) for p in pairs]
        try:
            for pair, task in tasks:
                tick()
                found = task.result()
                if found is not None:
                    out[pair] = found
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return out
