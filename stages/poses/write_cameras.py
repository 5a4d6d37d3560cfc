"""Writes cameras and sparse points in asset coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.artifacts import Camera, CameraSet
from pipeline.capture_artifacts import CaptureView
from pipeline.contract import Context
from pipeline.transforms import F64, apply, matrix, rescale_camera, rows

if TYPE_CHECKING:
    from stages.poses.mapper import Model
    from stages.poses.normalise import Normalisation


def camera_of(view: CaptureView, K: F64, world_from_cam: F64, distortion: Sequence[float]) -> Camera:
    """A view's camera in the capture's world. K (3, 3) pixels; world_from_cam (4, 4); distortion k1 k2 p1 p2 k3."""
    k1, k2, p1, p2, k3 = distortion
    return Camera(
        index=view.index,
        name=view.name,
        width=view.width,
        height=view.height,
        K=rows(K),
        world_from_cam=rows(world_from_cam),
        distortion=(k1, k2, p1, p2, k3),
    )


def in_asset(cameras: Sequence[Camera], capture_from_asset: F64) -> tuple[Camera, ...]:
    """The same cameras with `world_from_cam` in asset coordinates. capture_from_asset: (4, 4) similarity."""
    asset_from_capture: F64 = np.asarray(np.linalg.inv(capture_from_asset), np.float64)
    return tuple(
        c.model_copy(update={"world_from_cam": rows(rescale_camera(asset_from_capture, matrix(c.world_from_cam)))})
        for c in cameras
    )


def save_points(path: Path, model: Model, capture_from_asset: F64) -> None:
    """Write the sparse points. npz: points (M, 3) float32 in asset coordinates, error_px (M,), track (M,) photos per
    point."""
    asset_from_capture: F64 = np.asarray(np.linalg.inv(capture_from_asset), np.float64)
    np.savez(
        path,
        points=apply(asset_from_capture, model.points).astype(np.float32),
        error_px=model.error_px.astype(np.float32),
        track=model.track.astype(np.int32),
    )


def sparse_points(found: CameraSet, folder: Path) -> F64 | None:
    """(M, 3) the points that `save_points` wrote into the artifact's folder; None if there are none."""
    if found.points is None:
        return None
    with np.load(folder / found.points.path, allow_pickle=False) as data:
        return np.asarray(data["points"], np.float64)


def view_errors(model: Model, names: Sequence[str]) -> dict[str, float]:
    """Mean reprojection error in pixels of each view that has one, by name. names: of the model's photos."""
    return {names[i]: round(e, 4) for i, e in sorted(model.view_error_px.items()) if e == e}


def camera_set(
    source: Literal["given", "colmap"],
    cameras: Sequence[Camera],
    found: Normalisation,
    model: Model | None,
    names: Sequence[str],
    left_out: Sequence[str],
    warnings: Sequence[str],
    context: Context,
) -> CameraSet:
    """The manifest: `cameras` (capture's world) in asset coordinates, and the sparse points if there are any, which are
    written to a file.

    names: of the model's photos. left_out: photos without a camera.
    """
    if model is not None:
        save_points(context.workdir / "points.npz", model, found.capture_from_asset)
    return CameraSet(
        source=source,
        metric=found.metric,
        scale=found.scale,
        capture_from_asset=rows(found.capture_from_asset),
        roi_radius=found.roi_radius,
        cameras=in_asset(cameras, found.capture_from_asset),
        unregistered=tuple(left_out),
        reprojection_error_px=None if model is None else model.reprojection_error_px,
        view_errors_px={} if model is None else view_errors(model, names),
        points=None if model is None else context.file("points.npz"),
        warnings=tuple(warnings),
    )
