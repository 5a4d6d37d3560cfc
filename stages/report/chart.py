"""What the colour chart says of the fit: its own errors, and whether the fitted light would light it as it was lit.

Symbols: n normal of the chart; E(n) irradiance of the fitted light, without shadows; a perfect white sends E(n) / pi.
In the photos it sent the chart's level. Both are alike if the chart stood in the light that fell on the head, out of
shadows, and the fitted light has the right scale. If they are f : 1, the chart bears out f times the albedo.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Protocol

import cv2
import numpy as np

from pipeline.artifacts import Camera, CameraSet, Capture, FittedFace, Located
from pipeline.colour import LUMA
from pipeline.transforms import F64, matrix, undistort

COLUMNS, ROWS = 6, 4  # patches are as far apart in both directions
PLACES: F64 = np.array([[-COLUMNS, -ROWS], [COLUMNS, -ROWS], [COLUMNS, ROWS], [-COLUMNS, ROWS]], np.float64)


class Charted(Protocol):
    """The artifacts that this is about."""

    @property
    def capture(self) -> Located[Capture]: ...
    @property
    def poses(self) -> Located[CameraSet]: ...
    @property
    def inverse_rendering(self) -> Located[FittedFace]: ...


def chart_figures(r: Charted) -> dict[str, Any]:
    """Of each camera that saw one; `found` alone where there was none."""
    chart = r.capture.artifact.chart
    if chart is None:
        return {"found": 0}
    out: dict[str, Any] = {
        "found": len(chart.photos),
        "fixes": "white balance, and the photos' unit; not the albedo's scale",
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
    """(3,) unit normal in asset coordinates, towards the camera, of a chart whose corners (4, 2) are seen in a photo.

    The first two columns of K^-1 H, H from the chart's plane to pixels, lie along its edges.
    """
    K, world_from_cam = matrix(camera.K), matrix(camera.world_from_cam)
    flat = np.linalg.solve(K[:2, :2], (np.array(corners, np.float64) - K[:2, 2]).T).T
    plane = undistort(np.asarray(flat, np.float64), np.array(camera.distortion, np.float64))
    # in pixels of a nominal lens, because OpenCV solves it in float32
    H = cv2.getPerspectiveTransform(PLACES.astype(np.float32), (plane * 1e3).astype(np.float32))
    edges = np.diag([1e-3, 1e-3, 1]) @ np.asarray(H, np.float64)
    n = np.cross(edges[:, 0], edges[:, 1])
    n *= -np.sign(n @ edges[:, 2]) / np.linalg.norm(n)  # the third column is where the chart's middle is
    return np.asarray(world_from_cam[:3, :3] @ n, np.float64)


def white_under(coefficients: F64, normal: F64) -> F64:
    """(3,) radiance E(n) / pi of a perfect white, of a light ((L + 1)^2, 3)."""
    import torch

    from pipeline.maths import sh

    E = sh.irradiance(torch.from_numpy(coefficients), torch.from_numpy(normal[None]))
    return np.asarray(E[0].numpy() / np.pi, np.float64)
