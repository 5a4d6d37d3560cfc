"""How far a solution of structure from motion can be trusted, from what it says alone.

The mapper draws its first pair and its samples at random. Once in about twenty runs a draw leads astray: on one
capture it placed 34 of 44 photos with half of the true focal length, where other seeds place 43. The solution itself
shows that, and another seed costs seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.errors import StageError
from pipeline.transforms import F64
from stages.poses.normalise import nearest_point

if TYPE_CHECKING:
    from stages.poses.mapper import Model

GOOD_SCORE = 0.9  # below this a solution is doubted, and more effort is worth its time
FOCAL_OFF = (
    1.25  # times; EXIF rounds, crops and ignores the focus: right solutions were up to 1.06 off, a stray one 1.7
)
FOCAL_RANGE = (0.4, 10.0)  # of the longest edge, where EXIF is silent: 14 mm to 360 mm lenses on full frame
POINTS_PER_PHOTO = 10  # on the subject; right solutions have 25 to 120
ERROR_LIMIT = 2.0  # pixels; the mapper throws points of more than 4 away, right solutions have 0.3 to 1
SUBJECT = 0.5  # of the cameras' mean distance from where they look: points nearer to that place are on the subject


class Known(Protocol):
    """What is known of a photo before it is placed."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def focal(self) -> float | None: ...


@dataclass(frozen=True, slots=True)
class Quality:
    """placed: share of the photos. focal_off: how many times the lenses are longer or shorter than EXIF says, or than
    lenses are, median over the photos. points: on the subject, per placed photo. error_px: mean reprojection error."""

    placed: float
    focal_off: float
    points: float
    error_px: float

    @property
    def trust(self) -> float:
        """1 where nothing but missing photos speaks against it, towards 0 the more does."""
        off = min(1.0, FOCAL_OFF / self.focal_off) * min(1.0, self.points / POINTS_PER_PHOTO)
        return off * min(1.0, ERROR_LIMIT / max(self.error_px, 1e-9))

    @property
    def score(self) -> float:
        """Share of the photos placed, times the trust in it: what solutions are compared by."""
        return self.placed * self.trust


def quality(model: Model, photos: Sequence[Known]) -> Quality:
    """The figures of a solution of `photos`."""
    return Quality(
        placed=len(model.poses) / len(photos),
        focal_off=float(np.median([_focal_off(p.K, photos[i]) for i, p in model.poses.items()])),
        points=_on_subject(model) / max(len(model.poses), 1),
        error_px=model.reprojection_error_px,
    )


def score(model: Model | None, photos: Sequence[Known]) -> float:
    """Of a solution, or of none."""
    return 0.0 if model is None else quality(model, photos).score


def better(a: Model | None, b: Model | None, photos: Sequence[Known]) -> Model | None:
    """The one with the higher score, of equal ones the one with more points, else the first."""
    if a is None or b is None:
        return b if a is None else a
    ranks = [(round(score(m, photos), 6), len(m.points)) for m in (a, b)]
    return b if ranks[1] > ranks[0] else a


def _focal_off(K: F64, photo: Known) -> float:
    found = float(K[0, 0])
    if photo.focal is not None:
        return max(found / photo.focal, photo.focal / max(found, 1e-9))
    least, most = (r * max(photo.width, photo.height) for r in FOCAL_RANGE)
    return max(1.0, found / most, least / max(found, 1e-9))


def _on_subject(model: Model) -> int:
    """Points near where the cameras look."""
    poses = np.stack([p.world_from_cam for p in model.poses.values()])
    centres = poses[:, :3, 3]
    try:
        middle = nearest_point(centres, poses[:, :3, 2])
    except StageError:  # they look in parallel directions
        return 0
    reach = SUBJECT * float(np.linalg.norm(centres - middle, axis=1).mean())
    return int((np.linalg.norm(model.points.reshape(-1, 3) - middle, axis=1) < reach).sum())
