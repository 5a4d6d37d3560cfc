"""A made-up model of structure from motion: points around the origin with descriptors, seen by cameras on an orbit."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from pipeline.transforms import F64, inverse_rigid, project
from stages.poses.feature_sets import FeatureSet
from stages.poses.features import PLAIN, Features
from stages.poses.mapper import Model, Pose
from tests.support.textured_ball import camera_on_orbit

SIZE = (640, 856)
K = np.array([[1200.0, 0, 320.0], [0, 1200.0, 428.0], [0, 0, 1]])
BENT = (0.05, 0.0, 0.0, 0.0, 0.0)
STRAIGHT = (0.0,) * 5


@dataclass(frozen=True)
class World:
    """Points (N, 3), their unit descriptors, poses of all photos and what they show. seen: by photo (L, 2) feature and
    point."""

    points: F64
    poses: list[Pose]
    features: list[Features]
    seen: list[np.ndarray]

    def photos(self) -> list[Any]:
        return [SimpleNamespace(width=SIZE[0], height=SIZE[1], group="a", focal=None) for _ in self.poses]

    def set_of(self) -> FeatureSet:
        return FeatureSet(PLAIN, tuple(self.features))

    def model(self, placed: list[int], poses: dict[int, Pose] | None = None) -> Model:
        """The model of these photos: all points that two of them see. poses: instead of the true ones."""
        counts = np.zeros(len(self.points), int)
        for i in placed:
            counts[self.seen[i][:, 1]] += 1
        kept = counts >= 2
        number = np.cumsum(kept) - 1
        seen = {
            i: np.stack([s[:, 0], number[s[:, 1]]], 1) for i in placed if (s := _of(self.seen[i], kept)) is not None
        }
        return Model(
            poses={i: (poses or {}).get(i, self.poses[i]) for i in placed}, points=self.points[kept],
            error_px=np.full(kept.sum(), 0.3), track=counts[kept].astype(float), reprojection_error_px=0.3,
            view_error_px=dict.fromkeys(placed, 0.3), seen=seen,
        )  # fmt: skip


def _of(seen: np.ndarray, kept: np.ndarray) -> np.ndarray:
    return seen[kept[seen[:, 1]]]


def unit(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 128) descriptors as SIFT's: not negative, unit length; two of them are about .9 apart."""
    raw = rng.random((n, 128)) ** 4
    return (raw / np.linalg.norm(raw, axis=1, keepdims=True)).astype(np.float32)


def pose_at(degrees: float, lens: tuple[float, ...] = BENT, k: F64 = K) -> Pose:
    return Pose(k, camera_on_orbit(degrees, 8.0, 0.7, np.zeros(3)), lens)  # type: ignore[arg-type]


def world(
    degrees: list[float], count: int = 400, others: int = 300, share: float = 1.0, kinds: int | None = None,
    noise: float = 0.2, seed: int = 0, lens: tuple[float, ...] = BENT,
) -> World:  # fmt: skip
    """Photos at these angles. others: features of nothing, in each photo. share: of the points that a photo shows.
    kinds: number of different descriptors, so that points look alike; None: as many as points."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= 0.11 / np.linalg.norm(points, axis=1, keepdims=True)
    look = unit(rng, count) if kinds is None else unit(rng, kinds)[np.arange(count) % kinds]
    poses, features, seen = [], [], []
    for angle in degrees:
        pose = pose_at(angle, lens)
        uv, _ = project(pose.K, inverse_rigid(pose.world_from_cam), np.array(pose.distortion), points)
        shown = np.nonzero(rng.random(count) < share)[0]
        own = look[shown] + rng.normal(0, 0.01, (len(shown), 128)).astype(np.float32)
        at = np.concatenate([uv[shown] + rng.normal(0, noise, (len(shown), 2)), rng.uniform((0, 0), SIZE, (others, 2))])
        both = np.concatenate([own, unit(rng, others)])
        both /= np.linalg.norm(both, axis=1, keepdims=True)
        poses.append(pose)
        features.append(Features(at.astype(np.float32), both.astype(np.float32)))
        seen.append(np.stack([np.arange(len(shown)), shown], 1))
    return World(points, poses, features, seen)


def moved(pose: Pose, degrees: float) -> Pose:
    """The camera turned around the origin."""
    a = np.radians(degrees)
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    return Pose(pose.K, turn @ pose.world_from_cam, pose.distortion)


def apart(a: Pose, b: Pose) -> tuple[float, float]:
    """Distance of the centres and angle in degrees."""
    turn = np.trace(a.world_from_cam[:3, :3].T @ b.world_from_cam[:3, :3])
    angle = float(np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1))))
    return float(np.linalg.norm(a.world_from_cam[:3, 3] - b.world_from_cam[:3, 3])), angle
