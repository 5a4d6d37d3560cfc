"""From the capture's world to asset coordinates: centre, axes, scale and the radius of the region of interest.

Symbols: N cameras; world_from_cam (N, 4, 4) rigid, OpenCV axes; c camera centres (N, 3); a unit rays through the
frames' centres (N, 3); roi = region of interest, the ball that the cameras look at. Asset coordinates: right-handed,
+Y up, origin = centre of the region of interest, metres (nominal if the scale is unknown).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.faces.landmarks3d import HeadFrame, off_frame
from pipeline.support import find_support, is_level
from pipeline.transforms import F64, matrix, rays, similarity
from stages.poses.scale import Eyes, Scale

NOMINAL_ROI = 0.18  # metres: a head with some space around it
NOMINAL = f"unknown: the region of interest gets a nominal radius of {NOMINAL_ROI} m"
PLAUSIBLE_ROI = (0.05, 0.6)  # metres, for a head
UNITS = {"metres": 1.0, "centimetres": 1e-2, "millimetres": 1e-3}
Unit = Literal["guess", "unknown", "metres", "centimetres", "millimetres"]
ONE_SPOT = 0.02  # smallest spread of the cameras relative to their distance: less gives no depth
LEVEL = 0.7  # smallest horizontal share of the eyes' distance: a head that lies on its side gives no front
FACE_OFF = 10.0  # degrees: a given world is unchanged if the face differs less from upright and +Z
UP_LIMIT = np.cos(np.radians(45.0))
UPRIGHT = np.cos(np.radians(30.0))  # between a head's up direction and that of the floor under it
POINTS_WITHIN, POINTS_MARGIN = 0.95, 1.2  # share of the points inside the radius; margin, as a factor
POINTS_SHRINK = 0.95  # of the frames' radius, lower limit: hair and bald heads have few points, and must stay inside
POINTS_TAIL, SHIFT_LIMIT = 0.02, 0.12  # share of weight beyond the range; of the radius
MIN_POINTS = 50
ROBUST_STEPS = 30
AROUND = 2.5  # radii within which the support plane is searched


@dataclass(frozen=True, slots=True)
class Normalisation:
    """capture_from_asset: (4, 4) similarity. roi_radius: asset units, around the origin. metric: units are metres.
    scale: source of the unit, as text."""

    capture_from_asset: F64
    roi_radius: float
    metric: bool
    scale: str
    warnings: tuple[str, ...]


def normalise(
    cameras: Sequence[Camera], points: F64 | None = None, *, given: bool, unit: Unit = "guess",
    known: Scale | None = None, eyes: Eyes | None = None, axes: F64 | None = None, head: HeadFrame | None = None,
    guess: Callable[[], Scale | None] = lambda: None,
) -> Normalisation:  # fmt: skip
    """Asset coordinates for cameras whose `world_from_cam` is in the capture's world.

    points: (M, 3) sparse points or None. given: given cameras; the axes and the unit of their world are kept if
    plausible. unit: of a given world; guess: the one that gives the subject a head's size. known: a known scale, used
    instead of both. eyes: in a solved world; the subject then looks along +Z. axes: (3, 3) asset_from_capture of a
    given world, if known. head: the subject is then upright and looks along +Z, unless `axes` is given. guess: a
    plausible scale where none is known; the unit still counts as
    unknown. Raises StageError if the cameras do not look at a common point, or are all in one spot.
    """
    centres, directions = viewing_rays(cameras)
    warnings: list[str] = []
    _not_in_one_spot(cameras, centres)
    centre = nearest_point(centres, directions)
    _in_front(cameras, centres, directions, centre, warnings)
    radius = frame_radius(cameras, centres, centre)
    if points is not None and len(points) >= MIN_POINTS:
        centre = points_centre(points, centre, radius)
        radius = frame_radius(cameras, centres, centre)
        distances = np.linalg.norm(points - centre, axis=1)
        _not_elsewhere(distances, radius)
        reach = POINTS_MARGIN * float(np.quantile(distances[distances < radius], POINTS_WITHIN))
        radius = float(np.clip(reach, POINTS_SHRINK * radius, radius))
    poses = np.stack([matrix(c.world_from_cam) for c in cameras])
    rotation = (
        axes
        if given and axes is not None
        else given_axes(poses, warnings, _in_view(head, centre, radius))
        if given
        else _solved(
            poses,
            centre,
            _floor(points, centres, centre, radius),
            _facing(eyes, centre, radius),
            _in_view(head, centre, radius),
        )
    )
    if known is not None:
        scale, metric, source = _checked_scale(known, radius, warnings), True, known.source
    elif given:
        scale, metric, source = given_scale(radius, warnings, unit)
    else:
        scale, metric, source = NOMINAL_ROI / radius, False, NOMINAL
    guessed = None if metric else guess()
    if guessed is not None and PLAUSIBLE_ROI[0] <= guessed.metres_per_unit * radius <= PLAUSIBLE_ROI[1]:
        scale, source = guessed.metres_per_unit, guessed.source
    inverse = similarity(1.0 / scale, rotation.T, centre)
    return Normalisation(inverse, radius * scale, metric, source, tuple(warnings))


def _checked_scale(known: Scale, radius: float, warnings: list[str]) -> float:
    """Metres per unit. If the subject does not have a head's size, a warning is added."""
    low, high = PLAUSIBLE_ROI
    if not low <= radius * known.metres_per_unit <= high:
        warnings.append(f"the scale {known.source} gives the region of interest a radius of "
                        f"{radius * known.metres_per_unit:.3g} m; a head has {low} to {high} m; check it")  # fmt: skip
    return known.metres_per_unit


