"""Triangulation of sparse points from given cameras, and refinement of their poses.

A rig's calibration is not perfect: a bumped camera is a few pixels off. The given centres are far more accurate than
photos alone allow, the given directions are not. So bundle adjustment has a Gaussian prior on the centres (standard
deviation `deviation`), keeps the lenses and refines the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts import Camera
from pipeline.colmap import pycolmap
from pipeline.transforms import F64, inverse_rigid, matrix
from stages.poses.bundle_adjustment import adjust_near
from stages.poses.features import Features
from stages.poses.known_poses import with_points, with_poses
from stages.poses.mapper import GLOG_ERROR, Model, model_of, write_database
from stages.poses.matching import Pair, Verified

MIN_OBSERVATIONS = 20  # fewest observed points of a view for a refinement
TURN = 0.05  # radians: no rig has such an error; a view that is rotated more has wrong matches
ROUNDS = (12.0, 4.0)  # pixels: largest reprojection error in the first and in the second round


def triangulate(
    scratch: Path, cameras: Sequence[Camera], features: Sequence[Features], verified: Mapping[Pair, Verified],
    *, refine: bool, deviation: float, seed: int,
) -> tuple[Model, list[int]] | None:  # fmt: skip
    """Points (and with `refine` poses) from cameras in the capture's world, or None if the photos share no point.

    Second: indices of the views that could not be refined, and keep the given pose. deviation: of the given centres, in
    the world's unit. scratch: an empty folder.
    """
    pycolmap.logging.minloglevel = GLOG_ERROR
    database = scratch / "matches.db"
    lenses = [_lens(c) for c in cameras]
    unskewed = [Features(_without_skew(f.uv, c), f.descriptors) for f, c in zip(features, cameras, strict=True)]
    numbers = write_database(database, lenses, range(len(cameras)), unskewed, verified)
    given = [matrix(c.world_from_cam) for c in cameras]
    poses = {name: inverse_rigid(given[n]) for name, n in numbers.items()}
    found = with_poses(database, poses)
    centres = {n: np.asarray(i.projection_center(), np.float64) for n, i in found.images.items()}
    turns = {n: np.asarray(i.cam_from_world().matrix()[:, :3], np.float64) for n, i in found.images.items()}
    for limit in ROUNDS if refine else ROUNDS[-1:]:
        found = with_points(found, database, scratch, limit, seed)
        if not found.num_points3D():
            return None
        if refine:
            adjust_near(found, centres, deviation)
            _restore_orientation(found, turns)
    model = model_of(found, numbers)
    seen = {numbers[i.name]: i.num_points3D for i in found.images.values()}
    doubtful = [n for n, p in model.poses.items()
                if refine and (seen[n] < MIN_OBSERVATIONS or _turn(given[n], p.world_from_cam) > TURN)]  # fmt: skip
    own = {n: replace(p, K=matrix(cameras[n].K), world_from_cam=given[n] if n in doubtful else p.world_from_cam)
             for n, p in model.poses.items()}  # fmt: skip
    return replace(model, poses=own), doubtful


def _restore_orientation(found: Any, turns: Mapping[int, F64]) -> None:
    """Rotate the world about the cameras' mean centre so that the rotations agree with the given ones. In place.

    Centres on a line do not determine the rotation about it, and flat rings do so only weakly; the given rotations do.
    turns: cam_from_world (3, 3) by image id. Least sum of distances, by reweighting, so that outliers have no effect.
    """
    pairs = [(turns[n], np.asarray(i.cam_from_world().matrix()[:, :3])) for n, i in found.images.items()]
    true_from_found = np.stack([given.T @ now for given, now in pairs])
    weights, Q = np.ones(len(pairs)), np.eye(3)
    for _ in range(10):
        u, _, vt = np.linalg.svd(np.einsum("n,nij->ij", weights, true_from_found))
        Q = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        weights = 1 / np.maximum(np.linalg.norm(true_from_found - Q, axis=(1, 2)), 1e-6)
    centre = np.mean([i.projection_center() for i in found.images.values()], axis=0)
    found.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(Q), centre - Q @ centre))


def _turn(a: F64, b: F64) -> float:
    """Angle in radians between two rigid poses (4, 4)."""
    return float(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1)))


def _lens(c: Camera) -> Any:
    """COLMAP's camera with fx fy cx cy k1 k2 p1 p2 k3; `_without_skew` removes the skew from the positions."""
    K = c.K
    params = [K[0][0], K[1][1], K[0][2], K[1][2], *c.distortion[:4], c.distortion[4], 0.0, 0.0, 0.0]
    return pycolmap.Camera(model="FULL_OPENCV", width=c.width, height=c.height, params=params)


def _without_skew(uv: Any, c: Camera) -> Any:
    """(N, 2) positions in pixels without the skew: u - s y, y = (v - cy) / fy."""
    skew = c.K[0][1]
    if skew == 0:
        return uv
    moved = np.array(uv)
    moved[:, 0] -= skew * (moved[:, 1] - c.K[1][2]) / c.K[1][1]
    return moved
