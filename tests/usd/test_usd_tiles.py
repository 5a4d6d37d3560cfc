"""An asset on two UDIM tiles: every file, every reader, and what is found where something is wrong."""

from __future__ import annotations

import json
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Tf, Usd, UsdGeom, UsdShade, UsdUtils
from support.synthetic_asset import RADIUS, ball, cut_in_two, run_stage, write_inputs

from pipeline.asset_artifacts import UsdAsset
from pipeline.errors import StageError
from pipeline.images import read_encoded, write_png
from pipeline.map_lookup import bilinear
from stages.usd.check.validate import _without_tile_warnings, validate
from stages.usd.render.camera import orbit_camera
from stages.usd.render.exported import load_exported
from stages.usd.render.relight import vertex_values
from stages.usd.render.render import Renderer
from stages.usd.write.mesh import UvSurface, half_gap, on_tile, tile_count, with_uvs_from, without_overlap

NUMBERS = ("1001", "1002")


@pytest.fixture(scope="module")
def tiled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, UsdAsset]:
    folder = tmp_path_factory.mktemp("tiled")
    made = run_stage(write_inputs(folder / "inputs", tiled=True), folder / "work", acescg=True, render_views=False)
    return folder / "work/asset", made


@pytest.fixture
def asset(tiled: tuple[Path, UsdAsset], tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiled[0], tmp_path / "asset"))


def test_the_library_s_complaints_about_tiles_are_not_printed(
    tiled: tuple[Path, UsdAsset], capfd: pytest.CaptureFixture[str]
) -> None:
    """It looks for files with <UDIM> in their names. Other warnings are still printed."""
    validate(tiled[0] / "head.usd")
    assert "UDIM" not in "".join(capfd.readouterr())
    with _without_tile_warnings():
        Tf.Warn("./head.<UDIM>.png is not there")
        Tf.Warn("something else is wrong")
    said = "".join(capfd.readouterr())
    assert "UDIM" not in said and "something else is wrong" in said
    Tf.Warn("and as before")
    assert "and as before" in "".join(capfd.readouterr())


def cut_ball() -> UvSurface:
    made = cut_in_two(ball())
    return UvSurface(*(made[k] for k in ("vertices", "normals", "faces", "uvs", "uv_faces")))


def test_every_map_has_a_file_for_each_tile(tiled: tuple[Path, UsdAsset]) -> None:
    maps = [f.path for f in tiled[1].files if f.path.startswith(("asset/textures/", "asset/internal/head_"))]
    names = {path.rpartition("/")[2] for path in maps}
    single = {"head_basis_lut.exr", "head_basis_rgb0.exr"}
    assert single <= names
    stems = {n.split(".")[0] for n in names - single}
    assert {"head_albedo", "head_occlusion", "head_coefficients_rgb0", "head_lobe_fit", "head_albedo_acescg"} <= stems
    for name in names - single:
        assert name.split(".")[1] in NUMBERS, name
        assert name.replace("1002", "1001") in names and name.replace("1001", "1002") in names


