"""Figures of the quality of charts.

Symbols
    L2, Linf    stretch of a triangle (stretch.py)
    front       where the normal is within 60 degrees of FRONT
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import meshes, raster, tiles
from pipeline.meshes import F64, Charts, Mesh
from stages.uv.density import face_share
from stages.uv.parameterise import signed_areas
from stages.uv.rough import FRAGMENT
from stages.uv.segment import FRONT
from stages.uv.stretch import STRETCHED, stretches
from stages.uv.unwrap import chart_of_face, evened

RASTER = 1024  # texels: fine enough for charts of a head, and fast
FACING = 0.5


@dataclass(frozen=True, slots=True)
class Quality:
    """charts: their number; fragments: charts with less than FRAGMENT of the area; utilisation: share of texels under a
    chart; overlap: share of those under two faces; stretch: L2, stretch_max: the largest Linf, 1 is the best; flipped,
    empty: share of the area that is mirrored or without area in the texture; seam_front: length (m) of the seams in
    front; tile_utilisation: of each tile; stretched: share of the area with a Linf above STRETCHED; face_share: the
    face's share of the area under charts."""

    charts: int
    fragments: int
    utilisation: float
    overlap: float
    stretch: float
    stretch_max: float
    flipped: float
    empty: float
    seam_front: float
    tile_utilisation: tuple[float, ...]
    stretched: float = 0.0
    face_share: float | None = None


def measure(mesh: Mesh, charts: Charts, face: meshes.Mask | None = None, given: meshes.Mask | None = None) -> Quality:
    """Every figure of a finished unwrap. face: (F,) mask of the triangles of the face; charts then have different
    scales, which do not count as stretch. given: (F,) triangles whose layout is the template's: they do not count as
    stretched, because nobody can change it."""
    uv_area = signed_areas(charts.uvs.astype(np.float64), charts.faces)
    area = meshes.areas(mesh.vertices, mesh.faces)
    share = area / area.sum()
    label = chart_of_face(charts.faces, len(charts.uvs))
    parts = (tiles.single_tile(mesh, charts, t)[1] for t in range(tiles.count(charts)))
    layers = [raster.layers(raster.texel_corners(part, RASTER), RASTER) for part in parts]
    covered = [int((layer > 0).sum()) for layer in layers]
    flat = np.abs(uv_area) < 1e-12
    alike = charts
    if face is not None:
        alike = Charts(evened(charts.uvs.astype(np.float64), charts.faces, area).astype(np.float32), charts.faces)
    mean, most = stretch(mesh, alike, ~flat)
    own = np.ones(len(area), np.bool_) if given is None else ~given
    far = own.copy()
    far[~flat] &= _of_faces(mesh, alike, ~flat)[1] > STRETCHED
    return Quality(
        charts=int(label.max()) + 1,
        fragments=int((np.bincount(label, share) < FRAGMENT).sum()),
        utilisation=sum(covered) / (len(layers) * RASTER**2),
        overlap=float(sum((layer > 1).sum() for layer in layers) / max(sum(covered), 1)),
        stretch=mean,
        stretch_max=most,
        flipped=float(share[(uv_area < 0) & ~flat].sum()),
        empty=float(share[flat].sum()),
        seam_front=seam_length(mesh, charts),
        tile_utilisation=tuple(c / RASTER**2 for c in covered),
        stretched=float(share[far].sum()),
        face_share=None if face is None else face_share(charts, face),
    )


def seam_length(mesh: Mesh, charts: Charts) -> float:
    """Length of the edges in front that are seams: their two faces do not share them in the texture. Mesh units."""
    f, t = mesh.faces, charts.faces
    low, high = (pick(f, np.roll(f, -1, 1)).T.ravel() for pick in (np.minimum, np.maximum))
    order = np.lexsort((high, low))
    first, second = order[:-1], order[1:]
    pair = (low[first] == low[second]) & (high[first] == high[second])
    first, second = first[pair], second[pair]
    ends = [np.concatenate([t[:, i] for i in turn]) for turn in ((0, 1, 2), (1, 2, 0))]
    joined = (ends[0][first] == ends[1][second]) & (ends[1][first] == ends[0][second])
    x = mesh.vertices.astype(np.float64)
    normal = meshes.vertex_normals(x, f).astype(np.float64)
    a, b = low[first], high[first]
    facing = 0.5 * (normal[a] + normal[b]) @ FRONT > FACING
    return float(np.linalg.norm(x[a] - x[b], axis=1)[~joined & facing].sum())


def stretch(mesh: Mesh, charts: Charts, use: meshes.Mask | None = None) -> tuple[float, float]:
    """Area-weighted L2 and largest Linf, with the texture scaled so that both areas are equal; 1 for an isometry. use:
    (F,) faces that count.

    L2(M)^2 = sum_T L2(T)^2 A(T) / sum_T A(T) * (sum A' / sum A)
    """
    keep = np.ones(len(mesh.faces), np.bool_) if use is None else use
    square, larger, area = _of_faces(mesh, charts, keep)
    return float(np.sqrt((square * square * area).sum() / area.sum())), float(larger.max())


def _of_faces(mesh: Mesh, charts: Charts, keep: meshes.Mask) -> tuple[F64, F64, F64]:
    """(N,) L2 and Linf of the faces keep (F,), and their areas."""
    corners, texture = mesh.vertices[mesh.faces[keep]], charts.uvs[charts.faces[keep]]
    return stretches(corners.astype(np.float64), texture.astype(np.float64))
