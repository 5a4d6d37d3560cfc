"""`neuface expressions`: the files against the blend shapes of the USD file, and what has none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel
from support.synthetic_asset import run_stage, write_inputs
from support.synthetic_head import template_inputs

from pipeline.errors import StageError
from pipeline.template.obj import read_obj
from stages.usd.render.expressions import load_cage
from workflows.cli.main import main


@pytest.fixture(scope="module", params=["template", "both"])
def run_folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp(request.param)
    inputs = template_inputs(folder / "inputs", request.param)
    run_stage(inputs, folder / "run", render_views=False, high=False, obj=False, usdz=False, glb=False)
    return folder / "run"


def test_the_files_hold_the_shapes_of_the_usd_file(run_folder: Path, tmp_path: Path) -> None:
    assert main(["expressions", str(run_folder), "--out", str(tmp_path / "new/shapes")]) == 0
    files = sorted((tmp_path / "new/shapes").glob("*.obj"))
    stage = Usd.Stage.Open(str(run_folder / "asset/head.usd"))
    mesh = UsdGeom.Mesh.Get(stage, "/head/geo/render")
    names = list(UsdSkel.BindingAPI(mesh.GetPrim()).GetBlendShapesAttr().Get())
    assert [f.stem for f in files] == [f"head_{i:02d}_{n}" for i, n in enumerate(["neutral", *names])]
    rest, meshes = np.array(mesh.GetPointsAttr().Get()), [read_obj(f) for f in files]
    np.testing.assert_allclose(meshes[0].vertices, rest, atol=1e-6)
    for name, made in zip(names, meshes[1:], strict=True):
        shape = UsdSkel.BlendShape.Get(stage, f"/head/geo/render/{name}")
        wanted = np.zeros_like(rest)
        wanted[np.array(shape.GetPointIndicesAttr().Get())] = np.array(shape.GetOffsetsAttr().Get())
        np.testing.assert_allclose(made.vertices - meshes[0].vertices, wanted, atol=2e-6)
        np.testing.assert_array_equal(made.quads, meshes[0].quads)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)
    np.testing.assert_array_equal(meshes[0].quads, corners)
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
    np.testing.assert_allclose(meshes[0].uvs[meshes[0].uv_quads].reshape(-1, 2), np.array(st), atol=1e-6)


def test_some_of_them_and_a_file_of_the_user(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "head_00_neutral.obj").write_text("mine")
    command = ["expressions", str(run_folder / "asset"), "--out", str(tmp_path)]
    assert main([*command, "--only", "jawOpen"]) == 0
    assert len(list(tmp_path.glob("head_*_jawOpen.obj"))) == 1
    assert "mine" in [f.read_text() for f in tmp_path.iterdir()] and "is yours" in capsys.readouterr().err
    assert main([*command, "--only", "jawOpne"]) == 2 and "jawOpen" in capsys.readouterr().err


def test_an_asset_without_expressions_says_so(tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path / "inputs")
    run_stage(inputs, tmp_path / "run", render_views=False, high=False, obj=False, usdz=False, glb=False)
    with pytest.raises(StageError, match=r"no expressions[\s\S]*uv\.mesh=template"):
        load_cage(tmp_path / "run/asset/head.usd")
    (tmp_path / "broken.usd").write_text("#usda 1.0\n(")
    with pytest.raises(StageError, match="not a USD file"):
        load_cage(tmp_path / "broken.usd")
