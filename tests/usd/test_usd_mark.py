"""The asset says how good it is: in NAME.usd, in NAME.usdz, and from all inputs' findings."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from pxr import Usd
from support.synthetic_asset import SyntheticInputs, run_stage

from pipeline.artifacts import Located
from pipeline.verdict import Limits, Verdict, judged
from stages.usd.check.validate import validate
from stages.usd.write.mark import mark
from stages.usd.write.package import read_package

BAD = judged("hull", 0.2, Limits(0.9, 0.5), 'The hull is "open" at 20 %.', "mask the neck", views=["a.jpg"])
FAIR = judged("sharp", 0.7, Limits(0.9, 0.5), "70 % are sharp.", "use a tripod")
GOOD = judged("seen", 0.95, Limits(0.9, 0.5), "95 % are seen.", "")


@pytest.fixture
def asset(exported, tmp_path: Path) -> Path:
    """The root layer of a copy that may be changed."""
    return Path(shutil.copytree(exported[0] / "asset", tmp_path / "asset")) / "head.usd"


def said(file: Path) -> tuple[str, list[str]]:
    """What a program that opens the file reads; the same from the prim and from the layer."""
    stage = Usd.Stage.Open(str(file))
    prim = stage.GetDefaultPrim()
    level, reasons = (prim.GetAssetInfoByKey(f"neuface:{k}") for k in ("verdict", "verdictReasons"))
    assert dict(stage.GetRootLayer().customLayerData["neuface"]) == {"verdict": level, "verdictReasons": reasons}
    assert prim.GetAssetInfoByKey("name") == "head"  # what was there is still there
    return level, list(reasons)


@pytest.mark.parametrize("name", ["head.usd", "head.usdz"])
def test_the_mark_is_read_by_others_and_breaks_nothing(asset: Path, name: str) -> None:
    before = sorted(map(str, validate(asset)))
    pictures = read_package(asset.with_suffix(".usdz"))[1:]
    mark(asset, Verdict({"masks": (FAIR, GOOD), "surface": (BAD,)}))
    level, reasons = said(asset.with_name(name))
    assert level == "unusable"
    assert reasons == [f"surface: {BAD}", f"masks: {FAIR}"]
    assert "20 % (a.jpg). What to do: mask the neck." in reasons[0]
    assert sorted(map(str, validate(asset))) == before and validate(asset.with_suffix(".usdz")) == []
    assert read_package(asset.with_suffix(".usdz"))[1:] == pictures


def test_a_good_asset_says_so(asset: Path) -> None:
    mark(asset, Verdict({"masks": (GOOD,)}))
    for file in (asset, asset.with_suffix(".usdz")):
        assert said(file) == ("good", [])


def test_the_export_marks_the_asset_with_its_own_findings_too(exported) -> None:
    folder, made = exported
    verdict = Verdict({"usd": made.findings})  # those before it found nothing
    for name in ("head.usd", "head.usdz"):
        assert said(folder / "asset" / name) == (verdict.level, list(verdict.reasons()))


def test_a_mark_replaces_another_and_gives_the_same_bytes(asset: Path) -> None:
    files = (asset, asset.with_suffix(".usdz"))
    mark(asset, Verdict({"a": (FAIR,)}))
    first = [f.read_bytes() for f in files]
    mark(asset, Verdict({"a": (BAD,)}))
    assert [f.read_bytes() for f in files] != first
    mark(asset, Verdict({"a": (FAIR,)}))
    assert [f.read_bytes() for f in files] == first


@pytest.mark.parametrize(
    "name", ["capture", *(pytest.param(s, marks=pytest.mark.slow) for s in ("masks", "inverse_rendering", "bake"))]
)
@pytest.mark.slow
def test_findings_of_every_stage_before_count(inputs: SyntheticInputs, tmp_path: Path, name: str) -> None:
    located = getattr(inputs, name)
    found = Located(located.artifact.model_copy(update={"findings": (FAIR,)}), located.folder)
    run_stage(replace(inputs, **{name: found}), tmp_path, render_views=False, high=False, glb=False, obj=False)
    assert said(tmp_path / "asset/head.usd") == ("usable", [f"{name}: {FAIR}"])
