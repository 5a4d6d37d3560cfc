"""Fitted eyes have a material of their own in every format."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade
from support.synthetic_asset import run_stage
from support.synthetic_head import SIDE, template_inputs, with_fitted_eye

from pipeline.eyes.material import IOR, ROUGHNESS
from stages.usd.check.validate import validate
from stages.usd.render.exported import read_usd_mesh

EYES = SIDE * SIDE - SIDE  # quads: a side of the cube but for the lashes


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("eyes")
    made = run_stage(with_fitted_eye(template_inputs(folder / "inputs")), folder / "work", render_views=False)
    assert made.warnings == ()
    return folder / "work/asset"


def inputs_of(material: UsdShade.Material, output: str = "") -> dict[str, Any]:
    source = material.ComputeSurfaceSource(output)[0]
    return {i.GetBaseName(): i for i in source.GetInputs()}


def test_the_eyes_faces_have_the_cornea(asset: Path) -> None:
    stage = Usd.Stage.Open(str(asset / "head.usd"))
    cage = UsdGeom.Mesh.Get(stage, "/head/geo/render")
    subsets = {s.GetPrim().GetName(): s for s in UsdGeom.Subset.GetGeomSubsets(cage)}
    count = len(cage.GetFaceVertexCountsAttr().Get())
    rows = {n: set(s.GetIndicesAttr().Get()) for n, s in subsets.items()}
    assert set(rows) == {"eyes", "skin_1001", "skin_1002"} and len(rows["eyes"]) == EYES
    assert sorted(i for r in rows.values() for i in r) == list(range(count))
    found = {n: UsdShade.MaterialBindingAPI(s).ComputeBoundMaterial()[0] for n, s in subsets.items()}
    assert {n: str(m.GetPath()) for n, m in found.items()} == {n: f"/head/mtl/{n}" for n in rows}
    preview = inputs_of(found["eyes"])
    assert preview["ior"].Get() == pytest.approx(IOR) and preview["roughness"].Get() == pytest.approx(ROUGHNESS)
    assert preview["metallic"].Get() == 0
    texture = UsdShade.Shader(preview["diffuseColor"].GetConnectedSources()[0][0].source.GetPrim())
    assert texture.GetInput("file").Get().path == "./textures/head_albedo.1002.png"
    openpbr = inputs_of(found["eyes"], "mtlx")
    assert openpbr["specular_ior"].Get() == pytest.approx(IOR)
    assert openpbr["specular_roughness"].Get() == pytest.approx(ROUGHNESS) and openpbr["specular_weight"].Get() == 1
    assert found["eyes"].ComputeDisplacementSource()[0] and found["eyes"].ComputeDisplacementSource("mtlx")[0]
    skin = UsdShade.MaterialBindingAPI(cage).ComputeBoundMaterial()[0]
    assert str(skin.GetPath()) == "/head/mtl/skin_1001"  # of programs that know no subsets


@pytest.mark.parametrize("file", ["head.usd", "lookdev.usda", "head.usdz"])
def test_nothing_is_wrong_with_it(asset: Path, file: str) -> None:
    assert not [f for f in validate(asset / file) if f.level != "info"]


def test_the_package_has_the_eyes_as_a_face_set_of_the_head(asset: Path) -> None:
    stage = Usd.Stage.Open(str(asset / "head.usdz"))
    head = UsdGeom.Mesh.Get(stage, "/head/geo/render")
    sets = {str(s.GetPrim().GetName()): s for s in UsdGeom.Subset.GetAllGeomSubsets(head)}
    assert len(sets["eyes"].GetIndicesAttr().Get()) == 2 * 4 * EYES
    material = UsdShade.MaterialBindingAPI(sets["eyes"]).ComputeBoundMaterial()[0]
    assert inputs_of(material)["ior"].Get() == pytest.approx(IOR)
    texture = UsdShade.Shader(inputs_of(material)["diffuseColor"].GetConnectedSources()[0][0].source.GetPrim())
    assert texture.GetInput("file").Get().path.endswith("1002.png")
    full = Usd.Stage.Open(str(asset / "head.usd"))
    count = {
        name: len(UsdGeom.Mesh.Get(full, f"/head/geo/{name}").GetFaceVertexCountsAttr().Get())
        for name in ("render", "rest")
    }
    assert len(head.GetFaceVertexCountsAttr().Get()) == 2 * 4 * count["render"]
    assert len(UsdGeom.Mesh.Get(stage, "/head/geo/rest").GetFaceVertexCountsAttr().Get()) == count["rest"]
    rows = np.concatenate([np.asarray(s.GetIndicesAttr().Get()) for s in sets.values()])
    assert np.array_equal(np.sort(rows), np.arange(2 * 4 * count["render"]))


def test_gltf_has_a_primitive_with_the_cornea_s_index(asset: Path) -> None:
    content = (asset / "head.glb").read_bytes()
    length = struct.unpack("<I", content[12:16])[0]
    document = json.loads(content[20 : 20 + length])
    names = [m["name"] for m in document["materials"]]
    eye = document["materials"][names.index("head_1002_eyes")]
    assert eye["extensions"] == {"KHR_materials_ior": {"ior": IOR}}
    assert "KHR_materials_ior" in document["extensionsUsed"]
    surface = eye["pbrMetallicRoughness"]
    other = document["materials"][names.index("head_1002")]["pbrMetallicRoughness"]
    assert surface["roughnessFactor"] == ROUGHNESS and surface["baseColorTexture"] == other["baseColorTexture"]
    used = [p["material"] for m in document["meshes"] for p in m["primitives"]]
    assert sorted(set(used)) == list(range(len(names))) and len(used) == len(set(used))
    counts = {
        names[p["material"]]: document["accessors"][p["indices"]]["count"] // 3
        for m in document["meshes"]
        for p in m["primitives"]
    }
    assert counts["head_1002_eyes"] == 2 * 4 * EYES


def test_the_renderer_shows_all_faces(asset: Path) -> None:
    mesh = read_usd_mesh(asset / "head.usd")
    assert np.isfinite(mesh.vertices).all() and len(mesh.faces) > 2 * 16 * 5 * SIDE * SIDE
