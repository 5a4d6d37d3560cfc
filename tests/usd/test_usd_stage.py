"""The exported files: structure, determinism, what the stage refuses."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade
from support.synthetic_asset import (
    SyntheticInputs,
    ball,
    cameras,
    run_stage,
    texture_arrays,
    write_inputs,
    write_textures,
)

from pipeline.artifacts import sha256_of
from pipeline.contract import Context
from pipeline.errors import StageError, UsageError
from pipeline.images import read_encoded, read_exr
from pipeline.transforms import inverse_rigid, matrix, project
from stages.usd.naming import check_name, name_from
from stages.usd.stage import STAGE, Config, Inputs
from stages.usd.write.maps import look_of
from stages.usd.write.mesh import read_mesh
from stages.usd.write.obj import write_obj
from stages.usd.write.shading import ior_from_f0


def test_files_are_those_of_the_interface(exported) -> None:
    folder, asset = exported
    listed = {f.path for f in asset.files}
    assert {
        "asset/head.usd",
        "asset/payload.usdc",
        "asset/high.usdc",
        "asset/lookdev.usda",
        "asset/head.usdz",
        "asset/environment.exr",
        "asset/internal/light.json",
        "asset/textures/head_albedo.exr",
        "asset/textures/head_albedo.png",
        "asset/internal/head_specular_coefficients.exr",
        "asset/internal/head_basis_lut.exr",
        "asset/internal/head_occlusion.exr",
        "asset/head.glb",
        "asset/head.obj",
        "asset/head.mtl",
        "asset/thumbnails/default.png",
        "asset/open_in_blender.py",
    } <= listed
    on_disk = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    views = {f.path for v in asset.views for f in (v.exr, v.png)}
    assert on_disk == listed | views
    assert asset.root == "asset/head.usd"
    assert asset.warnings == ()


def test_the_bakes_maps_take_no_room_again_and_stay_as_they_are(exported, inputs) -> None:
    """Maps are second names of the bake's files; an albedo without shadows is a file of its own."""
    maps = inputs.bake.artifact.maps
    for ref in (r for m in maps.values() for r in m.files.values()):
        assert sha256_of(inputs.bake.path(ref)) == ref.sha256
    asset = exported[0] / "asset"
    assert (asset / "textures/head_normal.png").samefile(inputs.bake.path(maps["normal"].files["png"]))
    for form, ref in maps["albedo"].files.items():
        assert not (asset / f"textures/head_albedo.{form}").samefile(inputs.bake.path(ref))


def test_component_structure(exported) -> None:
    stage = Usd.Stage.Open(str(exported[0] / "asset/head.usd"))
    prim = stage.GetDefaultPrim()
    assert prim.GetPath() == "/head"
    assert Usd.ModelAPI(prim).GetKind() == "component"
    assert Usd.ModelAPI(prim).GetAssetName() == "head"
    assert [str(p) for p in prim.GetInherits().GetAllDirectInherits()] == ["/_class_head"]
    render, proxy = (UsdGeom.Mesh.Get(stage, f"/head/geo/{n}") for n in ("render", "proxy"))
    assert render.GetPurposeAttr().Get() == "render"
    assert proxy.GetPurposeAttr().Get() == "proxy"
    assert render.GetProxyPrimRel().GetTargets() == [proxy.GetPath()]
    assert render.GetSubdivisionSchemeAttr().Get() == "none"
    assert render.GetDoubleSidedAttr().Get() is False
    st = UsdGeom.PrimvarsAPI(render).GetPrimvar("st")
    assert (st.GetTypeName(), st.GetInterpolation(), st.IsIndexed()) == ("texCoord2f[]", "faceVarying", True)
    material = UsdShade.MaterialBindingAPI(render).ComputeBoundMaterial()[0]
    surface = UsdShade.Shader(material.ComputeSurfaceSource()[0])
    assert surface.GetInput("useSpecularWorkflow").Get() == 0
    assert surface.GetInput("ior").Get() == pytest.approx(1.402, abs=2e-3)  # of the synthetic mean F0 of 0.028