def test_materialx_reads_rows_of_tiles_and_usd_finds_them_all(tiled: tuple[Path, UsdAsset]) -> None:
    stage = Usd.Stage.Open(str(tiled[0] / "head.usd"))
    shaders = [UsdShade.Shader(p) for p in stage.Traverse() if p.IsA(UsdShade.Shader)]
    mtlx = [s for s in shaders if s.GetInput("file") and s.GetShaderId().startswith("ND_")]
    paths = {s.GetPath().name: s.GetInput("file").Get().path for s in mtlx}
    assert paths["albedo"] == "./textures/head_albedo.<UDIM>.png"
    assert paths["coefficients_0"] == "./internal/head_coefficients_rgb0.<UDIM>.exr"
    assert paths["basis_0"] == "./internal/head_basis_rgb0.exr"
    for path in paths.values():
        found = UsdShade.UdimUtils.ResolveUdimTilePaths(path, stage.GetRootLayer())
        assert "<UDIM>" not in path or tuple(number for _, number in found) == NUMBERS
    _, files, missing = UsdUtils.ComputeAllDependencies(str(tiled[0] / "head.usd"))
    assert not missing and {f"head_roughness.{n}.png" for n in NUMBERS} <= {Path(f).name for f in files}
    st = np.array(UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/head/geo/render")).GetPrimvar("st").Get())
    assert st.min() >= 0 and 1.5 < st[:, 0].max() <= 2 and st[:, 1].max() <= 1


@pytest.mark.parametrize("file", ["head.usd", "head.usdz"])
def test_nothing_is_wrong_with_it(tiled: tuple[Path, UsdAsset], file: str) -> None:
    assert not [f for f in validate(tiled[0] / file) if f.level == "error"]


def test_each_tile_has_the_index_of_refraction_of_its_own_f0(tiled: tuple[Path, UsdAsset]) -> None:
    """Skin and clothes are materials of their own. Here F0 rises from the first tile to the second."""
    stage = Usd.Stage.Open(str(tiled[0] / "head.usd"))
    said = dict[str, float]()
    for number in NUMBERS:
        f0 = read_encoded(tiled[0] / f"textures/head_f0.{number}.exr")[..., 0]
        covered = read_encoded(tiled[0] / f"internal/head_coverage.{number}.png")[..., 0] > 0
        surface = UsdShade.Shader.Get(stage, f"/head/mtl/captured_{number}/preview")
        said[number] = surface.GetInput("ior").Get()
        assert ((said[number] - 1) / (said[number] + 1)) ** 2 == pytest.approx(f0[covered].mean(), rel=0.02)
        mtl = (tiled[0] / "head.mtl").read_text().split(f"newmtl captured_{number}")[1]
        assert float(mtl.split("Ni ")[1].split()[0]) == pytest.approx(said[number], abs=1e-4)
    assert said["1002"] > said["1001"] + 0.02


def test_it_looks_as_on_one_tile(tiled: tuple[Path, UsdAsset], exported: tuple[Path, UsdAsset]) -> None:
    two, one = load_exported(tiled[0] / "head.usd"), load_exported(exported[0] / "asset/head.usd")
    assert (two.tiles, one.tiles) == (2, 1) and two.albedo.shape == (128, 256, 3)
    pictures = []
    for read in (two, one):
        renderer = Renderer(read)
        pictures.append(np.stack([renderer.render(orbit_camera(RADIUS * 1.25, a, 48)) for a in (0.1, 2.0, 4.0)]))
        assert vertex_values(read.albedo, renderer).shape == (len(read.mesh.vertices), 3)
    alpha = pictures[1][..., 3]
    assert np.array_equal(pictures[0][..., 3], alpha)
    assert np.abs(pictures[0] - pictures[1]).max() < 0.02 * pictures[1].max()
    assert np.abs(pictures[0] - pictures[1]).mean() < 1e-3 * pictures[1].mean()


def test_tiles_do_not_mix_at_their_border() -> None:
    image = np.repeat(np.array([1.0, 5.0], np.float32), 4)[None, :, None].repeat(4, 0)
    u = np.array([0.0, 0.99, 1 - 1e-6, 1.0, 1.01, 2.0, 3.0])
    uv = np.stack([u, np.full_like(u, 0.4)], -1)
    np.testing.assert_array_equal(bilinear(image, uv, 2)[:, 0], [1, 1, 1, 5, 5, 5, 5])


@pytest.mark.parametrize("level", ["render", "high", "proxy"])
def test_each_face_reads_its_own_tile(tiled: tuple[Path, UsdAsset], level: str) -> None:
    """Face by face: the file of its tile, with coordinates inside the unit square; in each look, and in MaterialX the
    row of tiles with the coordinates as they are."""
    stage = Usd.Stage.Open(str(tiled[0] / "head.usd"))
    sets = stage.GetDefaultPrim().GetVariantSets()
    sets.SetSelection("lod", level)
    mesh = UsdGeom.Mesh.Get(stage, f"/head/geo/{level}")
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()).reshape(-1, 3, 2)
    subsets = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
    assert [s.GetPrim().GetName() for s in subsets] == [f"captured_{n}" for n in NUMBERS]
    rows = [np.array(s.GetIndicesAttr().Get()) for s in subsets]
    assert np.array_equal(np.sort(np.concatenate(rows)), np.arange(len(st)))
    for look in ("standard", "specular_workflow"):
        sets.SetSelection("look", look)
        for tile, (one, own) in enumerate(zip(subsets, rows, strict=True)):
            material = UsdShade.MaterialBindingAPI(one).ComputeBoundMaterial()[0]
            surface = material.ComputeSurfaceSource()[0]
            assert surface.GetInput("useSpecularWorkflow").Get() == (look != "standard")
            for name in ("diffuseColor", "roughness", "normal"):
                texture = UsdShade.Shader(surface.GetInput(name).GetConnectedSources()[0][0].source.GetPrim())
                file = texture.GetInput("file").Get()
                assert file.path.split(".")[-2] == NUMBERS[tile] and Path(file.resolvedPath).is_file()
                assert texture.GetInput("wrapS").Get() == texture.GetInput("wrapT").Get() == "clamp"
                reader = UsdShade.Shader(texture.GetInput("st").GetConnectedSources()[0][0].source.GetPrim())
                shift = reader.GetInput("translation").Get() if reader.GetShaderId() == "UsdTransform2d" else (0, 0)
                at = st[own] + np.array(shift)
                assert at.min() >= 0 and at.max() <= 1 and at[..., 0].max() > 0.9, (name, tile)
            assert "<UDIM>" in picture_of(material, "mtlx", "base_color")


