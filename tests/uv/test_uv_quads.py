"""Quads: as many as asked for, regular, on the dense mesh, with seams around them, and through the whole way to USD."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from support.synthetic_asset import run_stage, write_inputs

from pipeline import meshes
from pipeline.artifacts import Located
from pipeline.errors import StageError
from pipeline.meshes import Mesh
from stages.surface.build import build as surface_build
from stages.usd.check.validate import validate
from stages.usd.render.exported import read_usd_mesh
from stages.usd.write.mesh import read_mesh
from stages.uv import decimate, quads
from stages.uv.build import Built, build
from stages.uv.config import Config
from tests.support.analytic_fields import AnalyticField, bumpy_head

pytest.importorskip("pyinstantmeshes")


@pytest.fixture(scope="module")
def dense() -> Mesh:
    return surface_build(AnalyticField(bumpy_head(0.001, 60.0)), 64, lambda *_: None).mesh


@pytest.fixture(scope="module")
def made(dense: Mesh) -> Built:
    config = Config(target_faces=3000, proxy_faces=800, texture_size=512, padding=4, remesh="quads")
    return build(dense, config, lambda *_: None)


def corners(mesh: Mesh) -> np.ndarray:
    """(Q, 4) of a mesh whose faces are pairs."""
    return meshes.polygons(mesh.faces, np.ones(len(mesh.faces) // 2, bool))[1].reshape(-1, 4)


@pytest.mark.slow
def test_quads_are_regular_and_lie_on_the_surface(dense: Mesh, made: Built) -> None:
    found = corners(made.mesh)
    assert abs(len(found) - 1500) < 0.1 * 1500
    assert meshes.topology(made.mesh.faces, len(made.mesh.vertices)).manifold
    assert (np.bincount(found.ravel()) == 4).mean() > 0.9
    side = np.linalg.norm(made.mesh.vertices[found] - made.mesh.vertices[np.roll(found, -1, 1)], axis=2)
    assert made.deviation.rms < 0.1 * side.mean()
    assert decimate.flipped_share(dense, made.mesh) < 0.001
    assert np.allclose(np.linalg.norm(made.mesh.normals, axis=1), 1, atol=1e-5)


@pytest.mark.slow
def test_seams_go_around_the_quads(made: Built) -> None:
    assert made.quads == len(made.mesh.faces) // 2
    assert made.quality.overlap == 0 and made.quality.charts < 20 and made.warnings == ()


@pytest.mark.slow
def test_twice_is_the_same(dense: Mesh) -> None:
    one, two = quads.quadded(dense, 1500), quads.quadded(dense, 1500)
    assert np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)


@pytest.mark.slow
def test_the_asset_has_quads(made: Built, tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path / "in")
    meshes.save(inputs.uv.folder / inputs.uv.artifact.mesh.path, made.mesh, made.charts)
    uv = inputs.uv.artifact.model_copy(update={"quads": made.quads, "proxy": None})
    inputs = replace(inputs, uv=Located(uv, inputs.uv.folder))
    run_stage(inputs, tmp_path / "out", render_views=False, high=False)
    root = tmp_path / "out" / "asset" / "head.usd"
    stage = Usd.Stage.Open(str(root))
    shown = UsdGeom.Mesh.Get(stage, "/head/geo/render")
    assert set(shown.GetFaceVertexCountsAttr().Get()) == {4}
    assert len(shown.GetFaceVertexCountsAttr().Get()) == made.quads
    assert not [f for f in validate(root) if f.level == "error"]
    stage = Usd.Stage.Open(str(root.with_suffix(".usdz")))
    package = UsdGeom.Mesh.Get(stage, "/head/geo/render")
    assert set(package.GetFaceVertexCountsAttr().Get()) == {3}
    faces = [line for line in root.with_suffix(".obj").read_text().splitlines() if line.startswith("f ")]
    assert len(faces) == made.quads and {len(line.split()) for line in faces} == {5}
    back, sent = read_usd_mesh(root), read_mesh(inputs.uv.path(uv.mesh))
    np.testing.assert_array_equal(back.vertices[back.faces], sent.vertices[sent.faces])
    np.testing.assert_allclose(back.uvs[back.uv_faces], sent.uvs[sent.uv_faces], atol=1e-6)


def test_a_quad_that_a_seam_cuts_is_written_as_triangles() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]], np.int32)
    uv_faces = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4], [6, 7, 5]], np.int32)
    whole = meshes.whole_quads(faces, uv_faces)
    assert whole.tolist() == [True, False]
    counts, found = meshes.polygons(faces, whole)
    assert counts.tolist() == [4, 3, 3] and found.tolist() == [0, 1, 2, 3, 3, 2, 4, 3, 4, 5]
    assert np.array_equal(found[meshes.fans(counts)], faces)


def test_doublets_become_one_quad_and_the_diagonal_is_the_shorter() -> None:
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [1, 0.5, 0], [4, 0, 0], [4.5, 1, 0]], float)
    found = np.array([[0, 1, 2, 4], [4, 2, 3, 0], [1, 5, 6, 2]])
    points, left = quads.without_doublets(vertices, found)
    assert len(points) == 6 and len(left) == 2  # vertex 4 is gone
    assert {frozenset(q) for q in left.tolist()} == {frozenset((0, 1, 2, 3)), frozenset((1, 4, 5, 2))}
    x = points[left]
    first, second = (np.linalg.norm(x[:, i] - x[:, i + 2], axis=1) for i in (0, 1))
    assert (first <= second).all()


@pytest.mark.parametrize(
    ("child", "said"),
    [
        ("raise SystemExit(3)", "exit code 3"),
        ("import sys; open(sys.argv[2], 'w').write('v 0 0 0\\nf 1 1 1\\n')", "faces with"),
        ("import os; os.kill(os.getpid(), 11)", "exit code -11"),
    ],
)
def test_a_library_that_fails_is_said(dense: Mesh, monkeypatch: pytest.MonkeyPatch, child: str, said: str) -> None:
    monkeypatch.setattr(quads, "CHILD", child)
    with pytest.raises(StageError, match=said) as refused:
        quads.quadded(dense, 1500)
    assert refused.value.where == "uv.remesh" and "adaptive" in refused.value.remedy


def test_an_open_mesh_keeps_its_border(dense: Mesh) -> None:
    below = dense.vertices[dense.faces][:, :, 1].mean(1) > -0.03
    vertices, faces, rows = meshes.compact(dense.vertices, dense.faces[below])
    cup = Mesh(np.asarray(vertices, np.float32), dense.normals[rows], faces)
    assert meshes.topology(cup.faces, len(cup.vertices)).sound
    made = quads.quadded(cup, 2000)
    found = meshes.topology(made.faces, len(made.vertices))
    assert found.sound and found.components == 1 and found.boundary_edges > 20
    assert made.vertices[:, 1].min() == pytest.approx(cup.vertices[:, 1].min(), abs=4e-3)