def test_the_materialx_numbers_are_those_of_the_look(exported) -> None:
    """What a shader computes from the network's numbers: reflectance along the normal, the normal map's frame, and
    where the table of the bases is looked up."""
    stage = Usd.Stage.Open(str(exported[0] / "asset/head.usd"))
    prims = {p.GetPath().name: UsdShade.Shader(p) for p in stage.Traverse() if "/openpbr/" in str(p.GetPath())}
    surface, weight = prims["surface"], prims["weight"]
    ior, factor = surface.GetInput("specular_ior").Get(), weight.GetInput("in2").Get()
    assert factor * ((ior - 1) / (ior + 1)) ** 2 == pytest.approx(1, rel=1e-5)  # F0 of the map, and no other

    def source(node: UsdShade.Shader, name: str) -> tuple[str, str]:
        """Kind and file of the node that feeds an input."""
        found = UsdShade.Shader(node.GetInput(name).GetConnectedSources()[0][0].source.GetPrim())
        file = found.GetInput("file")
        return found.GetIdAttr().Get(), Path(file.Get().path).name if file else ""

    bounded = prims["f0_bounded"]
    assert source(weight, "in1")[0] == "ND_clamp_float" and source(bounded, "in") == ("ND_image_float", "head_f0.exr")
    bent = prims["bent_normal"]
    assert source(bent, "normal")[0] == "ND_normal_vector3" and source(bent, "tangent")[0] == "ND_tangent_vector3"
    assert source(bent, "in") == ("ND_image_vector3", "head_normal.png")
    assert source(surface, "geometry_normal")[0] == "ND_normalmap_float"
    assert source(surface, "specular_roughness") == ("ND_image_float", "head_roughness.png")
    basis = {p.GetPath().name: UsdShade.Shader(p) for p in stage.Traverse() if "/neuface_basis/" in str(p.GetPath())}
    place, row = basis["place"], basis["row"]  # u: n.v, v: 2 / kappa, as the table is written
    assert source(place, "in1")[0] == "ND_facingratio_float" and source(place, "in2")[0] == "ND_multiply_float"
    assert source(row, "in1") == ("ND_image_float", "head_inv_kappa.exr") and row.GetInput("in2").Get() == 2
    assert source(basis["basis_0"], "texcoord")[0] == "ND_combine2_vector2"
    assert basis["surface"].GetInput("specular_weight").Get() == 1
    assert basis["surface"].GetInput("specular_ior").Get() == pytest.approx(1.5)  # of the R in the table


@pytest.mark.parametrize("f0", [0.02, 0.08])
def test_the_index_of_refraction_is_that_of_the_f0_map(f0: float, inputs: SyntheticInputs, tmp_path: Path) -> None:
    """F0 of the map, not skin's: (1 + sqrt F0) / (1 - sqrt F0), and F0 itself as Ks of the OBJ's material."""
    arrays = texture_arrays(64)
    bake = write_textures(tmp_path, {**arrays, "f0": np.full_like(arrays["f0"], f0)})
    (tmp_path / "asset/textures").mkdir(parents=True)
    shutil.copy(tmp_path / "albedo.exr", tmp_path / "asset/textures/head_albedo.exr")
    look = look_of(bake, "head", tmp_path / "asset")
    assert look.ior == pytest.approx({0.02: 1.3294, 0.08: 1.7888}[f0], abs=1e-3)
    write_obj(tmp_path, "head", read_mesh(inputs.uv.path(inputs.uv.artifact.mesh)), look)
    said = dict(line.split(maxsplit=1) for line in (tmp_path / "head.mtl").read_text().splitlines() if " " in line)
    assert [float(x) for x in said["Ks"].split()] == pytest.approx([f0] * 3, abs=1e-4)
    assert float(said["Ni"]) == pytest.approx(look.ior, abs=1e-4)


def test_mesh_survives_the_round_trip(exported, inputs: SyntheticInputs) -> None:
    from stages.usd.render.exported import read_usd_mesh

    found, wanted = read_usd_mesh(exported[0] / "asset/head.usd"), ball()
    np.testing.assert_array_equal(found.vertices[found.faces], wanted["vertices"][wanted["faces"]])
    np.testing.assert_array_equal(found.uvs[found.uv_faces], wanted["uvs"][wanted["uv_faces"]])
    np.testing.assert_allclose(found.normals[found.faces], wanted["normals"][wanted["faces"]], atol=1e-6)


