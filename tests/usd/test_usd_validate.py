"""validate() finds each fault on its own, and nothing in a sound asset."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from pipeline.errors import StageError
from pipeline.meshes import fans
from stages.usd.check.chart_checks import overlap
from stages.usd.check.validate import checks_run, validate
from stages.usd.judge import validity


@pytest.fixture
def asset(exported, tmp_path: Path) -> Path:
    """A copy of the exported asset that a test may break."""
    shutil.copytree(exported[0] / "asset", tmp_path / "asset")
    return tmp_path / "asset"


@pytest.mark.parametrize("name", ["head.usd", "lookdev.usda", "head.usdz"])
def test_sound_assets_have_no_finding(asset: Path, name: str) -> None:
    assert [f for f in validate(asset / name) if f.level != "info"] == []
    assert checks_run() >= 30


def edit(asset: Path, change: Callable[[Usd.Stage], None], layer: str = "payload.usdc") -> None:
    stage = Usd.Stage.Open(str(asset / layer))
    change(stage)
    stage.GetRootLayer().Save()


def mesh(stage: Usd.Stage) -> UsdGeom.Mesh:
    return UsdGeom.Mesh.Get(stage, "/head/geo/render")


def shader(stage: Usd.Stage, name: str) -> UsdShade.Shader:
    return UsdShade.Shader.Get(stage, f"/head/mtl/captured/{name}")


def drop_last_index(stage: Usd.Stage) -> None:
    attribute = mesh(stage).GetFaceVertexIndicesAttr()
    attribute.Set(list(attribute.Get())[:-1])


def index_too_large(stage: Usd.Stage) -> None:
    attribute = mesh(stage).GetFaceVertexIndicesAttr()
    values = list(attribute.Get())
    values[7] = 10**6
    attribute.Set(values)


def drop_st_index(stage: Usd.Stage) -> None:
    st = UsdGeom.PrimvarsAPI(mesh(stage)).GetPrimvar("st")
    st.SetIndices(list(st.GetIndices())[:-1])


def st_index_too_large(stage: Usd.Stage) -> None:
    st = UsdGeom.PrimvarsAPI(mesh(stage)).GetPrimvar("st")
    values = list(st.GetIndices())
    values[0] = 10**6
    st.SetIndices(values)


def st_outside(stage: Usd.Stage) -> None:
    st = UsdGeom.PrimvarsAPI(mesh(stage)).GetPrimvar("st")
    st.Set([Gf.Vec2f(v[0] + 1, v[1]) for v in st.Get()])


def change_st(stage: Usd.Stage, change: Callable[[np.ndarray], np.ndarray]) -> None:
    st = UsdGeom.PrimvarsAPI(mesh(stage)).GetPrimvar("st")
    st.Set([Gf.Vec2f(*v) for v in change(np.asarray(st.Get(), np.float64)).tolist()])


def folded_over(stage: Usd.Stage) -> None:
    """The right half of the texture on the left one."""
    change_st(stage, lambda st: np.stack([np.abs(st[:, 0] - 0.5) + 0.5, st[:, 1]], 1))


def on_a_line(stage: Usd.Stage) -> None:
    change_st(stage, lambda st: np.stack([st[:, 0], np.full(len(st), 0.5)], 1))


def short_normals(stage: Usd.Stage) -> None:
    attribute = mesh(stage).GetNormalsAttr()
    attribute.Set([v * 0.5 for v in attribute.Get()])


def fewer_normals(stage: Usd.Stage) -> None:
    attribute = mesh(stage).GetNormalsAttr()
    attribute.Set(list(attribute.Get())[:-3])


def inward(stage: Usd.Stage) -> None:
    mesh(stage).GetOrientationAttr().Set("leftHanded")


def nan_point(stage: Usd.Stage) -> None:
    attribute = mesh(stage).GetPointsAttr()
    values = list(attribute.Get())
    values[0] = Gf.Vec3f(float("nan"), 0, 0)
    attribute.Set(values)


def absolute_path(stage: Usd.Stage) -> None:
    value = shader(stage, "albedo").GetInput("file")
    folder = Path(stage.GetRootLayer().realPath).parent
    value.Set(Sdf.AssetPath(str(folder / "textures/head_albedo.png")))


def outside_path(stage: Usd.Stage) -> None:
    shader(stage, "albedo").GetInput("file").Set(Sdf.AssetPath("../asset/textures/head_albedo.png"))


def dangling(stage: Usd.Stage) -> None:
    shader(stage, "preview").GetInput("roughness").GetAttr().SetConnections(["/head/mtl/captured/gone.outputs:r"])


def unbind(stage: Usd.Stage) -> None:
    UsdShade.MaterialBindingAPI(mesh(stage)).UnbindAllBindings()


def grey_normal_map(stage: Usd.Stage) -> None:
    shader(stage, "normal").GetPrim().RemoveProperty("inputs:scale")


def albedo_as_data(stage: Usd.Stage) -> None:
    shader(stage, "albedo").GetInput("sourceColorSpace").Set("raw")


def roughness_as_colour(stage: Usd.Stage) -> None:
    shader(stage, "roughness").GetInput("sourceColorSpace").Set("sRGB")


def openpbr_albedo_as_data(stage: Usd.Stage) -> None:
    shader(stage, "openpbr/albedo").GetInput("file").GetAttr().SetColorSpace("raw")


def basis_table_as_colour(stage: Usd.Stage) -> None:
    shader(stage, "neuface_basis/basis_0").GetInput("file").GetAttr().SetColorSpace("srgb_texture")


def unknown_node(stage: Usd.Stage) -> None:
    shader(stage, "openpbr/weight").CreateIdAttr("ND_wizardry_float")


def unknown_input(stage: Usd.Stage) -> None:
    shader(stage, "openpbr/surface").CreateInput("sparkle", Sdf.ValueTypeNames.Float).Set(1.0)


def wrong_type(stage: Usd.Stage) -> None:
    surface = shader(stage, "openpbr/surface")
    surface.GetPrim().RemoveProperty("inputs:base_weight")
    surface.CreateInput("base_weight", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(1))


def dangling_in_a_variant(stage: Usd.Stage) -> None:
    tint = shader(stage, "neuface_basis/dot_0").GetInput("in1")
    tint.GetAttr().SetConnections(["/head/mtl/captured/neuface_basis/gone.outputs:out"])


FAULTS = [
    (albedo_as_data, "colour_space"),
    (roughness_as_colour, "colour_space"),
    (openpbr_albedo_as_data, "colour_space"),
    (basis_table_as_colour, "colour_space"),
    (unknown_node, "materialx_node"),
    (unknown_input, "materialx_input"),
    (wrong_type, "materialx_type"),
    (dangling_in_a_variant, "connection"),
    (drop_last_index, "topology"),
    (index_too_large, "topology"),
    (nan_point, "points"),
    (lambda s: mesh(s).GetPrim().RemoveProperty("extent"), "extent"),
    (lambda s: mesh(s).GetExtentAttr().Set([(-1, -1, -1), (1, 1, 1)]), "extent"),
    (lambda s: mesh(s).GetPrim().RemoveProperty("subdivisionScheme"), "subdivisionScheme"),
    (drop_st_index, "primvar"),
    (st_index_too_large, "primvar"),
    (st_outside, "st"),
    (folded_over, "st_overlap"),
    (on_a_line, "st"),
    (lambda s: mesh(s).GetPrim().RemoveProperty("primvars:st"), "st"),
    (short_normals, "normals"),
    (fewer_normals, "normals"),
    (inward, "winding"),
    (absolute_path, "absolute_path"),
    (outside_path, "path_outside"),
    (dangling, "connection"),
    (unbind, "material"),
    (grey_normal_map, "NormalMapTextureValidator"),
    (lambda s: s.GetRootLayer().pseudoRoot.ClearInfo("metersPerUnit"), "metersPerUnit"),
    (lambda s: UsdGeom.SetStageUpAxis(s, "Z"), "upAxis"),
    (lambda s: s.RemovePrim("/head/geo"), "mesh"),
]


@pytest.mark.parametrize("change, check", FAULTS, ids=[f"{n}-{c}" for n, (_, c) in enumerate(FAULTS)])
def test_each_fault_is_reported(asset: Path, change: Callable[[Usd.Stage], None], check: str) -> None:
    edit(asset, change)
    found = validate(asset / "head.usd")
    assert any(check in f.check for f in found if f.level == "error"), [str(f) for f in found]
    faults, _ = validity([("head.usd", f) for f in found])
    assert faults.level == "unusable" and check in faults.said


def test_a_mirrored_part_is_worth_a_warning(asset: Path) -> None:
    """The first tenth of the faces with two corners' coordinates exchanged: no overlap, as each keeps its place."""

    def turn(stage: Usd.Stage) -> None:
        st = UsdGeom.PrimvarsAPI(mesh(stage)).GetPrimvar("st")
        index = np.array(st.GetIndices()).reshape(-1, 3)
        some = index[: len(index) // 10]
        some[:] = some[:, [1, 0, 2]]
        st.SetIndices(index.ravel().tolist())

    edit(asset, turn)
    found = [f for f in validate(asset / "head.usd") if f.level != "info"]
    assert found and {(f.level, f.check) for f in found} == {("warning", "st")}
    assert all("mirrored" in f.message for f in found)


@pytest.mark.parametrize("shift, share", [(0.0, 1.0), (0.25, 1 / 3), (0.45, 0.05 / 0.95), (0.5, 0.0)])
def test_overlap_is_the_share_of_covered_texels(shift: float, share: float) -> None:
    """Two squares of half a tile, one moved along: what both cover over what either does. The same on another tile."""
    square = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]) * 0.5
    both = np.concatenate([square, square + [shift, 0]])
    assert overlap(both) == pytest.approx(share, abs=4e-3)
    assert overlap(np.concatenate([both, both + [1, 0]])) == pytest.approx(share, abs=4e-3)
    assert overlap(np.concatenate([square, square + [1, 0]])) == 0