def picture_of(material: UsdShade.Material, context: str, name: str) -> str:
    surface = material.ComputeSurfaceSource(context)[0]
    return str(
        UsdShade.Shader(surface.GetInput(name).GetConnectedSources()[0][0].source.GetPrim()).GetInput("file").Get()
    )


def test_other_formats_have_a_material_for_each_tile(tiled: tuple[Path, UsdAsset]) -> None:
    folder, count = tiled[0], len(ball()["faces"])
    data = (folder / "head.glb").read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    gltf = json.loads(data[20 : 20 + length])
    primitives = gltf["meshes"][0]["primitives"]
    assert [p["material"] for p in primitives] == [0, 1] and len(gltf["materials"]) == 2
    assert sum(gltf["accessors"][p["indices"]]["count"] for p in primitives) == 3 * count
    colours = [m["pbrMetallicRoughness"]["baseColorTexture"]["index"] for m in gltf["materials"]]
    assert len(set(colours)) == 2 and len(gltf["images"]) == 8
    for p in primitives:
        a = gltf["accessors"][p["attributes"]["TEXCOORD_0"]]
        start = 28 + length + gltf["bufferViews"][a["bufferView"]]["byteOffset"]
        st = np.frombuffer(data[start : start + 8 * a["count"]], np.float32)
        assert st.min() >= 0 and 0.9 < st.max() <= 1
    obj, mtl = (folder / "head.obj").read_text().splitlines(), (folder / "head.mtl").read_text()
    assert [x for x in obj if x.startswith("usemtl")] == [f"usemtl captured_{n}" for n in NUMBERS]
    assert max(float(x.split()[1]) for x in obj if x.startswith("vt")) <= 1
    assert all(f"map_Kd textures/head_albedo.{n}.png" in mtl for n in NUMBERS)
    with zipfile.ZipFile(folder / "head.usdz") as z:
        assert {f"textures/head_albedo.{n}.png" for n in NUMBERS} <= set(z.namelist())
    stage = Usd.Stage.Open(str(folder / "head.usdz"))
    (mesh,) = [UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    assert len(mesh.GetFaceVertexCountsAttr().Get()) == count
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()).reshape(-1, 3, 2)
    assert st.min() >= 0 and st.max() <= 1
    sets = UsdGeom.Subset.GetAllGeomSubsets(mesh)
    assert sum(len(s.GetIndicesAttr().Get()) for s in sets) == count
    for one in sets:
        material = UsdShade.MaterialBindingAPI(one).ComputeBoundMaterial()[0]
        file = UsdShade.Shader(material.GetPrim().GetChild("albedo")).GetInput("file").Get()
        number = one.GetPrim().GetName()[-4:]
        assert number in file.path and file.resolvedPath
        moved = UsdShade.Shader(material.GetPrim().GetChild("st_of_part"))
        scale, shift = (np.array(moved.GetInput(n).Get()) for n in ("scale", "translation"))
        own = st[np.array(one.GetIndicesAttr().Get())] * scale + shift
        assert own.min() >= -1e-6 and own.max() <= 1 + 1e-6 and own.max() > 0.9, number


# ------------------------------------------------------------------ faults
def across(asset: Path) -> None:
    """One corner of a face moves to the other tile."""
    stage = Usd.Stage.Open(str(asset / "payload.usdc"))
    st = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/head/geo/render")).GetPrimvar("st")
    values = np.array(st.Get())
    first = st.GetIndices()[0]
    values[first, 0] += 1 if values[first, 0] < 1 else -1
    st.Set(values)
    stage.Save()


def beyond(asset: Path) -> None:
    """Every corner moves to a tile that is not there."""
    stage = Usd.Stage.Open(str(asset / "payload.usdc"))
    st = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/head/geo/render")).GetPrimvar("st")
    st.Set(np.array(st.Get()) + np.array([1, 0], np.float32))
    stage.Save()


def smaller(asset: Path) -> None:
    path = asset / "textures/head_roughness.1002.png"
    write_png(path, read_encoded(path)[::2, ::2] / 255.0)


def material(asset: Path, change: Callable[[UsdShade.Shader], object], shader: str) -> None:
    stage = Usd.Stage.Open(str(asset / "payload.usdc"))
    change(UsdShade.Shader.Get(stage, f"/head/mtl/captured_1002/{shader}"))
    stage.Save()


