"""Nothing of a finished fit is lost to a check: the asset is written, and its findings say what it is worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.synthetic_asset import ball, run_stage, write_inputs

from stages.usd import judge
from stages.usd.check.findings import Finding as Check
from stages.usd.check.validate import found_in


def levels(asset) -> dict[str, str]:
    return {f.check: f.level for f in asset.findings}


def collapsed() -> dict[str, np.ndarray]:
    """The synthetic ball with every tenth face on a line of the texture."""
    mesh = ball()
    uvs, faces = mesh["uvs"].copy(), mesh["uv_faces"].copy()
    some = np.arange(0, len(faces), 10)
    line = uvs[faces[some]].reshape(-1, 2).copy()
    line[:, 1] = 0.5
    faces[some] = len(uvs) + np.arange(len(line)).reshape(-1, 3)
    return mesh | {"uvs": np.concatenate([uvs, line]), "uv_faces": faces}


@pytest.mark.slow
def test_an_asset_with_faults_is_written_and_marked(tmp_path: Path) -> None:
    asset = run_stage(write_inputs(tmp_path / "in", mesh=collapsed()), tmp_path / "work")
    (faults,) = (f for f in asset.findings if f.check == "usd_faults")
    assert faults.level == "unusable" and faults.value >= 1
    assert "has no area in the texture" in faults.said and "head.usd" in faults.said
    for file in ("head.usd", "head.usdz", "head.glb", "lookdev.usda"):
        assert (tmp_path / "work/asset" / file).is_file()
    assert asset.views and any("no area" in w for w in asset.warnings)


def test_a_sound_asset_has_no_fault(exported) -> None:
    found = levels(exported[1])
    assert found["usd_faults"] == "good" and found["usd_warnings"] == "good"
    # the shaders' lobe is fitted to the photos on its own: that it is not the field's is no fault of the asset
    assert "ggx_residual" not in found and "ggx_residual" in exported[1].figures
    assert found["asset_against_model"] == "unusable"  # the synthetic fit's predictions are plain cards


def test_a_file_that_cannot_be_opened_is_a_fault(tmp_path: Path) -> None:
    broken = tmp_path / "head.usd"
    broken.write_text("no USD")
    (fault, _) = judge.validity([(broken.name, f) for f in found_in(broken)])
    assert fault.level == "unusable" and "can't be opened" in fault.said


def test_a_fault_of_two_files_counts_once() -> None:
    same = Check("error", "st", "3 % of the surface has no area in the texture", "/head/geo/render")
    others = [Check("error", f"fault{i}", "of a kind") for i in range(5)]
    faults, warnings = judge.validity([("head.usd", same), ("lookdev.usda", same), *(("head.usd", o) for o in others)])
    assert faults.value == 6 and "and 3 more" in faults.said and warnings.level == "good"
    _, warned = judge.validity([("head.usd", Check("warning", "st_overlap", "0.4 %"))])
    assert warned.level == "usable" and "0.4 %" in warned.said


def picture(seed: int = 0) -> np.ndarray:
    """A disc with noise in it, linear premultiplied RGBA."""
    y, x = np.mgrid[:64, :64]
    inside = (np.hypot(x - 32, y - 32) < 24).astype(np.float32)[..., None]
    colour = np.random.default_rng(seed).uniform(0.1, 0.6, (64, 64, 3)).astype(np.float32)
    return np.concatenate([colour * inside, inside], -1)


def test_the_asset_is_compared_with_the_model() -> None:
    same = judge.against_model([("a.jpg", picture(), picture())])
    assert [f.level for f in same] == ["good", "good", "good"] and same[0].value == pytest.approx(100)
    near = picture() + np.float32([0.02, 0.02, 0.02, 0]) * picture()[..., 3:]
    assert judge.against_model([("a.jpg", picture(), near)])[0].level == "good"
    found = judge.against_model([("a.jpg", picture(), near), ("b.jpg", picture(), picture(1))])
    assert found[0].level == "unusable" and found[0].views[0] == "b.jpg" and found[0].unit == "dB"
    shifted = np.roll(picture(), 3, axis=1)
    assert judge.against_model([("a.jpg", picture(), shifted)])[1].level == "unusable"
    assert judge.against_model([("a.jpg", picture(), np.zeros_like(picture()))])[1].value == 0
    assert judge.against_model([]) == ()


def face(spot: float = 0.0, radius: float = 60.0) -> np.ndarray:
    """A bright disc, linear premultiplied RGBA, with a black spot of a radius in pixels."""
    y, x = np.mgrid[:160, :160]
    inside = (np.hypot(x - 80, y - 80) < radius).astype(np.float32)[..., None]
    colour = np.full((160, 160, 3), 0.5, np.float32)
    colour[np.hypot(x - 70, y - 60) < spot] = 0
    return np.concatenate([colour * inside, inside], -1)


def test_a_black_spot_that_the_model_does_not_have_is_told() -> None:
    assert judge.spots(face(), face(spot=4)) == judge.spots(face(spot=4), face()) == 1
    assert judge.spots(face(), face()) == judge.spots(face(spot=4), face(spot=4)) == 0
    assert judge.spots(face(), face(spot=0.9)) == 0  # one pixel
    assert judge.spots(face(), face(radius=55)) == 0  # a smaller outline is no spot
    hole = face()
    hole[56:64, 66:74] = 0  # transparent
    assert judge.spots(face(), hole) == 1
    dim = face() * np.float32([0.5, 0.5, 0.5, 1])
    assert judge.spots(face(), dim) == 0  # another exposure is no spot


def test_spots_in_most_views_are_a_finding() -> None:
    good, bad = ("a", face(), face()), ("b", face(), face(spot=4))
    for views, level, named in (([good, bad], "good", []), ([bad, bad, good], "usable", ["b", "b"])):
        found = {f.check: f for f in judge.against_model(views)}["asset_spots"]
        assert found.level == level and list(found.views) == named


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_pictures_of_nothing_have_no_spots(value: float) -> None:
    nothing = np.zeros((32, 32, 4), np.float32)
    assert judge.spots(nothing, nothing) == judge.spots(np.full_like(nothing, value), nothing) == 0
    assert judge.spots(nothing, np.full_like(nothing, value)) == 0
