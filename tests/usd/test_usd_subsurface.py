"""look=subsurface: which materials scatter, where, how far, and that nothing else of the asset changes."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdShade
from support.synthetic_asset import SyntheticInputs, run_stage

from pipeline.artifacts import Located
from pipeline.faces.labels import EYES, FACE, HAIR, SUBJECT
from pipeline.images import read_exr
from stages.usd.write import export, subsurface
from stages.usd.write.tile_materials import TileMaterial, scattering

METRES = 1.0  # metersPerUnit of the asset


def test_free_paths_are_those_of_measured_skin() -> None:
    """Jensen et al. 2001, figure 5, skin1, in 1/mm; the mean free path in mm, written out by hand."""
    by_hand = [1 / (0.74 + 0.032), 1 / (0.88 + 0.17), 1 / (1.01 + 0.48)]
    assert [1e3 * p for p in subsurface.mean_free_path()] == pytest.approx(by_hand, rel=1e-12)
    radius, scale = subsurface.radius_and_scale()
    assert [1e3 * METRES * radius * s for s in scale] == pytest.approx(by_hand, rel=1e-3)
    assert max(scale) == 1


def test_hair_and_eyes_do_not_scatter() -> None:
    region = np.full((64, 64), SUBJECT, np.float32)
    region[:, 20:], region[40:, 20:], region[40:, 42:] = FACE, HAIR, EYES
    found = subsurface.weights(region)
    assert found[:30].min() > 0.99 and found[50:, 30:].max() < 0.01
    border = found[30:50, 50]
    assert (np.diff(border) <= 0).all() and border[0] > 0.99 and border[-1] < 0.01  # it is soft, and monotone
    assert found.dtype == np.float32


@pytest.mark.parametrize("code", [0, HAIR, 255])
def test_a_map_of_one_code(code: int) -> None:
    for shape in ((1, 1), (5, 3)):
        assert np.array_equal(subsurface.weights(np.full(shape, code, np.float32)), np.full(shape, code != HAIR))


def test_only_skin_scatters() -> None:
    names = ("skin", "captured", "captured_1002", "captured_scan", "mouth", "eyes_and_mouth", "clothes_1003", "hair")
    made = [TileMaterial(n, i) for i, n in enumerate(names)] + [TileMaterial("eyes", 0, eyes=True)]
    assert scattering(made) == ("skin", "captured", "captured_1002", "captured_scan")


def metric(inputs: SyntheticInputs, known: bool) -> SyntheticInputs:
    poses = inputs.poses.artifact.model_copy(update={"metric": known})
    return replace(inputs, poses=Located(poses, inputs.poses.folder))


@pytest.fixture(scope="module")
def scattered(inputs: SyntheticInputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scattered")
    made = run_stage(metric(inputs, True), folder, subsurface=True)
    assert not [w for w in made.warnings if "subsurface" in w]
    return folder / "asset"


def test_the_look_is_a_variant(scattered: Path) -> None:
    stage = Usd.Stage.Open(str(scattered / "head.usd"))
    looks = stage.GetDefaultPrim().GetVariantSet("look")
    assert looks.GetVariantSelection() == "standard" and "subsurface" in looks.GetVariantNames()
    for look, network in (("subsurface", "openpbr_subsurface"), ("standard", "openpbr")):
        looks.SetVariantSelection(look)
        material = UsdShade.Material(stage.GetPrimAtPath("/head/mtl/captured"))
        surface = material.ComputeSurfaceSource("mtlx")[0]
        assert surface.GetPath().GetParentPath().name == network
    surface = UsdShade.Shader(stage.GetPrimAtPath("/head/mtl/captured/openpbr_subsurface/surface"))
    radius, scale = (surface.GetInput(f"subsurface_radius{e}").Get() for e in ("", "_scale"))
    assert [METRES * radius * s for s in scale] == pytest.approx(subsurface.mean_free_path(), rel=1e-3)
    weight = surface.GetInput("subsurface_weight").GetConnectedSource()[0]
    file = UsdShade.Shader(weight.GetPrim()).GetInput("file").Get()
    values = read_exr(Path(file.resolvedPath))[0]
    assert 0 <= values.min() <= values.max() == 1
    colours = [surface.GetInput(n).GetConnectedSource()[0].GetPath() for n in ("base_color", "subsurface_color")]
    assert colours[0] == colours[1]


def test_the_package_and_the_other_looks_know_nothing_of_it(scattered: Path) -> None:
    package = Usd.Stage.Open(str(scattered / "head.usdz"))
    assert not [p for p in package.Traverse() if "subsurface" in str(p.GetPath())]
    plain = Usd.Stage.Open(str(scattered / "head.usd"))
    opaque = UsdShade.Shader(plain.GetPrimAtPath("/head/mtl/captured/openpbr/surface"))
    assert not [i for i in opaque.GetInputs() if "subsurface" in i.GetBaseName()]


def test_without_a_metric_scale_it_is_left_out(inputs: SyntheticInputs, tmp_path: Path) -> None:
    made = run_stage(metric(inputs, False), tmp_path, subsurface=True)
    assert [w for w in made.warnings if "look=subsurface was left out: the asset's scale is not metric" in w]
    assert not list((tmp_path / "asset").rglob("*subsurface*")) and not (tmp_path / "asset" / export.SCATTER).exists()


def test_the_script_for_blender_has_the_same_lengths(scattered: Path) -> None:
    text = (scattered / export.SCATTER).read_text()
    found = re.search(r"FREE_PATH = \((.*?)\)", text)
    assert found is not None
    assert [float(x) for x in found[1].split(",")] == pytest.approx(subsurface.mean_free_path(), abs=5e-7)
    assert sum(bool(line.strip()) for line in text.splitlines()) <= 50  # a user reads it before running it
