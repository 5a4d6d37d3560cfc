"""Looks, levels of detail and the other formats of the exported asset."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade
from support.synthetic_asset import SyntheticInputs, ball, run_stage, texture_arrays, write_inputs

from pipeline.images import read_exr
from pipeline.transforms import matrix


# ------------------------------------------------------------------ looks and levels of detail
def surface_of(stage: Usd.Stage, context: str) -> str:
    material = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/head/geo/render")).ComputeBoundMaterial()[0]
    output = material.GetSurfaceOutput(context) if context else material.GetSurfaceOutput()
    return str(output.GetConnectedSources()[0][0].source.GetPrim().GetPath()).removeprefix("/head/mtl/captured/")


@pytest.mark.parametrize(
    "look, preview, materialx",
    [
        ("standard", "preview", "openpbr/surface"),
        ("specular_workflow", "preview_specular", "openpbr/surface"),
        ("neuface_basis", "preview", "neuface_basis/surface"),
    ],
)
def test_looks_choose_the_surface(exported, look: str, preview: str, materialx: str) -> None:
    stage = Usd.Stage.Open(str(exported[0] / "asset/head.usd"))
    looks = stage.GetDefaultPrim().GetVariantSet("look")
    assert sorted(looks.GetVariantNames()) == ["neuface_basis", "specular_workflow", "standard"]
    assert looks.GetVariantSelection() == "standard"
    looks.SetVariantSelection(look)
    assert (surface_of(stage, ""), surface_of(stage, "mtlx")) == (preview, materialx)


@pytest.mark.parametrize("level", ["high", "render", "proxy"])
def test_levels_of_detail(exported, inputs: SyntheticInputs, level: str) -> None:
    stage = Usd.Stage.Open(str(exported[0] / "asset/head.usd"))
    levels = stage.GetDefaultPrim().GetVariantSet("lod")
    assert sorted(levels.GetVariantNames()) == ["high", "proxy", "render"] and levels.GetVariantSelection() == "render"
    levels.SetVariantSelection(level)
    shown = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    assert [p.GetName() for p in shown] == (["render", "proxy"] if level == "render" else [level])
    if level != "render":
        assert UsdGeom.Imageable(shown[0]).ComputePurpose() == "default"
    material = UsdShade.MaterialBindingAPI(shown[0]).ComputeBoundMaterial()[0]
    assert material.GetPath() == "/head/mtl/captured"


def test_dense_mesh_keeps_its_points_and_takes_the_charts(exported, inputs: SyntheticInputs) -> None:
    """Its texture coordinates are those of the textured mesh: at the same place of the ball, the same texel."""
    stage = Usd.Stage.Open(str(exported[0] / "asset/high.usdc"))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    with np.load(inputs.surface.path(inputs.surface.artifact.mesh)) as given:
        assert np.array_equal(np.array(mesh.GetPointsAttr().Get()), given["vertices"])
        assert len(mesh.GetFaceVertexCountsAttr().Get()) == len(given["faces"])
    points = np.array(mesh.GetPointsAttr().Get())[np.array(mesh.GetFaceVertexIndicesAttr().Get())]
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened())
    longitude = np.arctan2(points[:, 0], points[:, 2])
    inner = (np.abs(longitude) < 2.8) & (np.abs(points[:, 1]) < 0.12)
    assert np.abs(st[inner, 0] - (0.02 + 0.96 * (longitude[inner] / (2 * np.pi) + 0.5))).max() < 0.01


@pytest.mark.slow
def test_a_dense_mesh_is_left_out_where_nobody_wants_it(inputs: SyntheticInputs, tmp_path: Path) -> None:
    run_stage(inputs, tmp_path / "work", render_views=False, high=False)
    assert not (tmp_path / "work/asset/high.usdc").exists()
    stage = Usd.Stage.Open(str(tmp_path / "work/asset/head.usd"))
    assert sorted(stage.GetDefaultPrim().GetVariantSet("lod").GetVariantNames()) == ["proxy", "render"]


@pytest.mark.slow
def test_only_what_the_user_said_is_recorded(exported, inputs: SyntheticInputs, tmp_path: Path) -> None:
    plain = Usd.Stage.Open(str(exported[0] / "asset/head.usd"))
    assert "capture" not in plain.GetDefaultPrim().GetAssetInfo()
    assert exported[1].stated == {}
    said = {"author": "Anna", "license": "CC BY 4.0", "subject_consent": "research, until 2030"}
    made = run_stage(inputs, tmp_path / "work", render_views=False, asset_version="2.1.0", **said)
    wanted = {"author": "Anna", "license": "CC BY 4.0", "subjectConsent": "research, until 2030"}
    for file in ("head.usd", "head.usdz"):
        stage = Usd.Stage.Open(str(tmp_path / "work/asset" / file))
        assert dict(stage.GetDefaultPrim().GetAssetInfo()["capture"]) == wanted
        assert stage.GetDefaultPrim().GetAssetInfo()["version"] == "2.1.0"
        assert dict(stage.GetRootLayer().customLayerData["capture"]) == wanted
    assert made.stated == wanted


def test_opening_lookdev_shows_a_held_out_photo(exported, inputs: SyntheticInputs) -> None:
    from stages.usd.render.exported import read_cameras

    path = exported[0] / "asset/lookdev.usda"
    stage = Usd.Stage.Open(str(path))
    main = next(p for p in stage.Traverse() if p.GetName() == "main_cam")
    cameras = read_cameras(path)
    held_out = [i for i, (_, out) in cameras.items() if out]
    assert held_out == [3, 9]
    poses = {c.index: matrix(c.world_from_cam) for c in inputs.poses.artifact.cameras}
    first = max(held_out, key=lambda i: poses[i][2, 3])
    world = UsdGeom.Xformable(main).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    np.testing.assert_allclose(np.array(world).T[:3, 3], poses[first][:3, 3], atol=1e-9)
    settings = stage.GetPrimAtPath(stage.GetMetadata("renderSettingsPrimPath"))
    assert settings.GetRelationship("camera").GetTargets() == [main.GetPath()]


def test_cameras_are_read_back_as_they_were(exported, inputs: SyntheticInputs) -> None:
    from stages.usd.render.exported import read_cameras

    found = read_cameras(exported[0] / "asset/lookdev.usda")
    for camera in inputs.poses.artifact.cameras:
        view = found[camera.index][0]
        np.testing.assert_allclose(view.K, matrix(camera.K), atol=1e-3)
        np.testing.assert_allclose(view.world_from_cam, matrix(camera.world_from_cam), atol=1e-9)
        np.testing.assert_allclose(view.distortion, camera.distortion, atol=1e-9)
        assert (view.width, view.height) == (camera.width, camera.height)


def test_proxy_texture_lies_on_no_texel_twice(exported) -> None:
    from pipeline import raster
    from pipeline.meshes import Charts

    stage = Usd.Stage.Open(str(exported[0] / "asset/head.usd"))
    st = np.array(UsdGeom.PrimvarsAPI(UsdGeom.Mesh.Get(stage, "/head/geo/proxy")).GetPrimvar("st").ComputeFlattened())
    flat = Charts(st.astype(np.float32), np.arange(len(st), dtype=np.int32).reshape(-1, 3))
    layers = raster.layers(raster.texel_corners(flat, 512), 512)
    assert (layers > 1).sum() < 0.005 * (layers > 0).sum()


# ------------------------------------------------------------------ other formats
def test_glb_holds_the_same_mesh_and_look(exported, inputs: SyntheticInputs) -> None:
    import trimesh

    content = (exported[0] / "asset/head.glb").read_bytes()
    assert content[:4] == b"glTF" and int.from_bytes(content[8:12], "little") == len(content)
    length = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + length])
    mesh = trimesh.load(exported[0] / "asset/head.glb", force="mesh", process=False)
    wanted = ball()
    np.testing.assert_allclose(mesh.vertices[mesh.faces], wanted["vertices"][wanted["faces"]], atol=1e-6)
    np.testing.assert_allclose(mesh.visual.uv[mesh.faces], wanted["uvs"][wanted["uv_faces"]], atol=1e-6)
    material = document["materials"][0]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    factor = material["extensions"]["KHR_materials_specular"]["specularColorFactor"][0]
    picture = document["images"][material["extensions"]["KHR_materials_specular"]["specularColorTexture"]["index"]]
    view = document["bufferViews"][picture["bufferView"]]
    import cv2

    start = 20 + length + 8 + view["byteOffset"]
    stored = cv2.imdecode(np.frombuffer(content[start : start + view["byteLength"]], np.uint8), -1)[..., 0] / 255
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(0.04 * factor * linear, texture_arrays()["f0"][..., 0], atol=5e-4)
    index = material["pbrMetallicRoughness"]["metallicRoughnessTexture"]["index"]
    view = document["bufferViews"][document["images"][index]["bufferView"]]
    start = 20 + length + 8 + view["byteOffset"]
    packed = cv2.imdecode(np.frombuffer(content[start : start + view["byteLength"]], np.uint8), -1)  # blue, green, red
    np.testing.assert_allclose(packed[..., 1] / 255, texture_arrays()["roughness"][..., 0], atol=3e-3)
    assert not packed[..., 0].any(), "blue is how metallic it is"


def test_obj_reads_back(exported) -> None:
    import trimesh

    folder = exported[0] / "asset"
    mesh = trimesh.load(folder / "head.obj", force="mesh", process=False)
    wanted = ball()
    assert len(mesh.faces) == len(wanted["faces"])
    np.testing.assert_allclose(mesh.vertices[mesh.faces], wanted["vertices"][wanted["faces"]], atol=1e-6)
    names = [line.split()[1] for line in (folder / "head.mtl").read_text().splitlines() if ".png" in line]
    assert names and all((folder / n).is_file() for n in names)


@pytest.mark.slow
def test_large_maps_are_shrunk_for_phones(tmp_path: Path) -> None:
    import cv2

    from pipeline.images import write_png
    from stages.usd.write.package import AR_SIDE, bounded_png

    big = np.zeros((4096, 4096, 3), np.float32)
    big[:, 2048:] = [1.0, 0.5, 0.25]
    write_png(tmp_path / "x.png", big, 16)
    read = cv2.imdecode(np.frombuffer(bounded_png(tmp_path / "x.png"), np.uint8), -1)
    assert read.shape == (AR_SIDE, AR_SIDE, 3) and read.dtype == np.uint8
    assert read[5, 5].tolist() == [0, 0, 0] and read[5, 2000].tolist() == [64, 128, 255]


@pytest.mark.slow
def test_an_albedo_that_was_fitted_with_shadows_is_left_as_it_is(tmp_path: Path) -> None:
    """The fit's own share of the light stands where the export's would."""
    from stages.usd.render.exported import load_exported

    arrays = texture_arrays()
    ratio = np.full_like(arrays["albedo"], 0.8)
    ratio[:64] = 0.6
    inputs = write_inputs(tmp_path / "in", arrays={**arrays, "irradiance_ratio": ratio})
    run_stage(inputs, tmp_path / "work", usdz=False)
    baked = inputs.bake.path(inputs.bake.artifact.maps["albedo"].files["exr"])
    assert (tmp_path / "work/asset/textures/head_albedo.exr").samefile(baked)
    read = load_exported(tmp_path / "work/asset/head.usd")
    np.testing.assert_allclose(read.albedo, arrays["albedo"], atol=1e-6)
    np.testing.assert_allclose(read.occlusion, ratio, atol=1e-6)
    assert not (tmp_path / "work/asset/internal/head_occlusion.exr").exists()


@pytest.mark.slow
def test_acescg_albedo_on_request(exported, tmp_path: Path) -> None:
    """The same colours in other primaries; what the networks read stays linear Rec.709."""
    import OpenEXR

    from pipeline.colour import ACESCG, REC709, rgb_from_rgb

    assert not (exported[0] / "asset/textures/head_albedo_acescg.exr").exists()
    made = run_stage(write_inputs(tmp_path / "in"), tmp_path / "out", acescg=True, usdz=False, glb=False, obj=False)
    assert "asset/textures/head_albedo_acescg.exr" in {f.path for f in made.files}
    textures = tmp_path / "out/asset/textures"
    plain, wide = (read_exr(textures / f"head_albedo{s}.exr")[0][..., :3] for s in ("", "_acescg"))
    np.testing.assert_allclose(wide, plain @ rgb_from_rgb(ACESCG, REC709).T, rtol=2**-11, atol=1e-5)  # 16-bit floats
    with OpenEXR.File(str(textures / "head_albedo_acescg.exr")) as f:
        np.testing.assert_allclose(f.header()["chromaticities"], ACESCG, atol=1e-6)