def viewing_rays(cameras: Sequence[Camera]) -> tuple[F64, F64]:
    """Camera centres (N, 3) and unit rays (N, 3) through the frames' centres.

    The frame's centre is used because the principal point of a cropped frame may lie anywhere.
    """
    found = [
        rays(matrix(c.K), matrix(c.world_from_cam), np.array(c.distortion), np.array([[c.width / 2, c.height / 2]]))
        for c in cameras
    ]
    return np.stack([o for o, _ in found]), np.concatenate([d for _, d in found])


def nearest_point(centres: F64, axes: F64) -> F64:
    """(3,) the point nearest to all rays (N, 3), robustly (sum of distances, by reweighted least squares).

    sum_i w_i (1 - a_i a_i^T) (x - c_i) = 0, w_i = 1 / distance_i
    Raises StageError if the rays are parallel.
    """
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weights = np.ones(len(centres))
    x = np.zeros(3)
    for _ in range(ROBUST_STEPS):
        A = np.einsum("n,nij->ij", weights, across)
        if np.linalg.eigvalsh(A / weights.sum())[0] < 1e-6:
            raise StageError("the cameras look in parallel directions", where="poses", value="no point where the views "
                             "meet", limit="views around the subject", remedy="photograph the subject from all around, "
                             "each photo aimed at the head")  # fmt: skip
        x = np.linalg.solve(A, np.einsum("n,nij,nj->i", weights, across, centres))
        distance = np.linalg.norm(np.einsum("nij,nj->ni", across, x - centres), axis=1)
        weights = 1.0 / np.maximum(distance, 1e-2 * max(float(np.median(distance)), 1e-12))
    return x


def _not_in_one_spot(cameras: Sequence[Camera], centres: F64) -> None:
    """Raises StageError if the cameras only rotate, which gives no depth: their spread must be at least ONE_SPOT of the
    distance."""
    median = np.median(centres, axis=0)
    spread = float(np.linalg.norm(centres - median, axis=1).max())
    size = max(float(np.abs(centres).max()), 1e-12)
    if spread > 1e-9 * size:
        x = nearest_point(*viewing_rays(cameras))
        if spread > ONE_SPOT * float(np.median(np.linalg.norm(centres - x, axis=1))):
            return
    raise StageError("the cameras are all in one spot", where="poses", value=f"{len(cameras)} views within "
                     f"{spread:.3g} units of each other", limit=f"at least {ONE_SPOT:.0%} of the distance to the "
                     "subject apart", remedy="walk around the subject instead of turning the camera; take each photo "
                     "from another place")  # fmt: skip


def _not_elsewhere(distances: F64, radius: float) -> None:
    """Raises StageError if no point is near where the cameras look. Cameras solved from photos of one spot are spread
    by errors only, and their points lie elsewhere."""
    if not (distances < radius).any():
        raise StageError(
            "the photos seem to be taken from one spot",
            where="poses",
            value=f"none of the {len(distances)} sparse points lies where the cameras look",
            limit="points on the subject",
            remedy="walk around the subject instead of turning the camera or zooming; take each photo from another "
            "place",
        )


def frame_radius(cameras: Sequence[Camera], centres: F64, centre: F64) -> float:
    """Radius that the frames cover around `centre` (3,): median of distance * tan(half the smaller field of view)."""
    K = np.stack([matrix(c.K) for c in cameras])
    tangent = np.array([min(c.width / 2 / k[0, 0], c.height / 2 / k[1, 1]) for c, k in zip(cameras, K, strict=True)])
    return float(np.median(np.linalg.norm(centres - centre, axis=1) * tangent))


