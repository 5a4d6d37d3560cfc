"""The asset of the registered template: a cage of quads whose subdivision and displacement give the textured mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade
from scipy.spatial import cKDTree
from support.synthetic_asset import RADIUS, SyntheticInputs, run_stage
from support.synthetic_head import HEIGHT, SIDE, height_at, template_inputs

from pipeline import meshes
from pipeline.images import read_exr
from pipeline.registration.head import load_head
from stages.usd.check.validate import validate
from stages.usd.render.exported import read_usd_mesh


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[SyntheticInputs, Path]:
    folder = tmp_path_factory.mktemp("cage")
    inputs = template_inputs(folder / "inputs")
    asset = run_stage(inputs, folder / "work", render_views=False)
    assert asset.warnings == ()
    return inputs, folder / "work/asset"


def shown(stage: Usd.Stage, name: str) -> UsdGeom.Mesh:
    return UsdGeom.Mesh.Get(stage, f"/head/geo/{name}")


def test_the_main_mesh_is_the_cage(made: tuple[SyntheticInputs, Path]) -> None:
    stage = Usd.Stage.Open(str(made[1] / "head.usd"))
    cage, rest = shown(stage, "render"), shown(stage, "rest")
    head = load_head(made[0].template.folder / "head.npz")
    kept = len(head.quads) - SIDE  # without lashes
    assert set(cage.GetFaceVertexCountsAttr().Get()) == {4} and len(cage.GetFaceVertexCountsAttr().Get()) == kept
    assert cage.GetSubdivisionSchemeAttr().Get() == "catmullClark" and not cage.GetNormalsAttr().HasAuthoredValue()
    assert cage.GetInterpolateBoundaryAttr().Get() == "edgeAndCorner"
    assert cage.GetFaceVaryingLinearInterpolationAttr().Get() == "boundaries"
    points = np.array(cage.GetPointsAttr().Get())[np.array(cage.GetFaceVertexIndicesAttr().Get())]
    np.testing.assert_allclose(points, head.vertices[head.quads[:kept].ravel()], atol=1e-7)
    st = UsdGeom.PrimvarsAPI(cage).GetPrimvar("st")
    np.testing.assert_allclose(np.array(st.ComputeFlattened()), head.uvs[head.uv_quads[:kept].ravel()], atol=1e-7)
    assert rest.GetSubdivisionSchemeAttr().Get() == "none" and rest.GetNormalsAttr().HasAuthoredValue()
    assert np.array(rest.GetPointsAttr().Get())[:, 1].max() > 1.7 * RADIUS  # the hair


def test_subdivided_and_displaced_it_is_the_textured_mesh(made: tuple[SyntheticInputs, Path]) -> None:
    uv = made[0].uv
    wanted = meshes.load(uv.path(uv.artifact.mesh))
    found = read_usd_mesh(made[1] / "head.usd")
    assert len(found.faces) == len(wanted.faces)
    away = np.linalg.norm(
        found.vertices[found.faces].astype(np.float64) - wanted.vertices[wanted.faces].astype(np.float64), axis=-1
    )
    assert np.median(away) < 0.01 * HEIGHT and away.max() < 0.15 * HEIGHT  # the map is finite, the skin's border a step
    without = np.linalg.norm(wanted.vertices[: len(found.vertices)], axis=1)
    assert np.ptp(without) > HEIGHT  # the displacement is not nothing


def test_the_map_holds_metres(made: tuple[SyntheticInputs, Path]) -> None:
    """On the sides of the cube away from the eyes, at texels of the middle of a chart."""
    found = read_usd_mesh(made[1] / "head.usd")
    image, _ = read_exr(made[1] / "textures/head_cage_displacement.1001.exr")
    corners, uv = found.vertices[found.faces].mean(1), found.uvs[found.uv_faces].mean(1)
    inside = (np.abs(uv % 0.5 - 0.25) < 0.15).all(1) & (uv[:, 0] < 1)
    size = len(image)
    texel = image[((1 - uv[inside, 1]) * size).astype(int), (uv[inside, 0] * size).astype(int), 0]
    np.testing.assert_allclose(texel, height_at(corners[inside]), atol=0.15 * HEIGHT)
    assert np.abs(read_exr(made[1] / "textures/head_cage_displacement.1003.exr")[0]).max() == 0  # beside the head


@pytest.mark.parametrize("name", ["skin_1001", "skin_1002"])
@pytest.mark.parametrize(("output", "number"), [("", None), ("mtlx", "<UDIM>")])
def test_the_materials_displace(made: tuple[SyntheticInputs, Path], name: str, output: str, number: str | None) -> None:
    stage = Usd.Stage.Open(str(made[1] / "head.usd"))
    material = UsdShade.Material.Get(stage, f"/head/mtl/{name}")
    source = material.ComputeDisplacementSource(output)[0]
    height = source.GetInput("displacement").GetConnectedSources()[0][0].source
    file = UsdShade.Shader(height.GetPrim()).GetInput("file").Get().path
    assert file == f"./textures/head_cage_displacement.{number or name[-4:]}.exr"
    if output:
        assert source.GetShaderId() == "ND_displacement_float" and source.GetInput("scale").Get() == 1.0
    for variant in ("high", "proxy"):
        stage.GetDefaultPrim().GetVariantSet("lod").SetVariantSelection(variant)
        assert not material.ComputeDisplacementSource(output)[0]
        preview = UsdShade.Shader.Get(stage, f"/head/mtl/{name}/preview")
        assert not preview.GetInput("displacement").HasConnectedSource()
        assert stage.GetPrimAtPath("/head/geo/rest").IsActive() == (variant == "proxy")  # it has no proxy of its own
    beside = UsdShade.Material.Get(stage, "/head/mtl/clothes")
    assert not beside.ComputeDisplacementSource(output)[0]  # its mesh is not subdivided


@pytest.mark.parametrize("file", ["head.usd", "lookdev.usda", "head.usdz"])
def test_nothing_is_wrong_with_it(made: tuple[SyntheticInputs, Path], file: str) -> None:
    assert not [f for f in validate(made[1] / file) if f.level != "info"]


def test_other_formats_have_triangles_of_the_first_subdivision(made: tuple[SyntheticInputs, Path]) -> None:
    stage = Usd.Stage.Open(str(made[1] / "head.usdz"))
    parts = [UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    full = Usd.Stage.Open(str(made[1] / "head.usd"))
    cage, rest = shown(full, "render"), shown(full, "rest")
    count = sum(len(p.GetFaceVertexCountsAttr().Get()) for p in parts)
    quads = len(cage.GetFaceVertexCountsAttr().Get())
    assert count == 2 * 4 * quads + len(rest.GetFaceVertexCountsAttr().Get())
    points = np.array(parts[0].GetPointsAttr().Get())
    away = cKDTree(read_usd_mesh(made[1] / "head.usd").vertices).query(points)[0]
    edge = float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
    assert np.mean(away < 0.1 * edge) > 0.9  # vertices of the finest, but that larger facets are raised by more


def test_a_cage_that_is_none_is_found(made: tuple[SyntheticInputs, Path]) -> None:
    from stages.usd.check.geometry_checks import mesh_findings

    stage = Usd.Stage.Open(str(made[1] / "payload.usdc"))
    cage = UsdGeom.Mesh.Get(stage, "/head/geo/render")
    assert not mesh_findings(cage)
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        cage.CreateNormalsAttr(cage.GetPointsAttr().Get())
        cage.GetInterpolateBoundaryAttr().Block()
        found = {(f.check, f.message) for f in mesh_findings(cage)}
        assert {
            ("normals", "a cage has normals"),
            ("subdivisionScheme", "interpolateBoundary is not authored"),
        } <= found
        cage.GetSubdivisionSchemeAttr().Set("loop")
        assert ("subdivisionScheme", "loop, expected none or catmullClark") in {
            (f.check, f.message) for f in mesh_findings(cage)
        }
