"""Size of a pixel on the surface, and the resolution of grid, encoding and texture that the photos support.

The footprint is that of pipeline.footprint, for the blocks of pixels that the fit averages.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.fields.face import FaceModel
from pipeline.footprint import edges
from stages.inverse_rendering.config import AUTO, Config
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView, factor_for

F64 = npt.NDArray[np.float64]
CELL_PIXELS = 1.0  # smallest cell of the grid, in pixels
FINE_PIXELS = 0.5  # smallest cell of the encoding, in pixels: views overlap, so half a pixel still has data
UTILISATION = 0.65  # share of a texture that its charts cover
MAX_POINTS = 20_000


@dataclass(frozen=True, slots=True)
class Footprint:
    """pixel: median edge of a pixel on the surface, asset units; area of the surface, asset units squared."""

    pixel: float
    area: float

    @property
    def texture(self) -> int:
        """Side of a square texture with one texel per pixel, rounded up to a power of two."""
        side = float(np.sqrt(self.area / UTILISATION) / self.pixel)
        return int(2 ** np.ceil(np.log2(max(side, 16))))

    def facts(self, settings: Config, model: FaceModel) -> dict[str, str | float | bool]:
        """For the report."""
        return {
            "pixel_mm": round(self.pixel * 1e3, 4),
            "grid_cell_mm": round(model.geometry.cell * 1e3, 4),
            "encoding_mm": round(model.spec.hash_fine * 1e3, 4),
            "texture_supported": self.texture,
            "why": "no finer than the photos' pixels on the surface" if settings.resolution == AUTO else "setting",
        }


def footprint(start: Start, views: list[PhotoView], side: int) -> Footprint | None:
    """The footprint of photos fitted at `side` pixels on the initial geometry; None if no view faces the surface."""
    points, normals, area = surface_of(start)
    best = np.full(len(points), np.inf)
    for view in views:
        block = factor_for(view.size, side)
        camera = view.K, view.world_from_cam, view.distortion
        best = np.minimum(best, edges(points, normals, *camera, view.size, block))
    known = best[np.isfinite(best)]
    return Footprint(float(np.median(known)), area) if len(known) else None


def surface_of(start: Start, most: int = MAX_POINTS) -> tuple[F64, F64, float]:
    """Points (N, 3) on the zero set, not many more than `most`, their normals (N, 3), and its area (voxel faces times
    2 / 3, the mean ratio over directions of a slope to its staircase)."""
    values = start.values
    inner = np.abs(values[1:-1, 1:-1, 1:-1]) < 0.75 * start.cell
    near = np.argwhere(inner) + 1
    near = near[:: max(len(near) // most, 1)]
    i, j, k = near.T
    sides = [
        values[i + 1, j, k] - values[i - 1, j, k],
        values[i, j + 1, k] - values[i, j - 1, k],
        values[i, j, k + 1] - values[i, j, k - 1],
    ]
    g = np.stack(sides, -1).astype(np.float64) / (2 * start.cell)
    length = np.linalg.norm(g, axis=1).clip(min=1e-9)
    normals = g / length[:, None]
    points = start.lo + near * start.cell - (values[i, j, k] / length)[:, None] * normals
    inside = values < 0
    faces = sum(int((np.diff(inside, axis=a) != 0).sum()) for a in range(3))
    return points, normals, faces * start.cell**2 * 2 / 3


def supported(settings: Config, looked: Footprint | None, start: Start) -> Config:
    """The settings with a grid and an encoding that the photos support."""
    if looked is None:
        return settings
    finest = start.cell / 2 ** (settings.levels - 1)
    cells = int(settings.grid_cells * min(finest / (CELL_PIXELS * looked.pixel), 1.0))
    return settings.changed(
        grid_cells=max(cells, 16),
        hash_fine=max(settings.hash_fine, FINE_PIXELS * looked.pixel),
    )
