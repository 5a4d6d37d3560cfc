"""Reconstructions of one subject that share photos, put together.

COLMAP's mapper ends a model when no further photo can be registered, and starts another from photos that may already
be in the first. Which photos end up where depends on its first pair and on chance: of one capture of 66 photos under a
flash, 44 or 64 got a camera. Where two models share photos, the similarity between them is known by these, and all
photos get a camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.colmap import pycolmap
from stages.poses.bundle_adjustment import Refine, adjust
from stages.poses.known_poses import with_points, with_poses

INLIERS, LIMIT = 0.3, 8.0  # COLMAP's own: least share of the observations of shared photos; their error in pixels
FINAL_LIMIT = 4.0  # pixels: the mapper's own limit of a point's error


def merged(models: Sequence[Any], database: Path, scratch: Path, seed: int) -> list[Any]:
    """The models, the largest first, with those that fit the first by common photos merged into it.

    A model that does not fit stays on its own. scratch: a folder for COLMAP's files, made here.
    """
    if len(models) < 2:
        return list(models)
    rest = list(models[1:])
    poses, cameras = _poses(models[0]), dict(models[0].cameras)
    first = models[0]
    while True:  # a model may be linked to the first by another one
        fitting = next(((n, s) for n, m in enumerate(rest) if (s := similarity(m, first)) is not None), None)
        if fitting is None:
            break
        other, onto = rest.pop(fitting[0]), fitting[1]
        other.transform(onto)
        poses, cameras = {**_poses(other), **poses}, {**dict(other.cameras), **cameras}
        scratch.mkdir(exist_ok=True)
        first = with_points(with_poses(database, poses, cameras), database, scratch, LIMIT, seed)
        adjust(first, Refine(focal=False, distortion=False), principal_point=False)
        first = with_points(first, database, scratch, FINAL_LIMIT, seed)
        poses = _poses(first)
    return [first, *rest]


def similarity(source: Any, target: Any) -> Any | None:
    """The similarity (pycolmap.Sim3d) that maps `source` onto `target`; None unless they share three photos or more
    whose points meet the other's photos (RANSAC over the shared photos)."""
    return pycolmap.align_reconstructions_via_reprojections(source, target, INLIERS, LIMIT)


def _poses(model: Any) -> dict[str, Any]:
    """cam_from_world (3, 4) by image name."""
    return {i.name: np.asarray(i.cam_from_world().matrix()) for i in model.images.values() if i.has_pose}
