"""The geometry's start: the visual hull of the masks as a signed distance on the coarsest grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.fields.geometry import GridSdf
from pipeline.hull import hull_bounds, hull_sdf, visual_hull

F32 = npt.NDArray[np.float32]
SPHERE = 0.6  # share of the region of interest's radius
MARGIN_CELLS = 4  # room for the band and the spline's border around the hull


@dataclass(frozen=True, slots=True)
class Start:
    """Where the geometry begins: SDF samples (X, Y, Z) at lo + i cell, asset units."""

    values: F32
    lo: F32
    cell: float

    def surface(self, device: str) -> GridSdf:
        """A copy of the samples that rays can meet."""
        values, lo = (torch.from_numpy(a.astype(np.float32)) for a in (self.values, self.lo))
        return GridSdf(values, lo, self.cell).to(device)


def hull_start(cameras: list[Camera], alphas: list[F32], roi_radius: float, cells: int, levels: int) -> Start:
    """SDF samples of the hull, at a spacing that `levels` - 1 halvings bring to 1 / `cells` of the hull's longest side.

    Raises StageError if the masks leave nothing.
    """
    lo, hi = hull_bounds(cameras, alphas, roi_radius)
    cell = float((hi - lo).max()) / cells * 2 ** (levels - 1)
    lo, hi = lo - MARGIN_CELLS * cell, hi + MARGIN_CELLS * cell
    hull = visual_hull(cameras, alphas, lo, hi, cell)
    if not hull.occupied.any():
        raise StageError(
            "the masks have no common body",
            where="inverse_rendering",
            value="an empty visual hull",
            limit="at least one voxel inside every view's silhouette",
            remedy="look at the masks and the cameras: one of them is wrong, or views show different subjects",
        )
    return Start(hull_sdf(hull).astype(np.float32), (hull.lo + 0.5 * cell).astype(np.float32), cell)


def sphere_start(radius: float, cells: int, levels: int) -> Start:
    """A sphere of SPHERE of the region of interest: what a fit starts from that knows nothing of the subject."""
    cell = 2 * radius / cells * 2 ** (levels - 1)
    n = int(np.ceil(radius / cell)) + MARGIN_CELLS
    axis = (np.arange(-n, n + 1) * cell).astype(np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    values = np.sqrt(x * x + y * y + z * z) - SPHERE * radius
    return Start(values.astype(np.float32), np.full(3, axis[0], np.float32), cell)
