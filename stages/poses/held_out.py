"""Cameras of held-out photos: registered one by one against the finished model, which stays as it is.

Features of a held-out photo are matched with those of fitted photos; where such a feature is an observation of a sparse
point, the match is one of the photo with the point. The pose follows from these by RANSAC over minimal sets of three
(perspective-n-point) and least squares with a Cauchy loss. The lens is that of the fitted photos by the same lens.
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
from stages.poses.config import Config
from stages.poses.detect import Photo, Progress, detect_all, match_pairs
from stages.poses.features import Effort, Features
from stages.poses.mapper import DEFAULT_FOCAL, Model, Pose
from stages.poses.matching import Pair, Verified, promising_pairs
from stages.poses.well_supported import MIN_SHARED

FIRST_LIMIT, LIMIT = 12.0, 4.0  # pixels: COLMAP's limits of a match for the first pose, and of a point's error
LEAST_SHARE = 0.25  # of the matches that fit the pose: COLMAP's default
ROUNDS = 3  # of choosing the matches within LIMIT and refining the pose by them
SAME_LENS = 1e-9  # relative difference of focal lengths of photos that share a lens


@dataclass(frozen=True, slots=True)
class Registered:
    """A held-out photo. error_px: mean distance of its matches from the projected points; matches: their number."""

    pose: Pose
    error_px: float
    matches: int


@dataclass(frozen=True, slots=True)
class Lens:
    """K (3, 3) pixels, distortion k1 k2 p1 p2 k3; free: the focal length is refined with the pose."""

    K: F64
    distortion: tuple[float, float, float, float, float]
    free: bool


def register_all(
    fitted: Sequence[Photo], held: Sequence[Photo], model: Model, features: Sequence[Features], effort: Effort,
    config: Config, progress: Progress,
) -> list[Registered | None]:  # fmt: skip
    """The camera of each photo of `held` in the world of the model of `fitted`; None where too few matches fit.

    features: of `fitted`, as the model was made from, detected with `effort`. The model is not changed.
    """
    if not held:
        return []
    own = detect_all(held, config, effort, progress)
    verified = matches_with(fitted, held, features, own, model, effort, config, progress)
    found = []
    for n, photo in enumerate(held):
        uv, xyz = sightings(n, len(fitted), own[n], model, verified)
        found.append(register(uv, xyz, lens_of(photo, fitted, model), (photo.width, photo.height), config.seed))
    return found


def matches_with(
    fitted: Sequence[Photo], held: Sequence[Photo], features: Sequence[Features], own: Sequence[Features],
    model: Model, effort: Effort, config: Config, progress: Progress,
) -> dict[Pair, Verified]:  # fmt: skip
    """Verified matches of placed photos (first of a pair) with held-out ones (second, after all fitted ones)."""
    photos, every = [*fitted, *held], [*features, *own]
    near = promising_pairs(every, effort.ratio, config.neighbours, lambda: progress(0, 1, "comparing photos"))
    pairs = [(i, j) for i, j in near if i in model.poses and j >= len(fitted)]
    return match_pairs(photos, every, pairs, config, effort, progress)


def sightings(
    number: int, fitted: int, own: Features, model: Model, verified: Mapping[Pair, Verified]
) -> tuple[F64, F64]:  # fmt: skip
    """Pixels (L, 2) of a held-out photo and the sparse points (L, 3) that are seen there; each pair of feature and
    point once. number: of the photo among the held-out ones; fitted: number of fitted photos."""
    found: list[npt.NDArray[np.int64]] = [np.zeros((0, 2), np.int64)]
    for (i, j), pair in verified.items():
        if j != fitted + number:
            continue
        point_of = dict(model.seen[i].tolist())
        found.append(np.array([(b, point_of[a]) for a, b in pair.matches.tolist() if a in point_of],
                              np.int64).reshape(-1, 2))  # fmt: skip
    once = np.unique(np.concatenate(found), axis=0)
    return np.asarray(own.uv[once[:, 0]], np.float64), model.points[once[:, 1]]


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


def register(uv: F64, xyz: F64, lens: Lens, size: tuple[int, int], seed: int) -> Registered | None:
    """The camera that sees the points xyz (L, 3) at uv (L, 2); None if fewer than MIN_SHARED or LEAST_SHARE fit it.
    size: width and height in pixels. Points and lens stay."""
    if len(uv) < MIN_SHARED:
        return None
    camera = _colmap_camera(lens, size)
    first = pycolmap.estimate_and_refine_absolute_pose(uv, xyz, camera, _estimation(seed), _refinement(lens, 1.0))
    if first is None:
        return None
    pose, camera = first["cam_from_world"], first.get("camera", camera)
    for _ in range(ROUNDS):
        far = _errors(uv, xyz, camera, pose)
        near = far <= LIMIT
        if near.sum() < max(MIN_SHARED, LEAST_SHARE * len(uv)):
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
