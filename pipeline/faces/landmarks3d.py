"""3D face landmarks, triangulated from photos, and the head's axes computed from them.

Symbols: N photos, L = 468 landmarks; uv (N, L, 2) pixels; x_l (3,) landmarks in the cameras' world; r_nl the distance
in pixels between x_l projected into photo n and uv_nl, over the face's size in that photo.

Each pair of photos gives a hypothesis of the face; the one with which most photos agree is used (RANSAC over all pairs,
or an evenly spaced subset, without randomness). Each landmark is then the point nearest to the rays of the photos that
agree, with weights that fall with the residual (Cauchy), because landmarks on a hidden cheek are guessed.

    x_l = argmin sum_n w_nl / d_n^2 |(1 - a a^T)(x - c_n)|^2,    w_nl = 1 / (1 + (r_nl / s)^2)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.transforms import inverse_rigid, matrix, project, rays

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

MIN_PHOTOS = 3  # fewer can agree by chance
MET = 0.06  # of the face's size in a photo: a larger median residual means another face, or none
SOFT = 0.02  # s: the network's own scatter on sharp frontal photos is about 1 % of the face
ROUNDS = 10
MAX_PAIRS = 150
SPREAD = 2.8  # size of a face over the median distance of its landmarks from their mean
WIDE = np.radians(4.0)  # least angle between the rays of two photos to determine the depth of the face
TOP, CHIN = 10, 152  # upper end of the forehead and lower end of the chin, in the middle
SIDES = ((33, 263), (133, 362), (61, 291), (127, 356), (234, 454), (58, 288))  # right and left landmark of each pair


@dataclass(frozen=True, slots=True)
class Landmarks:
    """xyz: (L, 3) in the cameras' world. error_px: (N,) median over the landmarks of a photo, infinite behind the
    camera. kept: (N,) photos that agree."""

    xyz: F64
    error_px: F64
    kept: Bool


@dataclass(frozen=True, slots=True)
class HeadFrame:
    """axes: (3, 3) rows to the person's left, up, to the front. eyes, chin, top: (3,); height: from chin to top."""

    axes: F64
    eyes: F64
    chin: F64
    top: F64

    @property
    def height(self) -> float:
        """From the chin to the top of the forehead: about 0.8 of the whole head."""
        return float(np.linalg.norm(self.top - self.chin))


@dataclass(frozen=True, slots=True)
class _Sights:
    """Rays of all photos: centres (N, 3), directions (N, L, 3), and the cameras' data for projection."""

    cameras: Sequence[Camera]
    uv: F64
    centre: F64
    direction: F64

    @property
    def focal(self) -> F64:
        """(N,)"""
        return np.array([np.sqrt(c.K[0][0] * c.K[1][1]) for c in self.cameras])


def triangulate(cameras: Sequence[Camera], uv: F64) -> Landmarks | None:
    """The face on which most photos agree. uv: (N, L, 2). None if fewer than MIN_PHOTOS agree on one."""
    if len(cameras) < MIN_PHOTOS:
        return None
    found = [rays(matrix(c.K), matrix(c.world_from_cam), np.array(c.distortion), p)
             for c, p in zip(cameras, np.asarray(uv, np.float64), strict=True)]  # fmt: skip
    seen = _Sights(cameras, np.asarray(uv, np.float64), np.stack([o for o, _ in found]),
                   np.stack([d for _, d in found]))  # fmt: skip
    best = _best_pair(seen)
    if best is None:
        return None
    kept = best
    xyz = _points(seen, np.where(kept[:, None], 1.0, 0.0) * np.ones(seen.uv.shape[:2]))
    for _ in range(ROUNDS):
        off = residuals(seen.cameras, seen.uv, xyz) / _size(seen, xyz)[:, None]
        kept = np.median(off, 1) <= MET
        if kept.sum() < MIN_PHOTOS:
            return None
        xyz = _points(seen, np.where(kept[:, None] & np.isfinite(off), 1 / (1 + (off / SOFT) ** 2), 0.0))
    error = np.median(residuals(seen.cameras, seen.uv, xyz), 1)
    kept = error <= MET * _size(seen, xyz)
    plausible = np.isfinite(xyz).all() and _parted(seen, np.flatnonzero(kept)) and kept.sum() >= MIN_PHOTOS
    return Landmarks(xyz, error, kept) if plausible else None


def residuals(cameras: Sequence[Camera], uv: F64, xyz: F64) -> F64:
    """(N, L) pixels between landmarks uv (N, L, 2) and projections of xyz (L, 3); infinite behind the camera."""
    out = []
    for c, at in zip(cameras, uv, strict=True):
        seen, z = project(matrix(c.K), inverse_rigid(matrix(c.world_from_cam)), np.array(c.distortion), xyz)
        off = np.linalg.norm(seen - at, axis=1)
        out.append(np.where((z > 0) & np.isfinite(off), off, np.inf))
    return np.stack(out)


