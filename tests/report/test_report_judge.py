"""The judge of held-out views on made-up scores, sound and ruined, and through the stage."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from support.synthetic_results import write_results

from pipeline.contract import Context
from pipeline.verdict import Finding
from stages.report.judge import judge
from stages.report.metrics import Scores
from stages.report.stage import STAGE, Config, Inputs

SOUND = Scores(35.6, 35.7, 37.0, 0.98, 0.02, 0.997)
NAMES = {i: f"p{i}.jpg" for i in range(9)}


@dataclass(frozen=True)
class Row:
    index: int
    asset: Scores | None = SOUND
    model: Scores | None = SOUND
    held_out: bool = True
    features: dict[str, float] = field(default_factory=dict)


def rows(**changes: float) -> list[Row]:
    """Nine views, each scored a little below the one before."""
    one = replace(SOUND, **changes)
    return [
        Row(i, replace(one, psnr_matched=one.psnr_matched - i / 10, mask_iou=one.mask_iou - i / 1e4)) for i in range(9)
    ]


def by_name(made: list[Row]) -> dict[str, Finding]:
    return {f.check: f for f in judge(made, NAMES)}


def test_a_sound_asset_is_good() -> None:
    found = by_name(rows())
    assert set(found) == {"held_out_psnr", "held_out_mask_iou", "held_out_worst", "asset_against_model"}
    assert {f.level for f in found.values()} == {"good"}
    assert "35.3 dB" in found["held_out_psnr"].said and "p8.jpg" in found["held_out_worst"].said


@pytest.mark.parametrize(("psnr", "level"), [(29.0, "good"), (23.0, "usable"), (17.2, "unusable")])
def test_psnr(psnr: float, level: str) -> None:
    found = by_name(rows(psnr_matched=psnr, psnr=10.0))["held_out_psnr"]  # raw: exposures that nothing tells
    assert found.level == level
    assert found.views == (() if level == "good" else tuple(f"p{i}.jpg" for i in range(8, -1, -1)))


@pytest.mark.parametrize(("iou", "level"), [(0.97, "good"), (0.9, "usable"), (0.35, "unusable")])
def test_silhouettes(iou: float, level: str) -> None:
    found = by_name(rows(mask_iou=iou))["held_out_mask_iou"]
    assert found.level == level and found.views[:1] == (() if level == "good" else ("p8.jpg",))


@pytest.mark.parametrize(("below", "level"), [(5.0, "good"), (8.0, "usable"), (20.0, "unusable")])
def test_one_view_far_below_the_others(below: float, level: str) -> None:
    made = [Row(i, replace(SOUND, psnr_matched=SOUND.psnr_matched - below * (i == 3))) for i in range(9)]
    found = by_name(made)["held_out_worst"]
    assert found.level == level and found.value == pytest.approx(below)
    assert found.views == (() if level == "good" else ("p3.jpg",))


@pytest.mark.parametrize(("lost", "level"), [(0.3, "good"), (1.9, "usable"), (5.0, "unusable"), (-1.0, "good")])
def test_what_the_export_costs(lost: float, level: str) -> None:
    made = [Row(i, replace(SOUND, psnr=SOUND.psnr - lost, psnr_matched=27.0)) for i in range(3)]
    assert by_name(made)["asset_against_model"].level == level


@pytest.mark.parametrize(("matched", "level"), [(28.1, "usable"), (27.9, "unusable")])
def test_an_asset_that_shows_its_photos_is_not_broken(matched: float, level: str) -> None:
    made = [Row(i, replace(SOUND, psnr=SOUND.psnr - 4, psnr_matched=matched)) for i in range(3)]
    assert by_name(made)["asset_against_model"].level == level


def test_fitted_views_say_nothing() -> None:
    fitted = [Row(i, replace(SOUND, psnr_matched=5.0), held_out=False) for i in range(3)]
    assert judge(fitted, NAMES) == () and judge([], NAMES) == ()
    assert {f.level for f in judge([*fitted, *rows()], NAMES)} == {"good"}


def test_the_model_counts_where_no_asset_was_rendered() -> None:
    found = by_name([Row(i, None, replace(SOUND, psnr_matched=20.0)) for i in range(3)])
    assert found["held_out_psnr"].level == "usable" and "asset_against_model" not in found
    assert judge([Row(0, None, None)], NAMES) == ()


def test_through_the_stage(tmp_path: Path) -> None:
    """The asset's renders are grey discs, as the photos' masks are; its colours are not the photos'."""
    results = write_results(tmp_path / "results")
    named = {n: getattr(results, n) for n in Inputs.__slots__}
    made = STAGE.run(Inputs(**named), Config(), Context(tmp_path, tmp_path / "scratch"))
    found = {f.check: f for f in made.findings}
    assert found["held_out_mask_iou"].value == 1.0 and found["held_out_mask_iou"].level == "good"
    assert {"held_out_psnr", "held_out_worst"} <= set(found)


def test_features_of_the_face() -> None:
    """The farthest of all held-out photos decides; ears, which hair may cover, don't."""
    made = [replace(r, features={"nose": 0.5, "left ear": 11.0}) for r in rows()]
    assert by_name(made)["features"].level == "good" and by_name(made)["features"].views == ()
    made[4] = replace(made[4], features={"chin": 4.4, "nose": 1.0})
    found = by_name(made)["features"]
    assert found.level == "usable" and found.value == 4.4 and found.views == ("p4.jpg",) and "chin" in found.said
    made[4] = replace(made[4], held_out=False)
    assert by_name(made)["features"].level == "good" and "features" not in by_name(rows())