def test_every_layer_has_units_and_axis(exported) -> None:
    from pxr import Sdf

    for name in ("head.usd", "payload.usdc", "lookdev.usda"):
        layer = Sdf.Layer.FindOrOpen(str(exported[0] / "asset" / name))
        assert layer.pseudoRoot.GetInfo("metersPerUnit") == 1, name
        assert layer.pseudoRoot.GetInfo("upAxis") == "Y", name


def test_proxy_takes_the_texture_of_what_it_stands_for(exported) -> None:
    """At each proxy corner the texture coordinate is that of the full mesh's nearest vertex, within its spacing."""
    stage = Usd.Stage.Open(str(exported[0] / "asset/head.usd"))
    proxy = UsdGeom.Mesh.Get(stage, "/head/geo/proxy")
    points = np.array(proxy.GetPointsAttr().Get())[np.array(proxy.GetFaceVertexIndicesAttr().Get())]
    st = np.array(UsdGeom.PrimvarsAPI(proxy).GetPrimvar("st").ComputeFlattened())
    mid = np.abs(points[:, 1]) < 0.1  # away from the poles, where u is not defined
    u = 0.02 + 0.96 * ((np.arctan2(points[mid, 0], points[mid, 2]) / (2 * np.pi) + 0.5) % 1)
    seam = np.abs(np.abs(u - 0.5) - 0.48) < 0.02
    assert np.abs(st[mid, 0] - u)[~seam].max() < 0.01
    assert (np.minimum(st[mid, 0], 1 - st[mid, 0])[seam] < 0.045).all()
    corners = st.reshape(-1, 3, 2)
    assert np.ptp(corners[..., 0], axis=1).max() < 0.1  # no triangle runs from one edge of the chart to the other


def test_lookdev_adds_light_and_cameras_only(exported) -> None:
    folder = exported[0] / "asset"
    stage, plain = Usd.Stage.Open(str(folder / "lookdev.usda")), Usd.Stage.Open(str(folder / "head.usd"))
    dome = UsdLux.DomeLight.Get(stage, "/head/lookdev/captured_light")
    assert dome.GetTextureFileAttr().Get().resolvedPath == str(folder / "environment.exr")
    assert not any("Light" in p.GetTypeName() or p.IsA(UsdGeom.Camera) for p in plain.Traverse())
    assert stage.GetDefaultPrim().GetPath() == "/head"
    assert [p.GetName() for p in stage.GetPseudoRoot().GetChildren() if not p.IsAbstract()] == ["head"]


def test_cameras_see_points_where_the_photos_do(exported, inputs: SyntheticInputs) -> None:
    """USD's own frustum mathematics against the pipeline's projection (less the distortion, which USD can't hold)."""
    stage = Usd.Stage.Open(str(exported[0] / "asset/lookdev.usda"))
    points = np.random.default_rng(3).uniform(-0.15, 0.15, (50, 3))
    for camera in inputs.poses.artifact.cameras:
        usd = UsdGeom.Camera.Get(stage, f"/head/lookdev/cameras/view_{camera.index}").GetCamera(Usd.TimeCode.Default())
        view_projection = usd.frustum.ComputeViewMatrix() * usd.frustum.ComputeProjectionMatrix()
        ndc = np.array([view_projection.Transform(Gf.Vec3d(*p.tolist())) for p in points])
        found = np.stack([(ndc[:, 0] + 1) / 2 * camera.width, (1 - ndc[:, 1]) / 2 * camera.height], -1)
        wanted, depth = project(matrix(camera.K), inverse_rigid(matrix(camera.world_from_cam)), np.zeros(5), points)
        assert np.abs(found - wanted).max() < 0.01
        near, far = usd.clippingRange.min, usd.clippingRange.max
        assert near < depth.min() < depth.max() < far


@pytest.mark.slow
def test_two_exports_have_the_same_bytes(inputs: SyntheticInputs, tmp_path: Path, monkeypatch) -> None:
    """In other folders, and years apart by the clock."""
    import time

    first = run_stage(inputs, tmp_path / "a" / "work")
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + 1e8)
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    second = run_stage(inputs, tmp_path / "b/other/work")
    assert first.digest() == second.digest()
    assert {f.path: f.sha256 for f in first.files} == {f.path: f.sha256 for f in second.files}


