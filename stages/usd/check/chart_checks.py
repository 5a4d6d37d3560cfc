"""Checks of texture coordinates that the USD library does not make: texels that belong to two places on the surface,
and surface with no texels or with a mirrored texture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pxr import UsdGeom

from pipeline import meshes, raster
from stages.usd.check.findings import Finding

F64 = npt.NDArray[np.float64]
RASTER = 1024  # texels along a side of a tile
MAX_OVERLAP, SOME_OVERLAP = 0.01, 0.002  # of the covered texels: more is an error, a warning
MAX_EMPTY = 0.005  # of the surface
MAX_MIRRORED = 0.02
FLAT = 1e-10  # of a tile, twice the area


def chart_findings(mesh: UsdGeom.Mesh, st: F64) -> list[Finding]:
    """Findings on texture coordinates st (N, 2) of all faces' corners, in the order of the mesh's indices. Faces are
    triangulated as fans."""
    where, counts = str(mesh.GetPath()), np.asarray(mesh.GetFaceVertexCountsAttr().Get(), np.int64)
    corner = meshes.fans(counts)
    points = np.asarray(mesh.GetPointsAttr().Get(), np.float64)
    index = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(), np.int64)
    x, t = points[index[corner]], st[corner]
    area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1)
    share = area / max(float(area.sum()), 1e-30)
    flat = raster.doubled_areas(t)
    out = []
    empty, mirrored = float(share[np.abs(flat) < FLAT].sum()), float(share[flat < -FLAT].sum())
    if empty > MAX_EMPTY:
        out.append(Finding("error", "st", f"{empty:.2%} of the surface has no area in the texture", where))
    if MAX_MIRRORED < mirrored < 1 - MAX_MIRRORED:
        out.append(Finding("warning", "st", f"{mirrored:.1%} of the surface is mirrored in the texture", where))
    twice = overlap(t)
    if twice > SOME_OVERLAP:
        level = "error" if twice > MAX_OVERLAP else "warning"
        text = f"{twice:.2%} of the covered texels belong to two places on the surface, limit {MAX_OVERLAP:.0%}"
        out.append(Finding(level, "st_overlap", text, where))  # type: ignore[arg-type]
    return out


def overlap(triangles: F64) -> float:
    """Share of the covered texels that lie under two or more triangles (F, 3, 2); each tile is tested by itself."""
    tile = np.floor(triangles.mean(1)).astype(np.int64)
    covered = twice = 0
    for one in np.unique(tile, axis=0):
        own = triangles[(tile == one).all(1)] - one
        layers = raster.layers(raster.in_texels(own, RASTER), RASTER)
        covered, twice = covered + int((layers > 0).sum()), twice + int((layers > 1).sum())
    return twice / max(covered, 1)