def test_faces_with_more_corners_arefans() -> None:
    assert fans(np.array([3, 5, 4])).tolist() == [
        [0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 7], [8, 9, 10], [8, 10, 11],
    ]  # fmt: skip


def test_missing_kind(asset: Path) -> None:
    edit(asset, lambda s: Usd.ModelAPI(s.GetDefaultPrim()).SetKind(""), "head.usd")
    assert [f.check for f in validate(asset / "head.usd") if f.level == "error"] == ["kind"]


def test_missing_default_prim(asset: Path) -> None:
    edit(asset, lambda s: s.ClearDefaultPrim(), "head.usd")
    assert "defaultPrim" in [f.check for f in validate(asset / "head.usd") if f.level == "error"]


def test_missing_texture(asset: Path) -> None:
    (asset / "textures/head_roughness.png").unlink()
    found = [f for f in validate(asset / "head.usd") if f.level == "error"]
    assert any(f.check == "missing_texture" and "roughness" in f.message for f in found)
    assert not any(str(asset) in str(f) for f in found if f.check == "missing_file")


@pytest.mark.parametrize("content", [b"", b"no picture"])
def test_damaged_texture(asset: Path, content: bytes) -> None:
    (asset / "textures/head_albedo.png").write_bytes(content)
    assert "unreadable_texture" in [f.check for f in validate(asset / "head.usd")]


