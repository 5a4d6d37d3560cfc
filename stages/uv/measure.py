"""How good the charts are.

Symbols
    J       2 x 3 -> the map from texture to surface of one triangle; columns S_u, S_v
    L2      sqrt((S_u . S_u + S_v . S_v) / 2), root mean square stretch of a triangle [Sander 2001, section 3]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import meshes, raster
from pipeline.meshes import F64, Charts, Mesh
from stages.uv.unwrap import chart_of_face, signed_areas

RASTER = 1024  # texels: fine enough for charts of a head, quick enough to run always
TINY_CHART = 5e-4  # of the area: smaller charts are crumbs


@dataclass(frozen=True, slots=True)
class Quality:
    """charts; crumbs: charts with next to no area; utilisation: share of texels under a chart; overlap: share of
    those under two; stretch: L2, 1 is the best; flipped, empty: share of the area whose charts are mirrored or flat."""

    charts: int
    crumbs: int
    utilisation: float
    overlap: float
    stretch: float
    flipped: float
    empty: float


def measure(mesh: Mesh, charts: Charts) -> Quality:
    """Every figure of a finished unwrap."""
    uv_area = signed_areas(charts.uvs.astype(np.float64), charts.faces)
    area = meshes.areas(mesh.vertices, mesh.faces)
    share = area / area.sum()
    label = chart_of_face(charts.faces, len(charts.uvs))
    layers = raster.layers(raster.texel_corners(charts, RASTER), RASTER)
    covered = int((layers > 0).sum())
    flat = np.abs(uv_area) < 1e-12
    return Quality(
        charts=int(label.max()) + 1,
        crumbs=int((np.bincount(label, share) < TINY_CHART).sum()),
        utilisation=covered / RASTER**2,
        overlap=float((layers > 1).sum() / max(covered, 1)),
        stretch=stretch(mesh, charts, ~flat),
        flipped=float(share[(uv_area < 0) & ~flat].sum()),
        empty=float(share[flat].sum()),
    )


def stretch(mesh: Mesh, charts: Charts, use: meshes.Mask | None = None) -> float:
    """Area-weighted L2 over the mesh, with the texture scaled so that both areas agree; 1 for an isometry.

    L2(M)^2 = sum_T L2(T)^2 A(T) / sum_T A(T) * (sum A' / sum A)
    """
    keep = np.ones(len(mesh.faces), np.bool_) if use is None else use
    x = mesh.vertices.astype(np.float64)[mesh.faces[keep]]
    t = charts.uvs.astype(np.float64)[charts.faces[keep]]
    e1, e2, d1, d2 = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    twice: F64 = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    s_u = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) / twice[:, None]
    s_v = (e2 * d1[:, :1] - e1 * d2[:, :1]) / twice[:, None]
    square = 0.5 * ((s_u * s_u).sum(1) + (s_v * s_v).sum(1))
    area = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
    scale = 0.5 * np.abs(twice).sum() / area.sum()
    return float(np.sqrt((square * area).sum() / area.sum() * scale))