@pytest.mark.slow
def test_another_process_writes_the_same_bytes(exported, inputs: SyntheticInputs, tmp_path: Path) -> None:
    """Hash seeds, thread schedules and import orders differ between processes."""
    import os
    import pickle
    import subprocess
    import sys

    (tmp_path / "inputs.pkl").write_bytes(pickle.dumps(inputs))
    tests = Path(__file__).resolve().parents[1]
    code = """
import pickle, sys
from pathlib import Path
sys.path[:0] = [sys.argv[1], str(Path(sys.argv[1]).parent)]
from pipeline.artifacts import sha256_of
from pipeline.contract import Context
from stages.usd.write.maps import look_of
from stages.usd.write.mesh import read_mesh
from stages.usd.write.obj import write_obj
from stages.usd.write.shading import ior_from_f0
from stages.usd.stage import STAGE, Config, Inputs
made = pickle.loads((Path(sys.argv[2]) / "inputs.pkl").read_bytes())
named = {n: getattr(made, n) for n in Inputs.__slots__}
work = Path(sys.argv[2]) / "work"
asset = STAGE.run(Inputs(**named), Config(preview_size=64, environment_width=128), Context(work, work / "scratch"))
print(asset.digest())
"""
    environment = os.environ | {"PYTHONHASHSEED": "77", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code, str(tests), str(tmp_path)],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stdout.split()[-1] == exported[1].digest()


def test_package_is_aligned_png_only_and_opens(exported) -> None:
    path = exported[0] / "asset/head.usdz"
    with zipfile.ZipFile(path) as z:
        names = z.namelist()
        assert names[0] == "head.usdc"
        assert {Path(n).suffix for n in names[1:]} == {".png"}
        assert all(i.compress_type == zipfile.ZIP_STORED and i.date_time == (1980, 1, 1, 0, 0, 0) for i in z.infolist())
    stage = Usd.Stage.Open(str(path))
    assert [p.GetName() for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)] == ["render"]
    texture = UsdShade.Shader.Get(stage, "/head/mtl/captured/albedo").GetInput("file").Get()
    assert texture.resolvedPath.endswith("head.usdz[textures/head_albedo.png]")


@pytest.mark.parametrize("length", range(1, 70))
def test_package_aligns_names_of_any_length(tmp_path: Path, length: int) -> None:
    from stages.usd.write.package import write_package

    path = tmp_path / "x.usdz"
    write_package(path, [("a" * length, b"12345"), ("b", b"6" * length)])
    content = path.read_bytes()
    with zipfile.ZipFile(path) as z:
        assert z.testzip() is None
        for info in z.infolist():
            extra = int.from_bytes(content[info.header_offset + 28 : info.header_offset + 30], "little")
            start = info.header_offset + 30 + len(info.filename) + extra
            assert start % 64 == 0
            assert content[start : start + info.file_size] == z.read(info)


@pytest.mark.slow
def test_without_proxy_the_mesh_has_default_purpose(tmp_path: Path) -> None:
    """A viewer that shows proxies would otherwise show nothing."""
    run_stage(write_inputs(tmp_path / "in", proxy=False, held_out=()), tmp_path / "work", usdz=False)
    stage = Usd.Stage.Open(str(tmp_path / "work/asset/head.usd"))
    assert UsdGeom.Mesh.Get(stage, "/head/geo/render").ComputePurpose() == "default"
    assert not stage.GetPrimAtPath("/head/geo/proxy")
    assert not (tmp_path / "work/asset/head.usdz").exists()


@pytest.mark.slow
def test_held_out_views_have_the_predictions_size(tmp_path: Path) -> None:
    asset = run_stage(write_inputs(tmp_path / "in", scale=2), tmp_path / "work")
    assert [(v.index, v.scale) for v in asset.views] == [(3, 2), (9, 2)]
    image, names = read_exr(tmp_path / "work" / asset.views[0].exr.path)
    assert image.shape == (60, 48, 4)
    assert names == ("R", "G", "B", "A")
    png = read_encoded(tmp_path / "work" / asset.views[0].png.path)
    assert png.shape == (60, 48, 4)


@pytest.mark.slow
def test_without_held_out_views_a_few_fitted_ones_are_rendered(tmp_path: Path) -> None:
    asset = run_stage(write_inputs(tmp_path / "in", held_out=()), tmp_path / "work")
    assert [(v.index, v.scale) for v in asset.views] == [(0, 1), (6, 1), (12, 1)]


