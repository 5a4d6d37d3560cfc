"""A solution made anew from guided matches: with known cameras many more features find their partners, so that the same
photos determine the cameras better, and wrong matches of the first solution are no longer there."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.colmap import pycolmap
from pipeline.transforms import inverse_rigid
from stages.poses.bundle_adjustment import Refine, adjust
from stages.poses.detect import Photo
from stages.poses.features import Features
from stages.poses.known_poses import with_points, with_poses
from stages.poses.mapper import GLOG_ERROR, Model, Pose, model_of, write_database
from stages.poses.matching import Pair, Verified

LIMIT = 4.0  # pixels, largest reprojection error of a point: COLMAP's own
ROUNDS = 2  # of triangulation and bundle adjustment: the second has the points that only the first one's cameras meet


def reconstructed(
    model: Model, photos: Sequence[Photo], features: Sequence[Features], matches: Mapping[Pair, Verified],
    camera_model: str, scratch: Path, seed: int, rounds: int = ROUNDS,
) -> Model | None:  # fmt: skip
    """Points from these matches at the model's cameras, then cameras and points refined; None if there are no points.

    Photos whose cameras have the same lens in `model` keep a common one. scratch: a folder that does not exist yet.
    rounds: of triangulation and bundle adjustment.
    """
    pycolmap.logging.minloglevel = GLOG_ERROR
    scratch.mkdir(parents=True)
    try:
        lenses, lens_of = _lenses(model.poses, photos, camera_model)
        database = scratch / "matches.db"
        numbers = write_database(database, lenses, lens_of, features, matches)
        poses = {name: inverse_rigid(model.poses[i].world_from_cam)[:3] for name, i in numbers.items()
                 if i in model.poses}  # fmt: skip
        cameras = None
        for _ in range(rounds):
            found = with_points(with_poses(database, poses, cameras), database, scratch, LIMIT, seed)
            if not found.num_points3D():
                return None
            adjust(found, Refine(), principal_point=False)
            poses = {i.name: np.asarray(i.cam_from_world().matrix()) for i in found.images.values() if i.has_pose}
            cameras = dict(found.cameras)
        return replace(model_of(found, numbers), others=model.others)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _lenses(poses: Mapping[int, Pose], photos: Sequence[Photo], model: str) -> tuple[list[Any], list[int]]:
    """COLMAP's cameras, and the index of each photo's; that of a photo without a camera is 0."""
    keys: dict[tuple[float, ...], int] = {}
    lenses: list[Any] = []
    lens_of = [0] * len(photos)
    for i, pose in sorted(poses.items()):
        key = (photos[i].width, photos[i].height, *pose.K.ravel().tolist(), *pose.distortion)
        if key not in keys:
            keys[key] = len(lenses)
            lenses.append(colmap_camera(pose, photos[i].width, photos[i].height, model))
        lens_of[i] = keys[key]
    return lenses, lens_of


def colmap_camera(pose: Pose, width: int, height: int, model: str) -> Any:
    """COLMAP's camera of this lens, SIMPLE_RADIAL or OPENCV, in pixels."""
    K, (k1, k2, p1, p2, _) = pose.K, pose.distortion
    middle = [float(K[0, 2]), float(K[1, 2])]
    params = ([float(K[0, 0]), *middle, k1] if model == "SIMPLE_RADIAL"
              else [float(K[0, 0]), float(K[1, 1]), *middle, k1, k2, p1, p2])  # fmt: skip
    return pycolmap.Camera(model=model, width=width, height=height, params=params)
