"""How many photos contradict a pixel of a mask: the visual hull at the resolution of the photos, without voxels.

    share(p) = min over the places x on the ray of pixel p of  max(n_out(x) - FORGIVEN, 0) / n(x)

n(x): other views with x in their frame; n_out(x): those whose mask ends more than TOLERANCE before x. If p is the
subject's, some place on its ray is the subject's in all photos: share is 0, or small where some masks are wrong.
FORGIVEN: a single view may be wrong about every place.

- Beyond the hull of all masks: share > 0, where a place that any view sees counts.
- Contradicted by many photos: a place that fewer than KNOWN of the views see is not known, and its share is 0. So a
  shoulder stays that leaves most frames.

A hull of voxels can't tell what is narrower than two of its cells: 20 pixels of 512. This one sees a strip of 3.

Source: Matusik et al., Image-based visual hulls (2000), with votes in place of an intersection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Camera
from pipeline.silhouettes import lens_radius
from pipeline.support import Support
from pipeline.transforms import inverse_rigid, matrix, rays
from stages.masks.hull_consistency import POSSIBLE
from stages.masks.region import F32, U8, Bool

TOLERANCE = 2 / 640  # of a mask's longest edge: by which contours, cameras and a breathing subject may be off
FORGIVEN = 1
KNOWN, FEWEST = 0.25, 5  # many photos: share and least number of the views that must see a place
FEW = 3  # the least number further out than POSSIBLE; with fewer, a place does not count
OUTER = 2.5  # radii of the region of interest up to which places are asked
STEP = 1 / 90  # radii between two places: twice the tolerance, where the region of interest fills a frame
SLIGHTEST = 1e-6  # share below that of one of all photos: any share above 0 will do
DOUBT = 0.02  # many photos: share up to which a pixel is the subject's
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Votes:
    """The masks of the voting views, as hull_votes_kernels reads them. numbers (V,): their places in the list of all
    views; views (V, 24), shapes (V, 2), starts (V,), outside (bytes,)."""

    numbers: I64
    views: F64
    shapes: I64
    starts: I64
    outside: U8


def votes_of(cameras: Sequence[Camera], alphas: Sequence[F32], voting: Sequence[bool]) -> Votes:
    """alphas: (h, w) each, of the camera's whole frame at any size; voting: which of them have a vote."""
    numbers = [int(n) for n in np.flatnonzero(voting)]
    parts = [_clearly_outside(alphas[n]) for n in numbers]
    shapes = np.array([p.shape for p in parts], np.int64).reshape(-1, 2)
    sizes = shapes.prod(1)
    views = np.array([_row(cameras[n], *p.shape) for n, p in zip(numbers, parts, strict=True)]).reshape(-1, 24)
    return Votes(np.array(numbers, np.int64), views, shapes, np.cumsum(sizes) - sizes,
                 np.concatenate([p.ravel() for p in parts] or [np.zeros(0, np.uint8)]))  # fmt: skip


def beyond_all(
    votes: Votes, number: int, camera: Camera, where: Bool, roi_radius: float, support: Support | None = None
) -> Bool:
    """The pixels (h, w) of `where` (h, w) beyond the hull of all masks: photos contradict each place on their rays.

    number: the view's place in the list of all views; its own mask is not asked. camera: its camera. roi_radius: asset
    units. support: the subject is above this plane.
    """
    return _share(votes, number, camera, where, roi_radius, support, _Rule(1, 1, POSSIBLE, SLIGHTEST, 0.0)) > 0


def contradicting(
    votes: Votes, number: int, camera: Camera, where: Bool, roi_radius: float, support: Support | None = None
) -> F32:
    """The share (h, w) of the views, of many photos, that contradict each pixel of `where` (h, w); exact above DOUBT, 0
    elsewhere. Arguments as above."""
    fewest = max(FEWEST, int(np.ceil(KNOWN * len(votes.numbers))))
    return _share(votes, number, camera, where, roi_radius, support, _Rule(fewest, FEW, OUTER, 1.0, DOUBT))


@dataclass(frozen=True, slots=True)
class _Rule:
    """fewest, few: views that must see a place within POSSIBLE, and further out.

    far: radii up to which places are asked. most: share above which they need not differ. enough: share at which a ray
    is done.
    """

    fewest: int
    few: int
    far: float
    most: float
    enough: float


def _share(
    votes: Votes, number: int, camera: Camera, where: Bool, roi_radius: float, support: Support | None, rule: _Rule
) -> F32:
    """share (h, w) of the pixels of `where`; 0 elsewhere, and for all where too few views have a vote."""
    from stages.masks.hull_votes_kernels import least_contradicting

    out = np.zeros(where.shape, np.float32)
    row, column = np.nonzero(where)
    if len(votes.numbers) < rule.fewest or not len(row):
        return out
    scale = np.array([camera.width / where.shape[1], camera.height / where.shape[0]])
    origin, directions = rays(matrix(camera.K), matrix(camera.world_from_cam), np.array(camera.distortion, np.float64),
                              (np.stack([column, row], -1) + 0.5) * scale)  # fmt: skip
    plane = np.zeros(4) if support is None else np.append(support.normal, support.offset)
    own = np.flatnonzero(votes.numbers == number)
    least = np.zeros(len(row))
    least_contradicting(origin, np.ascontiguousarray(directions), POSSIBLE * roi_radius, rule.far * roi_radius,
                        STEP * roi_radius, plane, votes.views, votes.shapes, votes.starts, votes.outside,
                        int(own[0]) if len(own) else -1, rule.fewest, rule.few, FORGIVEN, rule.most,
                        rule.enough, least)  # fmt: skip
    out[row, column] = least
    return out


def _clearly_outside(alpha: F32) -> U8:
    """(h, w) 1 where a pixel is further than TOLERANCE outside of the mask."""
    away = cv2.distanceTransform((alpha < 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(away > max(1.0, TOLERANCE * max(alpha.shape)), np.uint8)


def _row(camera: Camera, height: int, width: int) -> F64:
    """A camera's numbers in the order of hull_votes_kernels."""
    K = np.diag([width / camera.width, height / camera.height]) @ matrix(camera.K)[:2]
    lens = np.array(camera.distortion, np.float64)
    return np.concatenate([inverse_rigid(matrix(camera.world_from_cam))[:3].ravel(), K.ravel(), lens,
                           [lens_radius(camera) ** 2]])  # fmt: skip