def points_centre(points: F64, start: F64, radius: float) -> F64:
    """(3,) centre of the sparse points (M, 3) near `start` (3,), the point where the views meet.

    Points are weighted by exp(-(distance from `start` / radius)^2), so that a distant table or wall has no effect. It
    is the centre of the range with most of the weight, not the mean, because the face has many features and the back of
    the head few. The shift from `start` is limited, because the photographer aimed there.
    """
    weights = np.exp(-(np.linalg.norm(points - start, axis=1) ** 2) / radius**2)
    if weights.sum() < MIN_POINTS / 10:
        return start
    centre = np.empty(3)
    for axis in range(3):
        order = np.argsort(points[:, axis], kind="stable")
        cumulative = np.cumsum(weights[order]) / weights.sum()
        low, high = np.searchsorted(cumulative, [POINTS_TAIL, 1 - POINTS_TAIL])
        centre[axis] = (points[order[low], axis] + points[order[high], axis]) / 2
    shift = centre - start
    length = float(np.linalg.norm(shift))
    return start + shift * min(1.0, SHIFT_LIMIT * radius / max(length, 1e-12))


def given_axes(poses: F64, warnings: list[str], head: HeadFrame | None = None) -> F64:
    """(3, 3) asset_from_capture of poses (N, 4, 4): the head's axes, if known and more than FACE_OFF from the world's;
    else the world's axes if the cameras are upright in it; else the smallest rotation of their up direction to +Y."""
    if head is not None:
        off = off_frame(head)
        if off <= FACE_OFF:
            return np.eye(3)
        warnings.append(f"the face differs by {off:.0f} degrees from upright and +Z; the world is rotated by its "
                        "landmarks (capture_from_asset in run.json is the inverse)")  # fmt: skip
        return head.axes
    up = robust_direction(-poses[:, :3, 1])
    if up is None:
        warnings.append("the cameras' up directions cancel out; the capture's axes are kept")
        return np.eye(3)
    if up[1] >= UP_LIMIT:
        return np.eye(3)
    warnings.append(f"the cameras' mean up direction ({up[0]:.2f}, {up[1]:.2f}, {up[2]:.2f}) is far from +Y; the world "
                    "is rotated so that it becomes +Y")  # fmt: skip
    return least_turn(up, np.array([0.0, 1.0, 0.0]))


def _in_view(head: HeadFrame | None, centre: F64, radius: float) -> HeadFrame | None:
    """The head if it is inside the region of interest, not in a picture behind the subject; else None."""
    return head if head is not None and np.linalg.norm(head.eyes - centre) <= radius else None


def _floor(points: F64 | None, centres: F64, centre: F64, radius: float) -> F64 | None:
    """The upward normal (3,) of the support plane, or None. It gives the up direction even if some photos are portrait
    and some landscape."""
    if points is None:
        return None
    near = points[np.linalg.norm(points - centre, axis=1) < AROUND * radius] - centre
    support = find_support(near, centres - centre, radius, 0)
    return support.normal if support is not None and is_level(support, centres - centre) else None


def _solved(poses: F64, centre: F64, floor: F64 | None, left: F64 | None, head: HeadFrame | None) -> F64:
    """(3, 3) asset_from_capture of a solved world: the head's axes, if its landmarks are known. A plane counts as the
    floor of a head, of a bust on a table, only if the head is upright on it: else it is the wall behind a person."""
    if head is not None and (floor is None or floor @ head.axes[1] < UPRIGHT):
        return head.axes
    return solved_axes(poses, centre, floor, left if head is None else head.axes[0])


def _facing(eyes: Eyes | None, centre: F64, radius: float) -> F64 | None:
    """The direction (3,) to the person's left, if their eyes are inside the region of interest, not in a picture behind
    the subject."""
    if eyes is None or np.linalg.norm((eyes.left + eyes.right) / 2 - centre) > radius:
        return None
    return eyes.left - eyes.right


