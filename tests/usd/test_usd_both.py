"""An asset of the template's mesh with the scan's as a variant: each with its own maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade
from support.synthetic_asset import RADIUS, run_stage
from support.synthetic_head import template_inputs

from pipeline import meshes
from stages.usd.check.validate import validate
from stages.usd.render.exported import read_usd_mesh


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The asset, and the scan's textured mesh."""
    folder = tmp_path_factory.mktemp("both")
    inputs = template_inputs(folder / "inputs", "both")
    assert run_stage(inputs, folder / "work", render_views=False, obj=False).warnings == ()
    uv = inputs.uv.artifact
    assert uv.of_template and uv.scan is not None and not uv.scan.of_template and uv.scan.tiles == 1
    return folder / "work/asset", inputs.uv.path(uv.scan.mesh)


def shown(stage: Usd.Stage) -> set[str]:
    return {p.GetName() for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)}


def test_the_variant_swaps_the_meshes(made: tuple[Path, Path]) -> None:
    stage = Usd.Stage.Open(str(made[0] / "head.usd"))
    sets = stage.GetDefaultPrim().GetVariantSets()
    assert sets.GetVariantSelection("mesh") == "template" and shown(stage) == {"render", "rest", "proxy"}
    sets.SetSelection("mesh", "scan")
    assert shown(stage) == {"scan", "proxy"}
    scan = UsdGeom.Mesh.Get(stage, "/head/geo/scan")
    assert scan.GetSubdivisionSchemeAttr().Get() == "none" and scan.GetPurposeAttr().Get() == "render"
    wanted = meshes.load(made[1])
    assert len(scan.GetFaceVertexCountsAttr().Get()) == len(wanted.faces)
    points = np.array(scan.GetPointsAttr().Get())[np.array(scan.GetFaceVertexIndicesAttr().Get())]
    np.testing.assert_array_equal(points, wanted.vertices[wanted.faces].reshape(-1, 3))
    for level in ("high", "proxy"):
        sets.SetSelection("lod", level)
        for mesh in ("scan", "template"):
            sets.SetSelection("mesh", mesh)
            beside = {"rest"} if (level, mesh) == ("proxy", "template") else set()
            assert shown(stage) == {level} | beside


def test_each_has_its_own_maps(made: tuple[Path, Path]) -> None:
    stage = Usd.Stage.Open(str(made[0] / "head.usd"))
    sets = stage.GetDefaultPrim().GetVariantSets()
    files = {}
    for variant, prim in (("template", "render"), ("scan", "scan")):
        sets.SetSelection("mesh", variant)
        mesh = stage.GetPrimAtPath(f"/head/geo/{prim}")
        material = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]
        surface = material.ComputeSurfaceSource()[0]
        files[variant] = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source.GetPrim())
        assert bool(material.ComputeDisplacementSource()[0]) == (variant == "template")
    paths = {k: s.GetInput("file").Get() for k, s in files.items()}
    assert paths["template"].path == "./textures/head_albedo.1001.png"
    assert paths["scan"].path == "./textures/head_scan_albedo.png" and Path(paths["scan"].resolvedPath).is_file()
    sets.SetSelection("look", "specular_workflow")
    material = UsdShade.Material.Get(stage, "/head/mtl/captured_scan")
    assert material.ComputeSurfaceSource()[0].GetPath().name == "preview_specular"


def test_it_is_sound_and_renders_the_template(made: tuple[Path, Path]) -> None:
    for file in ("head.usd", "head.usdz"):
        assert not [f for f in validate(made[0] / file) if f.level != "info"]
    found = read_usd_mesh(made[0] / "head.usd")
    assert found.vertices[:, 1].max() > 1.7 * RADIUS and len(found.faces) > 2 * 210 * 16
