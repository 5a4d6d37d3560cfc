"""Figures of the colour checker: its fit error, and a comparison of the fitted light with the light on the checker.

Symbols: n normal of the checker; E(n) irradiance of the fitted light, without shadows. The radiance of a perfect white
is E(n) / pi under the fitted light, and `level` in the photos. Both are equal if the checker was in the same light as
the head, without shadows, and the scale of the fitted light is right. If their ratio is f, the true albedo is f times
the fitted one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Protocol

import cv2
import numpy as np

from pipeline.artifacts import Camera, CameraSet, FittedFace, Located
from pipeline.capture_artifacts import Capture
from pipeline.colour import LUMA
from pipeline.transforms import F64, matrix, undistort

COLUMNS, ROWS = 6, 4  # patches have the same distance in both directions
PLACES: F64 = np.array([[-COLUMNS, -ROWS], [COLUMNS, -ROWS], [COLUMNS, ROWS], [-COLUMNS, ROWS]], np.float64)


class Charted(Protocol):
    """The artifacts that are read."""

    @property
    def capture(self) -> Located[Capture]: ...
    @property
    def poses(self) -> Located[CameraSet]: ...
    @property
    def inverse_rendering(self) -> Located[FittedFace]: ...


def chart_figures(r: Charted) -> dict[str, Any]:
    """Figures for each camera that saw a colour checker; only `found` if there was none."""
    chart = r.capture.artifact.chart
    if chart is None:
        return {"found": 0}
    out: dict[str, Any] = {
        "found": len(chart.photos),
        "fixes": "white balance and the unit of the photos, not the scale of the albedo",
    }
    cameras = {c.index: c for c in r.poses.artifact.cameras}
    path = r.inverse_rendering.path(r.inverse_rendering.artifact.light)
    coefficients = np.array(json.loads(path.read_text())["coefficients"], np.float64)
    for fit in chart.fits:
        name = fit.camera_group or "camera"
        out[f"{name}: error of its patches"] = fit.error
        out[f"{name}: white before"] = ", ".join(f"{w:.3f}" for w in fit.white)
        if fit.index in cameras:
            lit = white_under(coefficients, normal_of(fit.corners, cameras[fit.index]))
            out[f"{name}: fitted light on it, of what fell on it"] = round(float(lit @ np.array(LUMA)) / chart.level, 4)
    return out


def normal_of(corners: Sequence[Sequence[float]], camera: Camera) -> F64:
    """(3,) unit normal, in asset coordinates and towards the camera, of a checker with corners (4, 2) in pixels.

    The first two columns of K^-1 H, with H from the checker's plane to pixels, are along its edges.
    """
    K, world_from_cam = matrix(camera.K), matrix(camera.world_from_cam)
    flat = np.linalg.solve(K[:2, :2], (np.array(corners, np.float64) - K[:2, 2]).T).T
    plane = undistort(np.asarray(flat, np.float64), np.array(camera.distortion, np.float64))
    # in pixels of a nominal lens, because OpenCV computes H in float32
    H = cv2.getPerspectiveTransform(PLACES.astype(np.float32), (plane * 1e3).astype(np.float32))
    edges = np.diag([1e-3, 1e-3, 1]) @ np.asarray(H, np.float64)
    n = np.cross(edges[:, 0], edges[:, 1])
    n *= -np.sign(n @ edges[:, 2]) / np.linalg.norm(n)  # the third column points to the checker's centre
    return np.asarray(world_from_cam[:3, :3] @ n, np.float64)


def white_under(coefficients: F64, normal: F64) -> F64:
    """(3,) radiance E(n) / pi of a perfect white, of a light ((L + 1)^2, 3)."""
    import torch

    from pipeline.maths import sh

    E = sh.irradiance(torch.from_numpy(coefficients), torch.from_numpy(normal[None]))
    return np.asarray(E[0].numpy() / np.pi, np.float64)