def solved_axes(poses: F64, centre: F64, floor: F64 | None = None, left: F64 | None = None) -> F64:
    """(3, 3) asset_from_capture for a world with arbitrary axes: +Y up, +Z in the direction of the face, or without a
    face towards the cameras.

    poses: (N, 4, 4). floor: up direction (3,), if known. left: direction to the subject's left (3,), if known.

    Up is the direction perpendicular to the cameras' x axes, with a weak prior on the mean of their up vectors. That
    mean alone would be tilted: cameras are tilted up and down more than rolled.
    """
    up = robust_direction(-poses[:, :3, 1])
    up = poses[0, :3, 1] * -1.0 if up is None else up
    x = poses[:, :3, 0]
    weights = np.ones(len(x))
    start = up
    for _ in range(ROBUST_STEPS):
        A = np.einsum("n,ni,nj->ij", weights, x, x) / weights.sum() + 0.02 * (np.eye(3) - np.outer(start, start))
        y = np.linalg.eigh(A)[1][:, 0]
        up = y if y @ start > 0 else -y
        weights = 1.0 / np.maximum(np.abs(x @ up), 0.02)
    up = up if floor is None else floor
    side = np.mean(poses[:, :3, 3] - centre, axis=0)
    side = side - (side @ up) * up
    if np.linalg.norm(side) < 1e-6 * np.linalg.norm(poses[:, :3, 3] - centre, axis=1).mean():
        side = poses[0, :3, 3] - centre  # cameras evenly all around: use the first one's side
        side = side - (side @ up) * up
    if left is not None and np.linalg.norm(np.cross(left, up)) > LEVEL * np.linalg.norm(left):
        side = np.cross(left, up)
    z = side / np.linalg.norm(side)
    return np.stack([np.cross(up, z), up, z])


def robust_direction(vectors: F64) -> F64 | None:
    """Unit vector nearest to (N, 3) unit vectors (geometric median), or None if they cancel out."""
    weights = np.ones(len(vectors))
    mean = vectors.mean(0)
    if np.linalg.norm(mean) < 0.1:
        return None
    for _ in range(ROBUST_STEPS):
        mean = weights @ vectors / weights.sum()
        weights = 1.0 / np.maximum(np.linalg.norm(vectors - mean, axis=1), 1e-2)
    return np.asarray(mean / np.linalg.norm(mean), np.float64)


def least_turn(a: F64, b: F64) -> F64:
    """The smallest rotation (3, 3) from unit vector a (3,) to unit vector b (3,)."""
    v, c = np.cross(a, b), float(a @ b)
    if c < -1 + 1e-9:  # opposite: half a turn about any perpendicular axis
        across = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        across /= np.linalg.norm(across)
        return np.asarray(2 * np.outer(across, across) - np.eye(3), np.float64)
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + c), np.float64)


def given_scale(radius: float, warnings: list[str], unit: Unit = "guess") -> tuple[float, bool, str]:
    """(asset units per capture unit, metric, source of the scale). guess: the unit that gives the region of interest a
    head's size. radius: of the region of interest, capture units."""
    if unit == "unknown":
        warnings.append(f"the cameras' unit is unknown; the asset is scaled to a nominal radius of {NOMINAL_ROI} m; "
                        "set poses.unit=metres (centimetres, millimetres) if you know it")  # fmt: skip
        return NOMINAL_ROI / radius, False, NOMINAL
    if unit != "guess":
        return UNITS[unit], True, f"{unit}, from poses.unit"
    low, high = PLAUSIBLE_ROI
    fitting = [u for u, factor in UNITS.items() if low <= radius * factor <= high]
    if not fitting:
        warnings.append(f"the cameras' unit is unknown (the region of interest has a radius of {radius:.4g} units); "
                        f"the asset is scaled to a nominal radius of {NOMINAL_ROI} m")  # fmt: skip
        return NOMINAL_ROI / radius, False, NOMINAL
    likely = min(fitting, key=lambda u: abs(np.log(radius * UNITS[u] / NOMINAL_ROI)))
    if likely != "metres":
        warnings.append(f"the cameras' unit is assumed to be {likely} (the region of interest has a radius of "
                        f"{radius:.4g} units)")  # fmt: skip
    return UNITS[likely], True, f"{likely}: the unit of the given cameras that gives the subject a head's size"


def _in_front(cameras: Sequence[Camera], centres: F64, axes: F64, centre: F64, warnings: list[str]) -> None:
    """Raises StageError if the common point is behind more than a third of the cameras; a warning for each such
    camera."""
    behind = np.einsum("ni,ni->n", axes, centre - centres) <= 0
    if behind.sum() > len(cameras) / 3:
        raise StageError("the cameras look away from each other", where="poses", value=f"{int(behind.sum())} of "
                         f"{len(cameras)} have the point where the views meet behind them", limit="at most a third",
                         remedy="check that Rt is world-to-camera with OpenCV axes (x right, y down, z forward), not "
                         "its inverse and not OpenGL axes")  # fmt: skip
    for c, wrong in zip(cameras, behind, strict=True):
        if wrong:
            warnings.append(f"{c.name} looks away from the point where the views meet")
