"""The surface stage through its contract, and the repair of broken meshes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline import meshes
from pipeline.artifacts import Located, MaskSet, Surface
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from pipeline.errors import Cancelled, StageError
from stages.surface import build as building
from stages.surface.repair import repaired
from stages.surface.stage import STAGE, Config, Inputs, run
from tests.support.analytic_fields import AnalyticField, bumpy_head, sphere
from tests.support.field_artifacts import fitted, poses


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Inputs:
    face = fitted(tmp_path, AnalyticField(bumpy_head()), monkeypatch)
    photos = Located(Capture(kind="facescape", views=()), tmp_path)
    return Inputs(face, poses(tmp_path), Located(MaskSet(masks=()), tmp_path), photos)


def test_run_writes_the_artifact(inputs: Inputs, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    context = Context(tmp_path, tmp_path, progress=lambda done, total, message="", **_: seen.append((done, total)))
    surface = run(inputs, Config(resolution=40), context)
    mesh = meshes.load(tmp_path / surface.mesh.path)
    assert isinstance(surface, Surface) and surface.watertight and surface.components == 1
    assert (len(mesh.vertices), len(mesh.faces)) == (surface.vertices, surface.faces)
    assert mesh.vertices.dtype == mesh.normals.dtype == np.float32 and mesh.faces.dtype == np.int32
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    assert seen and STAGE.output is Surface


def test_run_can_be_stopped(inputs: Inputs, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        run(inputs, Config(resolution=40), Context(tmp_path, tmp_path, cancelled=lambda: True))


@pytest.mark.parametrize("resolution", [0, 15, 1025, -3])
def test_resolution_limits(resolution: int) -> None:
    with pytest.raises(ValidationError):
        Config(resolution=resolution)


def holed() -> tuple[np.ndarray, np.ndarray]:
    mesh = building.build(AnalyticField(sphere()), 24, lambda done, total: None).mesh
    return mesh.vertices.astype(np.float64), np.delete(mesh.faces, [10, 11, 500], axis=0)


def test_repair_closes_holes() -> None:
    pytest.importorskip("pymeshlab")
    vertices, faces = holed()
    found = meshes.topology(faces, len(vertices))
    assert not found.watertight and found.boundary_edges > 0
    closed_vertices, closed, now, before = building._closed(vertices, faces)
    assert now.manifold and now.euler == 2 and before == found
    assert meshes.volume(closed_vertices, closed) == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=0.03)


def test_repair_without_its_library_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)  # as if it were not installed
    vertices, faces = holed()
    with pytest.raises(StageError, match="not closed"):
        repaired(vertices, faces, meshes.topology(faces, len(vertices)))


def test_topology_sees_each_fault() -> None:
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    assert meshes.topology(tetrahedron, 4) == meshes.Topology(True, 0, 0, 0, 1, 2)
    assert meshes.topology(tetrahedron[:3], 4).boundary_edges == 3
    flipped = tetrahedron.copy()
    flipped[0] = flipped[0, ::-1]
    assert meshes.topology(flipped, 4).crowded_edges == 3
    assert meshes.topology(np.concatenate([tetrahedron, tetrahedron]), 4).crowded_edges == 6
    tip_to_tip = np.concatenate([tetrahedron, np.where(tetrahedron == 0, 0, tetrahedron + 3)]).astype(np.int32)
    found = meshes.topology(tip_to_tip, 7)
    assert found.watertight and found.pinched_vertices == 1 and not found.manifold and found.components == 1
    apart = meshes.topology(np.concatenate([tetrahedron, tetrahedron + 4]), 8)
    assert apart.manifold and apart.components == 2 and apart.euler == 4
    assert not meshes.topology(np.zeros((0, 3), np.int32), 0).manifold
