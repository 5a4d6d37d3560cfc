"""The layout of the texture: seams and texel density of a mesh whose charts are known."""

from __future__ import annotations

import numpy as np
import pytest
from support.synthetic_results import write_results

from pipeline.meshes import Charts, Mesh
from stages.report.uv_layout import HIGH, LOW, SEAM, drawn, seams, texel_mm, uv_layout

# two charts: a square of two triangles, 0.4 x 0.4 of the texture, and a triangle
UVS = np.array([[0.1, 0.1], [0.5, 0.1], [0.5, 0.5], [0.1, 0.5], [0.6, 0.6], [0.9, 0.6], [0.9, 0.9]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], np.int32)
POINTS = np.concatenate([UVS, np.zeros((7, 1), np.float32)], 1)  # metres: a texture square of 1 is 1 m


def square() -> tuple[Mesh, Charts]:
    return Mesh(POINTS, np.zeros_like(POINTS), FACES), Charts(UVS, FACES)


def test_seams_are_the_edges_of_charts() -> None:
    """The square's diagonal is inside of a chart."""
    assert seams(square()[1]).tolist() == [[0, 1], [0, 3], [1, 2], [2, 3], [4, 5], [4, 6], [5, 6]]


def test_the_edge_of_a_texel() -> None:
    """1 m over 1,000 texels is 1 mm; a surface twice as large in one direction has sqrt(2) mm; no area has no edge."""
    mesh, charts = square()
    assert texel_mm(mesh, charts, [1000]) == pytest.approx(1, rel=1e-5)
    wide = Mesh(POINTS * np.float32([2, 1, 1]), mesh.normals, mesh.faces)
    assert texel_mm(wide, charts, [1000]) == pytest.approx(2**0.5, rel=1e-5)
    flat = Charts(np.where(np.arange(7)[:, None] < 4, UVS, 0).astype(np.float32), FACES)
    assert texel_mm(mesh, flat, [1000])[2] == np.inf


def test_the_drawing_has_charts_seams_and_paper() -> None:
    picture = drawn(square()[1], np.array([LOW, LOW, HIGH]), 400)
    assert (picture[380, 380] == 255).all() and (picture[5, 5] == 255).all()
    low, high = picture[400 - 80, 140], picture[400 - 270, 340]  # v is up
    assert int(low[2]) > int(low[0]) and int(high[0]) > int(high[2])  # dark blue, yellow
    assert np.abs(picture[400 - 120, 200].astype(int) - SEAM).max() < 60  # right edge of the square
    assert np.abs(picture[400 - 110, 110].astype(int) - SEAM).max() > 60  # on its diagonal


def test_tiles_lie_side_by_side(tmp_path) -> None:
    for tiled in (False, True):
        found = uv_layout(write_results(tmp_path / str(tiled), tiled=tiled), 100)
        assert found.uri.startswith("data:image/jpeg") and "seams" in found.caption
    _, charts = square()
    assert drawn(Charts(UVS + np.float32([1, 0]), FACES), np.ones(3), 50).shape == (50, 100, 3)
