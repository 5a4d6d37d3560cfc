"""The UV stage through its contract."""

from __future__ import annotations

import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline import meshes
from pipeline.artifacts import FileRef, Located, MaskSet, Surface
from pipeline.contract import Context
from pipeline.errors import Cancelled, StageError
from pipeline.head_artifacts import RegisteredHead
from stages.surface.build import build
from stages.uv import unwrap
from stages.uv.stage import Config, Inputs, run
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.ball_head import no_head


@pytest.fixture
def inputs(tmp_path: Path) -> Inputs:
    mesh = build(AnalyticField(sphere()), 40, lambda done, total: None).mesh
    meshes.save(tmp_path / "surface.npz", mesh)
    artifact = Surface(
        mesh=FileRef.of(tmp_path, "surface.npz"),
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        watertight=True,
        components=1,
        removed_components=0,
        cell=0.006,
    )
    # fitted photos and cameras are only asked for with tiles=auto (test_uv_tiles)
    masks = Located(MaskSet(masks=()), tmp_path)
    return Inputs(Located(artifact, tmp_path), None, None, masks, no_head(tmp_path))  # type: ignore[arg-type]


@pytest.mark.slow
def test_run_writes_mesh_and_proxy(inputs: Inputs, tmp_path: Path) -> None:
    uv = run(inputs, Config(target_faces=2000, proxy_faces=300, texture_size=512), Context(tmp_path, tmp_path))
    mesh, charts = meshes.load(tmp_path / uv.mesh.path), meshes.load_charts(tmp_path / uv.mesh.path)
    assert (uv.vertices, uv.faces) == (len(mesh.vertices), len(mesh.faces))
    assert charts.faces.shape == mesh.faces.shape and charts.faces.dtype == mesh.faces.dtype == np.int32
    assert uv.proxy is not None and len(meshes.load(tmp_path / uv.proxy.path).faces) < 600
    assert uv.overlap == 0 and 0 < uv.utilisation < 1 and 1 <= uv.stretch < 1.4
    assert 0 < uv.deviation_mm < 0.5 and uv.warnings == ()
    assert np.abs(mesh.normals - mesh.vertices / 0.1).max() < 0.05


def test_run_can_be_stopped(inputs: Inputs, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        run(inputs, Config(target_faces=2000), Context(tmp_path, tmp_path, cancelled=lambda: True))


@pytest.mark.parametrize(
    "bad", [{"target_faces": 10}, {"padding": 0}, {"texture_size": 100}, {"max_cost": 0.0}, {"unknown": 1}]
)
def test_settings_have_limits(bad: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        Config(**bad)  # type: ignore[arg-type]


@pytest.mark.slow
def test_failing_unwrap_is_a_stage_error(inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        def add_mesh(self, *_: object) -> None:
            raise RuntimeError("a face index is out of range")

    fake = types.ModuleType("xatlas")
    fake.Atlas, fake.ChartOptions, fake.PackOptions = Broken, types.SimpleNamespace, types.SimpleNamespace  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "xatlas", fake)
    for ours in ("unwrapped", "in_pieces"):  # a mesh that only xatlas can take
        monkeypatch.setattr(unwrap, ours, lambda *_, **__: None)
    with pytest.raises(StageError, match="unwrapped"):
        run(inputs, Config(target_faces=2000), Context(tmp_path, tmp_path))
    assert "out of range" in str(unwrap._failed("a face index is out of range"))


@pytest.mark.parametrize(
    ("mesh", "faulty", "said"),
    [
        ("auto", False, ()),
        ("auto", True, ("the mesh is the scan's: no face",)),
        ("scan", True, ()),
        ("template", False, ("the mesh is the scan's: no face",)),
    ],
)
def test_it_is_told_where_a_head_is_not_taken(
    inputs: Inputs, tmp_path: Path, mesh: str, faulty: bool, said: tuple[str, ...]
) -> None:
    """Not of things, from which nobody expects a head."""
    head = RegisteredHead(registered=False, reason="no face", faulty=faulty)
    small = {"target_faces": 500, "proxy_faces": 200, "texture_size": 256}
    given = replace(inputs, template=Located(head, tmp_path))
    made = run(given, Config.model_validate({"mesh": mesh} | small), Context(tmp_path, tmp_path))
    assert len(made.warnings) == len(said) and not made.of_template
    assert all(w.startswith(s) for w, s in zip(made.warnings, said, strict=True))
