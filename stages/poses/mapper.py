"""Structure from motion: cameras and sparse points from features and matches, by COLMAP's mappers.

The incremental mapper registers photo after photo; the global one solves all at once, for many photos.
The same input gives the same cameras: every sampler is seeded and the mappers run on one thread, because the order of
a parallel sum is not fixed. COLMAP has the first pixel's centre at (0.5, 0.5), like this project.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pipeline.colmap import pycolmap
from pipeline.transforms import F64, inverse_rigid, project, rigid
from stages.poses.bundle_adjustment import Refine, adjust
from stages.poses.features import Features
from stages.poses.known_poses import seeded
from stages.poses.matching import Pair, Verified
from stages.poses.merge import merged
from stages.poses.well_supported import well_supported

DEFAULT_FOCAL = 1.2  # of the longest edge: COLMAP's own guess, a 43 mm lens on full frame
MAX_MODELS = 8
MIN_MODEL = 3
GLOG_ERROR = 2
MIN_POINTS = 100
LOOSE_MODELS = 3  # each further model costs more here, because more photos are tried
LOOSE_INLIERS, LOOSE_SHARE = 15, 0.15  # fewest inliers to register a photo; COLMAP's defaults: 30 and 0.25
Mapper = Literal["incremental", "global"]
PRINCIPAL_POINT_LIMIT = (
    1.5e-3  # of the longest edge, standard deviation: this rotates a view by less than a tenth of a degree
)


@dataclass(frozen=True, slots=True)
class Lens:
    """Initial intrinsics of the photos that share a lens. width, height, focal: pixels; focal is None if unknown."""

    width: int
    height: int
    focal: float | None = None


@dataclass(frozen=True, slots=True)
class Pose:
    """Camera of a registered photo. K (3, 3) pixels; world_from_cam (4, 4) rigid; distortion k1 k2 p1 p2 k3."""

    K: F64
    world_from_cam: F64
    distortion: tuple[float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Model:
    """The largest reconstruction. poses, view_error_px: by photo index. points (M, 3); error_px (M,); track (M,) photos
    per point. others: photos of each other reconstruction: of another subject, or not linked to this one. seen: (L, 2)
    by photo index: which of its features is an observation of which point.
    """

    poses: dict[int, Pose]
    points: F64
    error_px: F64
    track: F64
    reprojection_error_px: float
    view_error_px: dict[int, float]
    others: tuple[tuple[int, ...], ...] = ()
    seen: Mapping[int, npt.NDArray[np.int64]] = field(default_factory=dict)


def reconstruct(
    scratch: Path,
    lenses: Sequence[Lens],
    lens_of: Sequence[int],
    features: Sequence[Features],
    verified: Mapping[Pair, Verified],
    *,
    camera_model: str,
    mapper: Mapper,
    refine: Refine,
    seed: int,
    next_image: Callable[[], bool],
    loose: bool = False,
) -> Model | None:
    """The largest model of COLMAP's mapper, or None. lens_of: index of each photo's lens in `lenses`.

    loose: a photo is registered with half of COLMAP's default number of inliers; photos that in the end do not share
    the default number of points with the rest are removed. next_image: called before each photo is registered (by the
    global mapper: once before all); True stops the mapper. scratch: an empty folder.
    """
    pycolmap.logging.minloglevel = GLOG_ERROR
    database = scratch / "matches.db"
    cameras = [_start(lens, camera_model) for lens in lenses]
    numbers = write_database(database, cameras, lens_of, features, verified)
    if mapper == "global":
        found = _all_at_once(database, scratch, refine, seed, next_image)
    else:
        found = _one_by_one(database, scratch, _options(refine, seed, loose), next_image)
    if not found:
        return None
    if loose:
        for reconstruction in found.values():
            _remove_poorly_supported(reconstruction)
    # the most photos; if equal, the most points
    ranked = sorted(found.values(), key=lambda r: (r.num_reg_images(), r.num_points3D()), reverse=True)
    ranked = merged(ranked, database, scratch / "merged", seed)
    largest, of_lens = ranked[0], np.array(lens_of, np.int64)
    determined = _determines_principal_points(largest, numbers, of_lens)
    # a lens that the photos hardly determine drifts under a robust loss, which ignores a part of the observations
    own = refine if determined else Refine(focal=False, distortion=False)
    adjust(largest, own, principal_point={"auto": determined, "yes": True, "no": False}[refine.principal_point])
    return model_of(largest, numbers, ranked[1:])


def _one_by_one(database: Path, scratch: Path, options: Any, next_image: Callable[[], bool]) -> dict[int, Any]:
    token = pycolmap.CancellationToken()

    def tick() -> None:
        if next_image():
            token.cancel()

    try:
        return dict(
            pycolmap.incremental_mapping(
                database, scratch, scratch / "models", options, next_image_callback=tick, cancellation_token=token,
            )
        )  # fmt: skip
    except InterruptedError:  # raised by a cancelled token; the caller handles the reason
        return {}


def _all_at_once(
    database: Path, scratch: Path, refine: Refine, seed: int, next_image: Callable[[], bool]
) -> dict[int, Any]:  # fmt: skip
    if next_image():
        return {}
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = seed
    options.min_model_size = MIN_MODEL
    options.mapper.bundle_adjustment.refine_focal_length = refine.focal
    options.mapper.bundle_adjustment.refine_extra_params = refine.distortion
    return dict(pycolmap.global_mapping(database, scratch, scratch / "models", options))


def _start(lens: Lens, camera_model: str) -> Any:
    """The initial COLMAP camera of a lens."""
    focal = lens.focal or DEFAULT_FOCAL * max(lens.width, lens.height)
    camera = pycolmap.Camera.create_from_model_name(0, camera_model, focal, lens.width, lens.height)
    camera.has_prior_focal_length = lens.focal is not None
    return camera


def opencv_distortion(model: str, params: Sequence[float]) -> tuple[float, float, float, float, float]:
    """(k1, k2, p1, p2, k3) of a COLMAP camera, exactly. Only models that these five terms represent are accepted."""
    if model == "SIMPLE_RADIAL":  # f, cx, cy, k
        return (float(params[3]), 0.0, 0.0, 0.0, 0.0)
    if model == "OPENCV":  # fx, fy, cx, cy, k1, k2, p1, p2
        k1, k2, p1, p2 = (float(p) for p in params[4:8])
        return (k1, k2, p1, p2, 0.0)
    if model == "FULL_OPENCV" and not any(params[9:]):  # ..., k3, then k4 k5 k6 of a rational lens
        k1, k2, p1, p2, k3 = (float(p) for p in params[4:9])
        return (k1, k2, p1, p2, k3)
    raise ValueError(f"camera model {model} has no exact k1 k2 p1 p2 k3")


def _determines_principal_points(
    reconstruction: Any, numbers: Mapping[str, int], lens_of: npt.NDArray[np.int64]
) -> bool:
    """Whether the photos determine the principal point of every lens well enough to refine it."""
    from stages.poses.conditioning import Observations, principal_point_deviation

    if reconstruction.num_points3D() < MIN_POINTS:
        return False
    images = [i for i in reconstruction.images.values() if i.has_pose]
    place = {k: n for n, k in enumerate(sorted(reconstruction.points3D))}
    seen = [_observations(image) for image in images]
    lenses, of_lens = np.unique(lens_of[[numbers[i.name] for i in images]], return_inverse=True)
    cameras = [reconstruction.cameras[i.camera_id] for i in images]
    deviation = principal_point_deviation(
        np.array([c.calibration_matrix() for c in cameras]),
        np.array([opencv_distortion(c.model_name, list(c.params))[0] for c in cameras]),
        np.array([i.cam_from_world().matrix() for i in images]),
        np.array([reconstruction.points3D[k].xyz for k in place]),
        Observations(
            np.repeat(np.arange(len(images)), [len(ids) for ids, _ in seen]),
            np.array([place[k] for ids, _ in seen for k in ids]),
            np.concatenate([uv for _, uv in seen]),
            of_lens.astype(np.int64),
        ),
    )
    edge = max(max(c.width, c.height) for c in cameras)
    return bool(deviation.max() <= PRINCIPAL_POINT_LIMIT * edge)


def _observations(image: Any) -> tuple[list[int], F64]:
    """Ids of the points that an image observes, and their pixels (L, 2)."""
    found = [(p.point3D_id, p.xy) for p in image.points2D if p.has_point3D()]
    return [k for k, _ in found], np.array([uv for _, uv in found], np.float64).reshape(-1, 2)


def _remove_poorly_supported(reconstruction: Any) -> None:
    """Deregister photos that share too few points with the rest. In place."""
    seen = {number: {p.point3D_id for p in image.points2D if p.has_point3D()}
            for number, image in reconstruction.images.items() if image.has_pose}  # fmt: skip
    for number in sorted(set(seen) - set(well_supported(seen))):
        reconstruction.deregister_frame(reconstruction.images[number].frame_id)


def _options(refine: Refine, seed: int, loose: bool) -> Any:
    options = seeded(seed)
    options.min_model_size = MIN_MODEL
    options.max_num_models = MAX_MODELS
    options.ba_refine_focal_length = refine.focal
    options.ba_refine_extra_params = refine.distortion
    options.ba_refine_principal_point = refine.principal_point == "yes"
    if loose:
        options.mapper.abs_pose_min_num_inliers = LOOSE_INLIERS
        options.mapper.abs_pose_min_inlier_ratio = LOOSE_SHARE
        options.max_num_models = LOOSE_MODELS
    return options


def write_database(
    path: Path,
    cameras: Sequence[Any],
    lens_of: Sequence[int],
    features: Sequence[Features],
    verified: Mapping[Pair, Verified],
) -> dict[str, int]:
    """Write COLMAP's database of cameras, keypoints and verified pairs. lens_of: index of each photo's camera in
    `cameras`. Returns photo indices by image name."""
    database = pycolmap.Database.open(path)
    written = [database.write_camera(camera) for camera in cameras]
    images = []
    for i, f in enumerate(features):
        images.append(database.write_image(pycolmap.Image(name=f"{i:05d}", camera_id=written[lens_of[i]])))
        database.write_keypoints(images[-1], f.uv)
    for (i, j), pair in sorted(verified.items()):
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = int(pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED)
        geometry.F, geometry.inlier_matches = pair.F, pair.matches
        database.write_matches(images[i], images[j], pair.matches)
        database.write_two_view_geometry(images[i], images[j], geometry)
    database.close()
    return {f"{i:05d}": i for i in range(len(features))}


def model_of(reconstruction: Any, numbers: Mapping[str, int], others: Sequence[Any] = ()) -> Model:
    """The model of a COLMAP reconstruction. numbers: photo indices by image name. others: smaller reconstructions."""
    poses, errors, seen_at = {}, {}, {}
    place = {k: n for n, k in enumerate(sorted(reconstruction.points3D))}
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        camera = reconstruction.cameras[image.camera_id]
        m = np.asarray(image.cam_from_world().matrix(), np.float64)
        poses[numbers[image.name]] = Pose(
            K=np.asarray(camera.calibration_matrix(), np.float64),
            world_from_cam=inverse_rigid(rigid(m[:, :3], m[:, 3])),
            distortion=opencv_distortion(camera.model_name, list(camera.params)),
        )
        ids, uv = _observations(image)
        at = [(n, place[p.point3D_id]) for n, p in enumerate(image.points2D) if p.has_point3D()]
        seen_at[numbers[image.name]] = np.array(at, np.int64).reshape(-1, 2)
        xyz = np.array([reconstruction.points3D[k].xyz for k in ids]).reshape(-1, 3)
        pose = poses[numbers[image.name]]
        seen, _ = project(pose.K, inverse_rigid(pose.world_from_cam), np.array(pose.distortion), xyz)
        errors[numbers[image.name]] = float(np.linalg.norm(seen - uv, axis=1).mean()) if len(ids) else float("nan")
    points = [reconstruction.points3D[k] for k in place]
    return Model(
        poses=dict(sorted(poses.items())),
        points=np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
        error_px=np.array([p.error for p in points], np.float64),
        track=np.array([p.track.length() for p in points], np.float64),
        reprojection_error_px=float(reconstruction.compute_mean_reprojection_error()),
        view_error_px=errors,
        others=tuple(tuple(sorted(numbers[i.name] for i in o.images.values() if i.has_pose)) for o in others),
        seen=seen_at,
    )
