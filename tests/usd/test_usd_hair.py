"""Hair is a mesh with a material of its own in every format, and turns with the head alone."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade, UsdSkel
from support.synthetic_asset import RADIUS, SyntheticInputs, run_stage
from support.synthetic_head import template_inputs

from stages.usd.check.validate import validate
from stages.usd.render.exported import read_usd_mesh

ABOVE = 1.2 * RADIUS


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[SyntheticInputs, Path]:
    folder = tmp_path_factory.mktemp("hair")
    inputs = template_inputs(folder / "inputs", "both", hair_told=True)
    asset = run_stage(inputs, folder / "work", render_views=False)
    assert asset.warnings == ()
    return inputs, folder / "work/asset"


def points(mesh: UsdGeom.Mesh) -> np.ndarray:
    return np.array(mesh.GetPointsAttr().Get())


def of(stage: Usd.Stage, name: str) -> UsdGeom.Mesh:
    return UsdGeom.Mesh.Get(stage, f"/head/geo/{name}")


def bound(mesh: UsdGeom.Mesh) -> UsdShade.Material:
    return UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]


def tiles_of(mesh: UsdGeom.Mesh) -> set[int]:
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    return {int(u) for u in np.floor(np.array(st.ComputeFlattened()).reshape(-1, 3, 2)[..., 0].mean(1))}


def test_the_uv_stage_puts_it_last_on_the_last_tile(made: tuple[SyntheticInputs, Path]) -> None:
    uv = made[0].uv.artifact
    assert uv.tiles == 4 and 0 < uv.hair_faces < uv.faces
    assert uv.scan is not None and uv.scan.hair_faces == 0


def test_it_is_a_prim_with_its_own_tile_and_material(made: tuple[SyntheticInputs, Path]) -> None:
    stage = Usd.Stage.Open(str(made[1] / "head.usd"))
    hair, rest = of(stage, "hair"), of(stage, "rest")
    assert points(hair)[:, 1].min() > ABOVE and points(rest)[:, 1].max() < ABOVE < points(rest)[:, 0].max()
    assert len(hair.GetFaceVertexCountsAttr().Get()) == made[0].uv.artifact.hair_faces
    assert tiles_of(hair) == {3} and tiles_of(rest) == {2}
    assert hair.GetPurposeAttr().Get() == "default" and hair.GetSubdivisionSchemeAttr().Get() == "none"
    assert hair.GetDoubleSidedAttr().Get() and not rest.GetDoubleSidedAttr().Get()
    material = bound(hair)
    assert str(material.GetPath()) == "/head/mtl/hair" and str(bound(rest).GetPath()) == "/head/mtl/clothes"
    for output in ("", "mtlx"):
        assert material.ComputeSurfaceSource(output)[0] and not material.ComputeDisplacementSource(output)[0]
    texture = material.ComputeSurfaceSource()[0].GetInput("diffuseColor").GetConnectedSources()[0][0].source
    assert UsdShade.Shader(texture.GetPrim()).GetInput("file").Get().path == "./textures/head_albedo.1004.png"


def test_the_variants_have_it_where_the_template_is(made: tuple[SyntheticInputs, Path]) -> None:
    stage = Usd.Stage.Open(str(made[1] / "head.usd"))
    sets = stage.GetDefaultPrim().GetVariantSets()

    def shown() -> set[str]:
        return {p.GetName() for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)}

    assert shown() == {"render", "rest", "hair", "proxy"}
    sets.SetSelection("mesh", "scan")
    assert shown() == {"scan", "proxy"}
    sets.SetSelection("mesh", "template")
    for level, there in (("high", {"high"}), ("proxy", {"proxy", "rest", "hair"})):
        sets.SetSelection("lod", level)
        assert shown() == there
    sets.SetSelection("lod", "render")
    looks = {}
    for look in ("standard", "specular_workflow", "neuface_basis"):
        sets.SetSelection("look", look)
        for name in ("skin_1001", "skin_1002", "clothes", "hair"):
            material = UsdShade.Material.Get(stage, f"/head/mtl/{name}")
            found = tuple(
                str(material.ComputeSurfaceSource(o)[0].GetPath().MakeRelativePath(material.GetPath()))
                for o in ("", "mtlx")
            )
            assert looks.setdefault(look, found) == found  # the same network of all materials
    assert len(set(looks.values())) == 3


@pytest.mark.parametrize("purpose", ["render", "proxy"])
def test_every_viewport_shows_hair_and_clothes(made: tuple[SyntheticInputs, Path], purpose: str) -> None:
    """One that shows the proxy in place of the cage shows both beside it, and the hints say how large each is."""
    stage = Usd.Stage.Open(str(made[1] / "head.usd"))
    boxes = {}
    for hints in (False, True):
        cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default", purpose], hints)
        boxes[hints] = cache.ComputeWorldBound(stage.GetDefaultPrim()).ComputeAlignedRange()
    shown = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    there = [p for p in shown if UsdGeom.Imageable(p).ComputePurpose() in ("default", purpose)]
    assert {p.GetName() for p in there} == {purpose, "rest", "hair"}
    all_points = np.concatenate([points(UsdGeom.Mesh(p)) for p in there])
    np.testing.assert_allclose(boxes[True].GetMin(), all_points.min(0), atol=0.004)  # the surface, not its cage
    np.testing.assert_allclose(boxes[True].GetMax(), all_points.max(0), atol=0.004)
    room = 0.06  # of the expressions
    for low, high in ((boxes[False].GetMin(), boxes[False].GetMax()),):
        assert (np.array(low) <= all_points.min(0) + 1e-6).all() and (np.array(low) > all_points.min(0) - room).all()
        assert (np.array(high) >= all_points.max(0) - 1e-6).all() and (np.array(high) < all_points.max(0) + room).all()


@pytest.mark.parametrize("file", ["head.usd", "lookdev.usda", "head.usdz"])
def test_nothing_is_wrong_with_it(made: tuple[SyntheticInputs, Path], file: str) -> None:
    assert not [f for f in validate(made[1] / file) if f.level != "info"]


@pytest.mark.parametrize(("file", "name"), [("head.usd", "hair"), ("head.usdz", "hair")])
def test_it_follows_the_head_and_no_expression(made: tuple[SyntheticInputs, Path], file: str, name: str) -> None:
    stage = Usd.Stage.Open(str(made[1] / file))
    hair = of(stage, name)
    assert points(hair)[:, 1].min() > ABOVE and hair.GetDoubleSidedAttr().Get()
    cache = UsdSkel.Cache()
    root = UsdSkel.Root(stage.GetPrimAtPath("/head/geo"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkinningQuery(hair.GetPrim())
    assert query and query.HasJointInfluences() and not query.HasBlendShapes()
    joints, weights = query.ComputeVaryingJointInfluences(len(points(hair)))
    indices, weights = np.array(joints), np.array(weights)
    order = list(UsdSkel.Skeleton.Get(stage, "/head/geo/rig").GetJointsAttr().Get())
    assert {order[int(i)] for i in indices[weights > 0]} == {"head"}
    np.testing.assert_allclose(weights.reshape(len(points(hair)), -1).sum(1), 1, atol=1e-6)


def test_the_package_reads_its_tile(made: tuple[SyntheticInputs, Path]) -> None:
    stage = Usd.Stage.Open(str(made[1] / "head.usdz"))
    material = bound(of(stage, "hair"))
    assert material.GetPath().name == "hair"
    texture = material.ComputeSurfaceSource()[0].GetInput("diffuseColor").GetConnectedSources()[0][0].source
    assert UsdShade.Shader(texture.GetPrim()).GetInput("file").Get().path.endswith("1004.png")


def document(path: Path) -> dict[str, Any]:
    content = path.read_bytes()
    return dict(json.loads(content[20 : 20 + struct.unpack("<I", content[12:16])[0]]))


def test_gltf_has_a_node_for_it_without_targets(made: tuple[SyntheticInputs, Path]) -> None:
    found = document(made[1] / "head.glb")
    assert [n["name"] for n in found["nodes"]] == ["head", "head_rest", "head_hair"]
    (hair,) = found["meshes"][found["nodes"][2]["mesh"]]["primitives"]
    assert "targets" not in hair and found["materials"][hair["material"]]["name"] == "head_1004_hair"
    assert [m["name"] for m in found["materials"] if m.get("doubleSided")] == ["head_1004_hair"]
    assert found["accessors"][hair["indices"]]["count"] == 3 * made[0].uv.artifact.hair_faces
    assert found["accessors"][hair["attributes"]["POSITION"]]["min"][1] > ABOVE


def test_obj_has_an_object_for_it(made: tuple[SyntheticInputs, Path]) -> None:
    text = (made[1] / "head.obj").read_text()
    head, hair = text.split("o head_hair\n")
    assert hair.startswith("usemtl hair\n") and hair.count("\nf ") == made[0].uv.artifact.hair_faces
    assert "o head\n" in head and "usemtl hair" not in head
    materials = (made[1] / "head.mtl").read_text()
    own = materials.split("newmtl hair\n")[1].split("newmtl")[0]
    assert "map_Kd textures/head_albedo.1004.png" in own


def test_the_renderer_shows_it(made: tuple[SyntheticInputs, Path]) -> None:
    mesh = read_usd_mesh(made[1] / "head.usd")
    high = mesh.vertices[mesh.faces][..., 1].min(1) > ABOVE
    assert high.sum() == made[0].uv.artifact.hair_faces