def test_large_fitted_views_are_rendered_smaller() -> None:
    from stages.usd.render.previews import factor_for, spread

    camera = cameras(1, 2000, 3000).cameras[0]
    assert factor_for(camera) == 5
    assert factor_for(cameras(1, 1999, 3001).cameras[0]) == 1  # nothing divides both
    assert spread((4,), 3) == [4]
    assert spread((), 3) == []


@pytest.mark.slow
def test_name_goes_into_prim_files_and_textures(inputs: SyntheticInputs, tmp_path: Path) -> None:
    asset = run_stage(inputs, tmp_path / "work", name="anna_02", render_views=False)
    assert asset.root == "asset/anna_02.usd"
    assert (tmp_path / "work/asset/textures/anna_02_albedo.png").is_file()
    assert Usd.Stage.Open(str(tmp_path / "work/asset/anna_02.usd")).GetDefaultPrim().GetName() == "anna_02"


@pytest.mark.parametrize(
    "name", ["", "2head", "my head", "a/b", "tête", "payload", "lookdev2", "Light", "high", "x" * 65]
)
def test_bad_names_are_refused_and_mended(inputs: SyntheticInputs, tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="name"):
        run_stage(inputs, tmp_path / "work", name=name)
    assert check_name(name_from(name)) == name_from(name)


def test_missing_maps_are_named(tmp_path: Path) -> None:
    arrays = texture_arrays()
    del arrays["inv_kappa"]
    with pytest.raises(StageError, match="maps are missing"):
        run_stage(write_inputs(tmp_path / "in", arrays=arrays), tmp_path / "work")


@pytest.mark.parametrize("key, value", [("faces", -1), ("faces", 10**6), ("uv_faces", 10**6), ("vertices", np.nan)])
def test_broken_meshes_are_refused(tmp_path: Path, key: str, value: float) -> None:
    mesh = ball()
    mesh[key][5, 1] = value
    with pytest.raises(StageError, match="mesh can't be exported"):
        run_stage(write_inputs(tmp_path / "in", mesh=mesh), tmp_path / "work")


def test_mesh_without_uvs_is_refused(tmp_path: Path) -> None:
    mesh = ball()
    del mesh["uvs"]
    with pytest.raises(StageError, match="no array uvs"):
        run_stage(write_inputs(tmp_path / "in", mesh=mesh), tmp_path / "work")


@pytest.mark.parametrize("light", [np.zeros((120, 3)), np.zeros((121, 4)), np.full((121, 3), np.nan)])
def test_broken_lights_are_refused(tmp_path: Path, light: np.ndarray) -> None:
    with pytest.raises(StageError, match="light can't be used"):
        run_stage(write_inputs(tmp_path / "in", light=light.astype(np.float32)), tmp_path / "work")


def test_a_cancelled_export_stops(inputs: SyntheticInputs, tmp_path: Path) -> None:
    from pipeline.errors import Cancelled

    named = {n: getattr(inputs, n) for n in Inputs.__slots__}
    context = Context(tmp_path / "w", tmp_path / "s", cancelled=lambda: True)
    with pytest.raises(Cancelled):
        STAGE.run(Inputs(**named), Config(), context)


def test_light_json_explains_itself(exported) -> None:
    content = json.loads((exported[0] / "asset/internal/light.json").read_text())
    assert np.array(content["coefficients"]).shape == (121, 3)
    assert content["order"] == 10
    assert "l * (l + 1) + m" in content["convention"]


def test_no_machine_path_in_any_layer(exported) -> None:
    for path in (exported[0] / "asset").rglob("*"):
        if path.is_file():
            assert str(exported[0].parent).encode() not in path.read_bytes(), path.name


@pytest.mark.parametrize("f0, ior", [(0.04, 1.5), (0.028, 1.402)])
def test_ior(f0: float, ior: float) -> None:
    assert ior_from_f0(f0) == pytest.approx(ior, abs=1e-3)
    assert ((ior - 1) / (ior + 1)) ** 2 == pytest.approx(f0, abs=1e-4)


def test_ior_of_implausible_reflectance_stays_finite() -> None:
    assert 1 == ior_from_f0(-1.0) == ior_from_f0(0.0) < ior_from_f0(5.0) < 3  # no layer reflects nothing
