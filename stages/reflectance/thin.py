"""Thin sheets at outlines, above all ears, which stay as they came where the outline would recede.

Cameras hardly agree there: within the thickness of an ear they see other sides of it, and a few millimetres away
another sheet of surface. Moved to where they agree, ears get thinner, and what they covered becomes background, which
is a large error. A fold of the surface by mistake is thin as well, but nobody misses it: held are vertices that an
outline has left behind where the pictures show the subject.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.images import read_linear
from pipeline.meshes import Mesh
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64, inverse_rigid, project

Mask = npt.NDArray[np.bool_]
THIN, THICK = 0.008, 0.014  # asset units (metres): up to THIN it is a sheet, from THICK on it is not
START = 1e-4  # rays start this far below the surface
RIM = 4  # edges from a sheet's sides over its rim, whose normals lie along the sheet; and around what was left behind
AVERAGES = 4  # times that shares are averaged over neighbours
EVERY, BRIGHT, DARK = 3, 0.98, 0.02  # every how many lights; below this share of this quantile a pixel is background
BLUR = 1  # pixels at the border of the subject that count as background
LOST = 2e-3  # asset units (metres) beyond the outline in a camera: a vertex there was left behind


class Held:
    """share (V,): how far vertices of `first` are held, 0 to 1. mean: sparse (V, V) average over neighbours; shown
    (H, W): of each camera, where its pictures show the subject."""

    def __init__(self, first: Mesh, mean: Any, shown: Sequence[Mask]) -> None:
        self._first, self._mean, self._shown = first, mean, shown
        self._thin = spread(thin(first), first, mean)
        self._lost = np.zeros(len(first.vertices))
        self.share: F64 = np.zeros(len(first.vertices))

    def grow(self, views: Sequence[Any], outlines: Sequence[F64]) -> None:
        """Hold also what lies outside of these outlines (reshape.outline) of the mesh as it is now."""
        for view, outside, shown in zip(views, outlines, self._shown, strict=True):
            self._lost[beyond(self._first.vertices.astype(np.float64), view, outside, shown)] = 1
        self.share = self._thin * spread(self._lost, self._first, self._mean)


def thickness(mesh: Mesh) -> F64:
    """(V,) way from each vertex against its normal to the other side; infinite where there is none."""
    normals = mesh.normals.astype(np.float64)
    return RayCaster(mesh.vertices, mesh.faces).distances(mesh.vertices - START * normals, -normals)


def thin(mesh: Mesh) -> F64:
    """(V,) 1 on thin sheets, 0 elsewhere, without a step between."""
    return np.asarray(np.clip((THICK - thickness(mesh)) / (THICK - THIN), 0, 1), np.float64)


def subject(pictures: Mapping[tuple[int, int], Path], camera: int) -> Mask:
    """(H, W) where the pictures of a camera under single lights are not dark."""
    paths = [path for (c, _), path in sorted(pictures.items()) if c == camera][::EVERY]
    total = sum((read_linear(path).max(2) for path in paths), np.zeros((1, 1), np.float32))
    from scipy.ndimage import binary_erosion

    lit = total > DARK * np.quantile(total, BRIGHT)
    return np.asarray(binary_erosion(lit, iterations=BLUR, border_value=1), np.bool_)


def beyond(vertices: F64, view: Any, outside: F64, shown: Mask) -> Mask:
    """(V,) vertices (V, 3) in the frame that lie farther than LOST outside of an outline (H, W), pixels, on the subject
    `shown` of the same camera in any size."""
    from scipy.ndimage import map_coordinates

    uv, depth = project(view.K, inverse_rigid(view.world_from_cam), view.distortion, vertices)
    inside = (depth > 0) & ((uv > 0.5) & (uv < np.array([view.width, view.height]) - 0.5)).all(1)
    near = np.flatnonzero(inside)
    far = map_coordinates(outside, (uv[near] - 0.5).T[::-1], order=1, mode="nearest") * depth[near] / view.K[0, 0]
    height, width = shown.shape
    column, row = (uv[near] * [width / view.width, height / view.height]).astype(np.int64).T
    out = np.zeros(len(vertices), np.bool_)
    out[near] = (far > LOST) & shown[np.minimum(row, height - 1), np.minimum(column, width - 1)]
    return out


def spread(values: F64, mesh: Mesh, mean: Any) -> F64:
    """(V,) values grown by RIM edges, then averaged."""
    for _ in range(RIM):
        grown = values.copy()
        top = values[mesh.faces].max(1)
        for k in range(3):
            np.maximum.at(grown, mesh.faces[:, k], top)
        values = grown
    for _ in range(AVERAGES):
        values = mean @ values
    return np.asarray(values, np.float64)
