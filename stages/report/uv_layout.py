"""The layout of the texture: charts in colours of their texel density, with their seams.

A seam is an edge of a chart: an edge of a triangle in texture space that no other triangle shares. The density is the
edge of a texel on the surface, sqrt(area / texture area) / side of its tile, on the scale of the 3D view's channel.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from pipeline import meshes, tiles
from stages.report.collect import Results
from stages.report.page import Picture
from stages.report.pictures import U8, data_uri, scale_colours

F64 = npt.NDArray[np.float64]
DRAWN = 2  # pixels of the drawing for one of the page: lines are then smooth
LOW, HIGH = 0.1, 3.2  # mm per texel at the scale's ends, as in viewer.py
SEAM = (200, 30, 30)


def uv_layout(r: Results, side: int) -> Picture:
    """The picture, tiles side by side, `side` pixels high."""
    path = r.uv.path(r.uv.artifact.mesh)
    mesh, charts = meshes.load(path), meshes.load_charts(path)
    bake = r.bake.artifact
    mm = texel_mm(mesh, charts, [bake.side(t) for t in range(tiles.count(charts))])
    picture = drawn(charts, mm, DRAWN * side)
    cut = seams(charts)
    caption = (
        f"charts with their seams (red); edge of a texel: {LOW:g} (dark) to {HIGH:g} mm, median {np.median(mm):.2f}"
    )
    return Picture(data_uri(picture, side * tiles.count(charts)), caption + f"; {len(cut)} edges of charts")


def texel_mm(mesh: meshes.Mesh, charts: meshes.Charts, sides: Sequence[int]) -> F64:
    """(F,) edge of a texel on the surface in each triangle, mm; infinite where a triangle has no texture area. sides:
    texels along a side of each tile."""
    corners = charts.uvs.astype(np.float64)[charts.faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    flat = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        edge = 1000 * np.sqrt(meshes.areas(mesh.vertices, mesh.faces) / flat)
        return np.asarray(edge / np.asarray(sides)[tiles.of_face(charts)], np.float64)


def seams(charts: meshes.Charts) -> npt.NDArray[np.int64]:
    """(S, 2) rows of uvs: edges that one triangle has alone."""
    every = np.sort(charts.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), 1)
    edges, counts = np.unique(every, axis=0, return_counts=True)
    return np.asarray(edges[counts == 1], np.int64)


def drawn(charts: meshes.Charts, mm: F64, size: int) -> U8:
    """(size, tiles size, 3) RGB."""
    picture = np.full((size, size * tiles.count(charts), 3), 255, np.uint8)
    places = np.round((charts.uvs.astype(np.float64) * [1, -1] + [0, 1]) * size).astype(np.int32)
    share = np.log2(np.maximum(np.nan_to_num(mm, posinf=HIGH), 1e-9) / LOW) / np.log2(HIGH / LOW)
    colours = scale_colours()[np.round(share.clip(0, 1) * 255).astype(np.uint8)]
    for corners, colour in zip(places[charts.faces], colours.tolist(), strict=True):
        cv2.fillConvexPoly(picture, corners, colour)
    cv2.polylines(picture, list(places[seams(charts)]), False, SEAM, max(1, size // 300), cv2.LINE_AA)
    return picture
