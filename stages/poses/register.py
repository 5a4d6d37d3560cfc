"""The camera of one photo from points of a model that it shows: RANSAC over minimal sets of three points
(perspective-n-point), then least squares with a Cauchy loss. Points and lens stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.colmap import pycolmap
from pipeline.transforms import F64, inverse_rigid, project, rigid
from stages.poses.bundle_adjustment import MIN_SCALE, ROBUST
from stages.poses.detect import Photo
from stages.poses.mapper import DEFAULT_FOCAL, Model, Pose
from stages.poses.matching import Pair, Verified
from stages.poses.well_supported import MIN_SHARED

FIRST_LIMIT, LIMIT = 12.0, 4.0  # pixels: COLMAP's limits of a match for the first pose, and of a point's error
LEAST_SHARE = 0.25  # of the matches that fit the pose: COLMAP's default
ROUNDS = 3  # of choosing the matches within LIMIT and refining the pose by them
SAME_LENS = 1e-9  # relative difference of focal lengths of photos that share a lens


I64 = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Registered:
    """A photo with a camera. error_px: mean distance of its matches from the points; matches: their number."""

    pose: Pose
    error_px: float
    matches: int


@dataclass(frozen=True, slots=True)
class Lens:
    """K (3, 3) pixels, distortion k1 k2 p1 p2 k3; free: the focal length is refined with the pose."""

    K: F64
    distortion: tuple[float, float, float, float, float]
    free: bool


def sightings(number: int, model: Model, verified: Mapping[Pair, Verified]) -> I64:
    """(L, 2) features of the photo with this number, and the points of the model that they show by its matches with
    placed photos; each pair once."""
    found: list[I64] = [np.zeros((0, 2), np.int64)]
    for pair, matches in verified.items():
        if number not in pair:
            continue
        own = pair.index(number)
        if pair[1 - own] not in model.poses:
            continue
        point_of = dict(model.seen[pair[1 - own]].tolist())
        both = matches.matches[:, [own, 1 - own]].tolist()
        found.append(np.array([(a, point_of[b]) for a, b in both if b in point_of], np.int64).reshape(-1, 2))
    return np.unique(np.concatenate(found), axis=0)


def lens_of(photo: Photo, fitted: Sequence[Photo], model: Model) -> Lens:
    """The lens of the placed photos of the same group. Where these have lenses of their own, or there are none, the
    focal length is only a start: the median of theirs, else that of EXIF, else COLMAP's guess."""
    same = [p for i, p in model.poses.items() if fitted[i].group == photo.group]
    if not same:
        f = photo.focal or DEFAULT_FOCAL * max(photo.width, photo.height)
        K = np.array([[f, 0, photo.width / 2], [0, f, photo.height / 2], [0, 0, 1.0]])
        return Lens(K, (0.0,) * 5, True)
    focals = np.array([p.K[0, 0] for p in same])
    middle = same[int(np.argsort(focals, kind="stable")[len(focals) // 2])]
    return Lens(middle.K, middle.distortion, bool(np.ptp(focals) > SAME_LENS * focals.mean()))


def register(
    uv: F64, xyz: F64, lens: Lens, size: tuple[int, int], seed: int, least: int = MIN_SHARED, share: float = LEAST_SHARE
) -> Registered | None:
    """The camera that sees the points xyz (L, 3) at uv (L, 2); None if fewer than `least`, or a smaller share than
    `share`, fit it. size: width and height in pixels. Points and lens stay."""
    if len(uv) < least:
        return None
    camera = _colmap_camera(lens, size)
    first = pycolmap.estimate_and_refine_absolute_pose(uv, xyz, camera, _estimation(seed), _refinement(lens, 1.0))
    if first is None:
        return None
    pose, camera = first["cam_from_world"], first.get("camera", camera)
    for _ in range(ROUNDS):
        far = _errors(uv, xyz, camera, pose)
        near = far <= LIMIT
        if near.sum() < max(least, share * len(uv)):
            return None
        scale = ROBUST * max(float(np.median(far[near])), MIN_SCALE)
        better = pycolmap.refine_absolute_pose(pose, uv, xyz, near, camera, _refinement(lens, scale))
        if better is None:
            break
        pose, camera = better["cam_from_world"], better.get("camera", camera)
    far = _errors(uv, xyz, camera, pose)
    near = far <= LIMIT
    m = np.asarray(pose.matrix(), np.float64)
    K = np.asarray(camera.calibration_matrix(), np.float64) if lens.free else lens.K
    own = Pose(K, inverse_rigid(rigid(m[:, :3], m[:, 3])), lens.distortion)
    return Registered(own, float(far[near].mean()), int(near.sum()))


def _errors(uv: F64, xyz: F64, camera: Any, pose: Any) -> F64:
    """(L,) distances in pixels of uv (L, 2) from the projected points; infinite behind the camera."""
    m = np.asarray(pose.matrix(), np.float64)
    distortion = np.array([*camera.params[4:9]], np.float64)
    seen, _ = project(np.asarray(camera.calibration_matrix(), np.float64), rigid(m[:, :3], m[:, 3]), distortion, xyz)
    return np.asarray(np.nan_to_num(np.linalg.norm(seen - uv, axis=1), nan=np.inf), np.float64)


def _colmap_camera(lens: Lens, size: tuple[int, int]) -> Any:
    K = lens.K
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.distortion, 0.0, 0.0, 0.0]
    return pycolmap.Camera(model="FULL_OPENCV", width=size[0], height=size[1], params=params)


def _estimation(seed: int) -> Any:
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = FIRST_LIMIT
    options.ransac.random_seed = seed
    return options


def _refinement(lens: Lens, scale: float) -> Any:
    """scale: of the Cauchy loss, in pixels."""
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.refine_focal_length, options.refine_extra_params = lens.free, False
    options.loss_function_scale = scale
    options.gradient_tolerance = 1e-6
    return options