def _best_pair(seen: _Sights) -> Bool | None:
    """(N,) photos that agree with the best pair of photos: most photos, with small residuals."""
    pairs = [p for p in combinations(range(len(seen.cameras)), 2) if _parted(seen, np.array(p))]
    pairs = pairs[:: -(-len(pairs) // MAX_PAIRS)] if pairs else []
    few = np.linspace(0, seen.uv.shape[1] - 1, min(seen.uv.shape[1], 32)).astype(int)
    some = _Sights(seen.cameras, seen.uv[:, few], seen.centre, seen.direction[:, few])
    best: tuple[float, Bool] | None = None
    for pair in pairs:
        weight = np.zeros(some.uv.shape[:2])
        weight[list(pair)] = 1
        xyz = _points(some, weight)
        off = np.median(residuals(some.cameras, some.uv, xyz), 1) / _size(some, xyz)
        agree = off <= 1.5 * MET  # a face from only two photos is less accurate
        score = float((1 - (off[agree] / (1.5 * MET)) ** 2).sum())
        if agree.sum() >= MIN_PHOTOS and (best is None or score > best[0]):
            best = score, agree
    return None if best is None else best[1]


def _parted(seen: _Sights, which: npt.NDArray[np.integer]) -> bool:
    """Whether the mean rays of two of the photos differ by at least WIDE."""
    middle = seen.direction[which].mean(1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return bool(len(which) > 1 and (middle @ middle.T).min() <= np.cos(WIDE))


def _size(seen: _Sights, xyz: F64) -> F64:
    """(N,) approximate size of the face in each photo, pixels: from its 3D points or from its landmarks in the photo,
    the smaller one, so that neither wrong landmarks nor scattered points can raise their own tolerance."""
    middle = np.median(xyz, 0)
    radius = float(np.median(np.linalg.norm(xyz - middle, axis=1)))
    distance = np.linalg.norm(seen.centre - middle, axis=1)
    projected = radius * seen.focal / np.maximum(distance, 1e-12)
    shown = np.median(np.linalg.norm(seen.uv - np.median(seen.uv, 1, keepdims=True), axis=2), 1)
    return np.asarray(SPREAD * np.minimum(projected, shown), np.float64)


def _points(seen: _Sights, weight: F64) -> F64:
    """(L, 3) points nearest to the rays, with weights (N, L); NaN where the rays of a landmark are nearly parallel."""
    a = seen.direction
    across = np.eye(3) - a[..., :, None] * a[..., None, :]
    start = np.einsum("nl,nlij->lij", weight, across)
    middle = np.einsum("nl,nlij,nj->li", weight, across, seen.centre)
    first = _solved(start, middle)
    # in pixels, not metres: the same error is smaller in the photo of a distant camera
    distance = np.linalg.norm(seen.centre[:, None] - np.nan_to_num(first), axis=2)
    w = weight / np.maximum(distance, 1e-9) ** 2 * seen.focal[:, None] ** 2
    return _solved(np.einsum("nl,nlij->lij", w, across), np.einsum("nl,nlij,nj->li", w, across, seen.centre))


def _solved(A: F64, b: F64) -> F64:
    """(L, 3) A^-1 b, NaN where A is nearly singular."""
    scale = np.maximum(np.trace(A, axis1=1, axis2=2), 1e-300)
    normed = A / scale[:, None, None]
    good = np.linalg.eigvalsh(normed)[:, 0] > 1e-6
    out = np.full(b.shape, np.nan)
    out[good] = np.linalg.solve(normed[good], (b[good] / scale[good, None])[..., None])[..., 0]
    return out


def head_frame(xyz: F64) -> HeadFrame:
    """The head's axes from its landmarks (L, 3)."""
    right, left = (xyz[[pair[k] for pair in SIDES]] for k in range(2))
    x = (left - right).sum(0)
    x /= np.linalg.norm(x)
    y = xyz[TOP] - xyz[CHIN]
    y = y - (y @ x) * x
    y /= np.linalg.norm(y)
    eyes = xyz[[33, 133, 263, 362]].mean(0)
    return HeadFrame(np.stack([x, y, np.cross(x, y)]), eyes, xyz[CHIN], xyz[TOP])


def off_frame(frame: HeadFrame, left_up_front: F64 | None = None) -> float:
    """Angle in degrees between the head's front or up direction (the larger one) and that of a frame (default: that of
    asset coordinates)."""
    wanted = np.eye(3) if left_up_front is None else left_up_front
    cosine = np.einsum("ij,ij->i", frame.axes[1:], wanted[1:]).clip(-1, 1)
    return float(np.degrees(np.arccos(cosine)).max())


def load_landmarks(path: Path) -> F64:
    """xyz (468, 3) of the file MaskSet.landmarks."""
    with np.load(path, allow_pickle=False) as data:
        return np.asarray(data["xyz"], np.float64)


def photos_of_face(path: Path) -> tuple[int, ...]:
    """Indices of the photos that agree on the face, of the file MaskSet.landmarks."""
    with np.load(path, allow_pickle=False) as data:
        return tuple(int(i) for i in np.asarray(data["views"])[np.asarray(data["kept"], np.bool_)])