def shifted(asset: Path) -> None:
    """The second tile's material moves the coordinates by too little."""
    material(asset, lambda s: s.GetInput("translation").Set((-0.5, 0)), "st_of_part")


def row_in_preview(asset: Path) -> None:
    material(asset, lambda s: s.GetInput("file").Set("./textures/head_normal.<UDIM>.png"), "normal")


def swapped(asset: Path) -> None:
    """A face changes its face set."""
    stage = Usd.Stage.Open(str(asset / "payload.usdc"))
    one, two = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/head/geo/render")).GetMaterialBindSubsets()
    first, second = (list(s.GetIndicesAttr().Get()) for s in (one, two))
    one.GetIndicesAttr().Set(first[1:])
    two.GetIndicesAttr().Set([*second, first[0]])
    stage.Save()


FAULTS: list[tuple[Callable[[Path], None], str, str]] = [
    (lambda a: (a / "textures/head_albedo.1002.png").unlink(), "missing_texture", "head_albedo.1002.png"),
    (lambda a: (a / "textures/head_f0.1001.exr").unlink(), "missing_texture", "head_f0.1001.exr"),
    (lambda a: (a / "textures/head_normal.1001.png").write_bytes(b"no"), "unreadable_texture", "normal.1001.png"),
    (across, "st", "are in two UDIM tiles"),
    (beyond, "missing_texture", "head_albedo.1003.png"),
    (smaller, "tile_size", "64x64 and 128x128"),
    (shifted, "st", "faces lie outside of the picture of /head/mtl/captured_1002/"),
    (swapped, "st", "1 faces lie outside of the picture of /head/mtl/captured_1002/"),
    (row_in_preview, "usdShadeValidators:NormalMapTextureValidator.InvalidFile", "<UDIM>"),
]


@pytest.mark.parametrize("change, check, words", FAULTS, ids=[f"{n}-{f[1]}" for n, f in enumerate(FAULTS)])
def test_each_fault_of_tiles_is_reported(asset: Path, change: Callable[[Path], None], check: str, words: str) -> None:
    change(asset)
    found = [f for f in validate(asset / "head.usd") if f.level == "error"]
    assert any(f.check == check and words in f.message for f in found), [str(f) for f in found]


def test_a_missing_tile_is_named_by_the_renderer(asset: Path) -> None:
    (asset / "textures/head_albedo.1002.exr").unlink()
    with pytest.raises(StageError, match=r"head_albedo\.1002\.exr"):
        load_exported(asset / "head.usd")


# ------------------------------------------------------------------ other meshes on the tiles
def test_other_levels_stay_on_their_charts_tile() -> None:
    full, fine, coarse = cut_ball(), ball(91, 40), ball(17, 10)  # an odd number of columns: faces on the cut
    tile = np.floor(full.uvs[:, 0])
    full.uvs[:, 0] = tile + 0.001 + 0.998 * (full.uvs[:, 0] - tile - 0.02) / 0.96  # up to the borders
    assert tile_count(full) == 2
    assert half_gap(full, 256) == np.inf  # each tile holds one chart
    for made, beyond in ((fine, 0.01), (coarse, 0.0)):
        bare = UvSurface(made["vertices"], made["normals"], made["faces"], np.zeros((0, 2)), np.zeros((0, 3)))
        got = with_uvs_from(bare, full, 6, beyond)
        got = got if beyond else without_overlap(got, 256)
        u = got.uvs[got.uv_faces][..., 0]
        assert (np.floor(u).max(1) == np.floor(u).min(1)).all() and set(np.floor(u).ravel()) == {0, 1}
        parts = [on_tile(got, t, 2) for t in (0, 1)]
        assert sum(len(p.faces) for p in parts) == len(made["faces"])
        assert all(p.uvs[p.uv_faces].min() >= 0 and p.uvs[p.uv_faces].max() <= 1 for p in parts)


def test_overlaps_along_an_edge_are_found() -> None:
    """Two texture triangles that share a strip of six texels beside one edge of each."""
    from stages.usd.check.chart_checks import overlap

    uvs = np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.8], [0.9, 0.106], [0.1, 0.106], [0.5, 0.02]], np.float32)
    faces = np.arange(6, dtype=np.int32).reshape(2, 3)
    points = np.c_[uvs, np.zeros(6)].astype(np.float32)
    apart = without_overlap(UvSurface(points, np.tile(np.float32([0, 0, 1]), (6, 1)), faces, uvs, faces))
    before, after = (overlap(t.astype(np.float64)) for t in (uvs[faces], apart.uvs[apart.uv_faces]))
    assert before > 0.01 and after < before / 3
