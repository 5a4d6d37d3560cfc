"""Names of textures by a pattern, colour spaces of the base colour, and the displacement in two bands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdShade
from support.synthetic_asset import SyntheticInputs, run_stage
from support.synthetic_head import template_inputs

from pipeline.errors import StageError, UsageError
from pipeline.images import read_exr
from pipeline.meshes import vertex_normals
from stages.usd.check.material_checks import colour_findings
from stages.usd.check.validate import validate
from stages.usd.config import Config
from stages.usd.layout import existing, map_file
from stages.usd.render.exported import load_exported
from stages.usd.texture_names import DEFAULT, NAMES, check_apart, check_pattern, pattern_of, texture_name
from stages.usd.write.maps import low_band
from stages.usd.write.mesh import UvSurface
from workflows.evaluation.geometry import albedo_map


def test_the_default_is_what_it_was(tmp_path: Path) -> None:
    assert texture_name(DEFAULT, "head", "albedo") == "head_albedo"
    assert texture_name(DEFAULT, "head", "albedo", "1002") == "head_albedo.1002"
    assert map_file(tmp_path, "head", "f0", "1001.png") == tmp_path / "textures/head_f0.1001.png"
    assert map_file(tmp_path, "head", "basis_rgb0", "exr") == tmp_path / "internal/head_basis_rgb0.exr"
    assert pattern_of(tmp_path) == DEFAULT


@pytest.mark.parametrize(
    ("pattern", "one", "tile"),
    [
        ("{map}_{asset}_{udim}", "albedo_head", "albedo_head_1003"),
        ("{udim}.{map}", "albedo", "1003.albedo"),
        ("TX-{map}-{udim}-v01", "TX-albedo-v01", "TX-albedo-1003-v01"),
        ("{map}{udim}", "albedo", "albedo1003"),
    ],
)
def test_other_patterns(pattern: str, one: str, tile: str) -> None:
    assert check_pattern(pattern) == pattern
    assert texture_name(pattern, "head", "albedo") == one
    assert texture_name(pattern, "head", "albedo", "1003") == tile


@pytest.mark.parametrize(
    "pattern",
    ["", "{asset}_{map}", "{asset}.{udim}", "{asset}_{map}_{map}.{udim}", "{asset}_{frame}_{map}.{udim}",
     "a/{map}.{udim}", "../{map}.{udim}", ".{map}.{udim}", "{map}.{udim", "{map:>9}.{udim}", "{map!r}.{udim}",
     "{0}{map}.{udim}", "{map} {udim}", "é{map}.{udim}", "{map}.{udim}" + "x" * 100],
)  # fmt: skip
def test_a_bad_pattern_has_a_named_error(pattern: str) -> None:
    with pytest.raises(UsageError, match=r"usd\.texture_name"):
        Config(texture_name=pattern)


def test_two_meshes_need_two_names() -> None:
    check_apart(DEFAULT, ("head", "head_scan"))
    check_apart("{map}.{udim}", ("head",))
    with pytest.raises(StageError, match="the same name"):
        check_apart("{map}.{udim}", ("head", "head_scan"))


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"texture_name": "../{map}{udim}"}', '{"texture_name": 3}'])
def test_a_damaged_file_of_names(content: str, tmp_path: Path) -> None:
    (tmp_path / "internal").mkdir()
    (tmp_path / NAMES).write_text(content)
    with pytest.raises(StageError, match="names of the asset's textures"):
        existing(tmp_path, "head", "albedo", "exr")


def test_a_colour_space_that_does_not_exist() -> None:
    with pytest.raises(UsageError, match=r"usd\.colour_space[\s\S]*srgb_texture, lin_rec709, acescg"):
        Config(colour_space="adobe_1998")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("names")
    inputs = template_inputs(folder / "inputs")
    run_stage(
        inputs, folder / "work", render_views=False, texture_name="{map}-{asset}_{udim}", colour_space="acescg",
        displacement_bands=5.0,
    )  # fmt: skip
    return folder / "work/asset"


def test_an_asset_with_other_names_is_whole(made: Path) -> None:
    assert [f for f in validate(made / "head.usd") if f.level == "error"] == []
    names = {p.name for p in (made / "textures").iterdir()}
    assert {"albedo-head_1001.png", "albedo_acescg-head_1002.exr", "normal-head_1001.exr"} <= names
    assert not any(n.startswith("head_") for n in names)
    assert json.loads((made / NAMES).read_text()) == {"texture_name": "{map}-{asset}_{udim}"}
    assert load_exported(made / "head.usd").albedo.shape[2] == 3 and albedo_map(made / "textures").shape[2] == 3


def spaces(asset: Path) -> dict[str, set[tuple[str, str]]]:
    """File and colour space of the readers `albedo` of MaterialX networks and of preview surfaces."""
    stage = Usd.Stage.Open(str(asset / "head.usd"))
    out: dict[str, set[tuple[str, str]]] = {"mtlx": set(), "preview": set()}
    for prim in stage.Traverse():
        shader = UsdShade.Shader(prim)
        if not shader or prim.GetName() != "albedo":
            continue
        file = shader.GetInput("file")
        if str(shader.GetShaderId()).startswith("ND_"):
            out["mtlx"].add((file.Get().path, file.GetAttr().GetColorSpace()))
        else:
            out["preview"].add((file.Get().path[-4:], shader.GetInput("sourceColorSpace").Get()))
    return out


def test_the_base_colour_has_its_colour_space(made: Path) -> None:
    found = spaces(made)
    assert ("./textures/albedo_acescg-head_<UDIM>.exr", "acescg") in found["mtlx"]
    assert {s for f, s in found["mtlx"] if f.endswith(".exr")} == {"acescg"}
    assert found["preview"] == {(".png", "sRGB")}


def test_an_unknown_colour_space_in_a_file_is_found() -> None:
    stage = Usd.Stage.CreateInMemory()
    shader = UsdShade.Shader.Define(stage, "/a")
    shader.CreateIdAttr("ND_image_color3")
    file = shader.CreateInput("file", Sdf.ValueTypeNames.Asset)
    file.Set(Sdf.AssetPath("a.exr"))
    for space, count in (("lin_rec709", 0), ("acescg", 0), ("raw", 0), ("linear_rec_907", 1)):
        file.GetAttr().SetColorSpace(space)
        assert len(colour_findings(stage)) == count


def test_lin_rec709_reads_the_exr(inputs: SyntheticInputs, tmp_path: Path) -> None:
    run_stage(inputs, tmp_path / "work", render_views=False, colour_space="lin_rec709", usdz=False, glb=False)
    asset = tmp_path / "work/asset"
    found = spaces(asset)
    assert ("./textures/head_albedo.exr", "lin_rec709") in found["mtlx"] and found["preview"] == {(".png", "sRGB")}
    assert [f for f in validate(asset / "head.usd") if f.level == "error"] == []


def test_the_bands_sum_up_to_the_last_bit(made: Path) -> None:
    for tile in (1001, 1002):
        whole, low, high = (
            read_exr(made / f"textures/cage_displacement{e}-head_{tile}.exr")[0] for e in ("", "_low", "_high")
        )
        assert np.array_equal(low + high, whole) and np.abs(whole).max() > 0
        assert whole.dtype == np.float32 and np.abs(high).max() > 0


@pytest.mark.parametrize("wave", [0.005, 0.02, 0.002])
def test_the_low_band_keeps_half_at_its_wavelength(wave: float) -> None:
    """Closed form: a wave of length L keeps (1 + (2^.5 - 1) (W / L)^2)^-2, W the wavelength of the setting."""
    kept = (1 + (2**0.5 - 1) * (0.005 / wave) ** 2) ** -2
    assert wave != 0.005 or kept == pytest.approx(0.5)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 0.1, 801), np.linspace(0, 0.001, 9)))
    at = np.arange(9 * 801).reshape(9, 801)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    flat = np.stack([x, y, 0 * x], 1).astype(np.float32)
    mesh = UvSurface(flat, vertex_normals(flat, faces), faces, flat[:, :2], faces)
    heights = 1e-4 * np.cos(2 * np.pi * x / wave)
    low = low_band(mesh, heights, 0.005)
    middle = np.abs(x - 0.05) < 0.02
    assert np.allclose(low[middle], kept * heights[middle], atol=0.01 * 1e-4)


def test_flat_and_tiny_surfaces_have_a_low_band() -> None:
    flat = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    mesh = UvSurface(flat, vertex_normals(flat, faces), faces, flat[:, :2], faces)
    assert np.allclose(low_band(mesh, np.full(3, 2e-3), 0.005), 2e-3)
    assert np.isfinite(low_band(mesh, np.array([0, 1e-3, 0]), 0.1)).all()