def test_damaged_environment(asset: Path) -> None:
    (asset / "environment.exr").write_bytes((asset / "environment.exr").read_bytes()[:500])
    assert "unreadable_texture" in [f.check for f in validate(asset / "lookdev.usda")]


def test_missing_payload(asset: Path) -> None:
    (asset / "payload.usdc").unlink()
    checks = [f.check for f in validate(asset / "head.usd") if f.level == "error"]
    assert "missing_file" in checks
    assert "mesh" in checks


def test_damaged_package(asset: Path) -> None:
    from stages.usd.write.package import write_package

    write_package(
        asset / "head.usdz",
        [
            ("textures/head_albedo.png", (asset / "textures/head_albedo.png").read_bytes()),
            ("head.usdc", (asset / "payload.usdc").read_bytes()),
        ],
    )
    with pytest.raises(StageError, match="can't be opened"):
        validate(asset / "head.usdz")


@pytest.mark.parametrize("name, content", [("gone.usd", None), ("empty.usd", b""), ("text.usda", b"hello")])
def test_files_that_do_not_open(tmp_path: Path, name: str, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(StageError, match="can't be opened"):
        validate(tmp_path / name)


def test_findings_are_plain_json(asset: Path) -> None:
    (asset / "textures/head_roughness.png").unlink()
    text = json.dumps([f.json() for f in validate(asset / "head.usd")])
    assert json.loads(text)[0]["level"] == "error"


def test_missing_map_of_another_look(asset: Path) -> None:
    (asset / "internal/head_basis_rgb0.exr").unlink()
    assert "missing_texture" in [f.check for f in validate(asset / "head.usd") if f.level == "error"]


def test_a_variant_without_a_mesh(asset: Path) -> None:
    edit(asset, lambda s: s.RemovePrim("/head/geo/proxy"))
    found = [f for f in validate(asset / "head.usd") if f.level == "error"]
    assert any(f.check == "mesh" and "lod=proxy" in f.message for f in found), found
    stage = Usd.Stage.Open(str(asset / "head.usd"))  # validation leaves the file as it was
    assert stage.GetDefaultPrim().GetVariantSet("lod").GetVariantSelection() == "render"


def test_without_the_materialx_package_that_is_said(asset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "MaterialX", None)
    found = validate(asset / "head.usd")
    assert [f.level for f in found if f.check == "materialx"] == ["info"]
    assert not [f for f in found if f.level == "error"]
