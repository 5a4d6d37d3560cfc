"""Stretch of triangles, and charts that are split because of it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from pipeline.meshes import Mesh
from stages.uv import charts as of_charts
from stages.uv.chart_quality import measure
from stages.uv.charts import unwrapped
from stages.uv.stretch import STRETCHED, stretches


def test_stretch_is_the_singular_values_of_the_map() -> None:
    """Oracle: J by least squares from the edges, its singular values by numpy, scaled to equal areas."""
    rng = np.random.default_rng(0)
    x, t = rng.normal(size=(20, 3, 3)), rng.uniform(size=(20, 3, 2))
    l2, most, area = stretches(x, t)
    edges = [(p[:, 1:] - p[:, :1]) for p in (x, t)]
    in_uv = 0.5 * np.abs(np.linalg.det(edges[1]))
    expected = 0.5 * np.linalg.norm(np.cross(edges[0][:, 0], edges[0][:, 1]), axis=1)
    np.testing.assert_allclose(area, expected)
    scale = np.sqrt(in_uv.sum() / expected.sum())
    for i in range(20):
        j = np.linalg.solve(edges[1][i], edges[0][i]).T  # J d = e for both edges
        s = scale * np.linalg.svd(j, compute_uv=False)
        assert most[i] == pytest.approx(s[0], rel=1e-9) and l2[i] == pytest.approx(np.sqrt((s**2).mean()), rel=1e-9)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_an_isometry_has_stretch_one_at_any_scale(scale: float) -> None:
    t = np.random.default_rng(1).uniform(size=(5, 3, 2))
    x = (
        scale
        * np.concatenate([t, np.zeros((5, 3, 1))], -1)
        @ np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    )
    l2, most, _ = stretches(x, 0.01 * t)
    np.testing.assert_allclose(np.stack([l2, most]), 1.0, rtol=1e-4)


def test_a_thin_sliver_has_a_finite_stretch() -> None:
    x = np.array([[[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0]], [[0, 0, 0], [1, 0, 0], [0.5, 1, 0]]])
    t = np.array([[[0.0, 0], [1, 0], [0.5, 1]], [[0, 0], [1, 0], [0.5, 1e-9]]])
    most = stretches(x, t)[1]
    assert np.isfinite(most).all() and most[1] > 1e6


def hat() -> Mesh:
    """A paraboloid, open below, three times as high as its radius: laid flat in one piece, it has a long brim."""
    made = trimesh.creation.icosphere(4, 0.1)
    made.vertices[:, 2] = 3 * np.maximum(made.vertices[:, 2], 0)
    made.update_faces(made.triangles_center[:, 2] > 1e-4)
    made.remove_unreferenced_vertices()
    vertices, normals = (np.asarray(a, np.float32) for a in (made.vertices, made.vertex_normals))
    return Mesh(vertices, normals, np.asarray(made.faces, np.int32))


def test_a_hat_in_one_piece_is_split(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = hat()
    smooth = mesh.vertices.astype(np.float64)
    monkeypatch.setattr(of_charts, "segment", lambda vertices, faces, pairs, quads: np.zeros(len(faces), np.int64))
    for rule, value in (("LARGE", 2.0), ("GOOD_UTILISATION", 0.0)):  # no other rule splits it
        monkeypatch.setattr(of_charts, rule, value)
    found = []
    for most in (of_charts.MOST_STRETCHED, np.inf):
        monkeypatch.setattr(of_charts, "MOST_STRETCHED", most)
        charts = unwrapped(mesh, smooth, 4 / 512)
        assert charts is not None
        found.append(measure(mesh, charts))
    split, whole = found
    assert whole.stretched > 0.03 and whole.stretch_max > STRETCHED
    assert split.stretched < 0.005 and whole.charts < split.charts <= 6
