"""How well a camera agrees with a model of other photos: its matches against those that chance gives.

At the right pose features of a photo lie where the model's points project, and look like them. At a wrong pose some
do so by chance. How many is measured with the same points, displaced in the picture by a few percent of its size, so
that no limit depends on how many features, or how much texture, a capture has:

    score = (n - m) / sqrt(m + 1)        n: matches at the pose, m: mean of the displaced ones

What right and wrong poses had on real and made-up captures: docs/stages/poses.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.transforms import F64, inverse_rigid, project
from stages.poses.detect import Photo
from stages.poses.features import Features
from stages.poses.mapper import Model, Pose

I64 = npt.NDArray[np.int64]
NEAREST = 5  # photos of the model, by direction, whose features a photo is compared with
ALIKE = 0.75  # largest distance of the unit descriptors
LIMIT = 3 / 856  # of the photo's longest edge: distance of a feature from the projected point
SPOT = 4 / 856  # of the longest edge: features nearer than this count as one
SHIFTS = tuple((r * np.cos(t), r * np.sin(t)) for r in (0.03, 0.06) for t in np.arange(8) * np.pi / 4)
MIN_OTHERS = 2  # photos besides the judged one that must see a point


@dataclass(frozen=True, slots=True)
class Agreement:
    """matches: places of the photo with a match. chance: the same for displaced points, mean."""

    matches: int
    chance: float

    @property
    def score(self) -> float:
        """Standard deviations above chance, were the number of chance matches Poisson distributed."""
        return float((self.matches - self.chance) / np.sqrt(self.chance + 1))


@dataclass(frozen=True, slots=True)
class Judged:
    """The photo: its features, width and height in pixels, and its number in the model, which may not have it."""

    features: Features
    size: tuple[int, int]
    number: int
    tree: cKDTree = field(init=False)  # of the features' pixels

    def __post_init__(self) -> None:
        object.__setattr__(self, "tree", cKDTree(self.features.uv))

    def uv(self, matches: I64) -> F64:
        """(L, 2) pixels of the features in the first column of `matches`."""
        return np.asarray(self.features.uv[matches[:, 0]], np.float64)


def judged(number: int, photos: Sequence[Photo], features: Sequence[Features]) -> Judged:
    """The photo with this number."""
    return Judged(features[number], (photos[number].width, photos[number].height), number)


class Points:
    """The points of a model with the features that show them."""

    def __init__(self, model: Model, features: Sequence[Features]) -> None:
        """features: of every photo of the model."""
        self.model, self.features = model, features

    def seen_near(self, pose: Pose, without: int) -> list[tuple[int, I64]]:
        """The NEAREST photos by direction, other than `without`, and (L, 2) their features and points; only points that
        MIN_OTHERS photos besides `without` see."""
        own = np.zeros(len(self.model.points))
        if without in self.model.seen:
            own[self.model.seen[without][:, 1]] = 1
        others = [j for j in self.model.poses if j != without]
        towards = pose.world_from_cam[:3, 2]
        others.sort(key=lambda j: (-float(self.model.poses[j].world_from_cam[:3, 2] @ towards), j))
        enough = self.model.track - own >= MIN_OTHERS
        return [(j, self.model.seen[j][enough[self.model.seen[j][:, 1]]]) for j in others[:NEAREST]]

    def matches(self, photo: Judged, pose: Pose, limit: float) -> I64:
        """(L, 2) features of the photo and points of the model that lie within `limit` pixels of each other at this
        pose, look alike, and are mutual nearest."""
        return self._matched(photo, self._projected(photo, pose), limit, (0.0, 0.0))

    def agreement(self, photo: Judged, pose: Pose) -> Agreement:
        """Of this photo with a camera at this pose, by points that it has no part in."""
        edge, projected = max(photo.size), self._projected(photo, pose)
        counts = [_spots(photo.features, self._matched(photo, projected, LIMIT * edge, (x * edge, y * edge)), edge)
                  for x, y in ((0.0, 0.0), *SHIFTS)]  # fmt: skip
        return Agreement(counts[0], float(np.mean(counts[1:])))

    def _projected(self, photo: Judged, pose: Pose) -> list[tuple[int, I64, F64]]:
        """What `seen_near` gives, with the points' pixels (L, 2) in the photo, NaN behind the camera."""
        lens = pose.K, inverse_rigid(pose.world_from_cam), np.array(pose.distortion)
        near = self.seen_near(pose, photo.number)
        return [(j, seen, project(*lens, self.model.points[seen[:, 1]])[0]) for j, seen in near]

    def _matched(
        self, photo: Judged, projected: Sequence[tuple[int, I64, F64]], limit: float, shift: tuple[float, float]
    ) -> I64:
        """As `matches`, with the points displaced by `shift` pixels; those that leave the picture have no match."""
        found = [np.zeros((0, 2), np.int64)]
        for j, seen, uv in projected:
            moved = uv + np.array(shift)
            inside = ((moved >= 0) & (moved < photo.size)).all(1)
            rows, own = _within(np.where(inside[:, None], moved, np.inf), photo.tree, limit)
            alike = np.einsum("nd,nd->n", self.features[j].descriptors[seen[rows, 0]], photo.features.descriptors[own])
            kept = _mutual(rows, own, alike) & (alike >= 1 - ALIKE**2 / 2)
            found.append(np.stack([own[kept], seen[rows[kept], 1]], 1))
        return np.unique(np.concatenate(found), axis=0)


def _within(a: F64, tree: cKDTree, limit: float) -> tuple[I64, I64]:
    """Indices (K,), in ascending order, of all pairs of a (N, 2) and of the tree's points (M, 2) that are within
    `limit` of each other; infinite rows have none."""
    finite = np.nonzero(np.isfinite(a).all(1))[0]
    if not len(finite) or not tree.n:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    pairs = cKDTree(a[finite]).sparse_distance_matrix(tree, limit, output_type="ndarray")
    rows, columns = finite[pairs["i"]], np.asarray(pairs["j"], np.int64)
    order = np.lexsort((columns, rows))
    return rows[order], columns[order]


def _mutual(rows: I64, columns: I64, alike: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """(K,) whether an entry of a sparse matrix is the largest of its row and of its column; of equal ones the first."""
    out = np.ones(len(rows), bool)
    for group in (rows, columns):
        order = np.lexsort((np.arange(len(rows)), -alike, group))
        first = np.ones(len(rows), bool)
        first[order[1:]] = group[order[1:]] != group[order[:-1]]
        out &= first
    return out


def _spots(features: Features, matches: I64, edge: int) -> int:
    """Number of different places of the matched features."""
    return len(np.unique(np.floor(features.uv[matches[:, 0]] / (SPOT * edge)), axis=0))
