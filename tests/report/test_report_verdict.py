"""The verdict at the top of the page, with the photos that it names; all checks in metrics.json."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.synthetic_results import SyntheticResults, write_results

from pipeline.artifacts import Located
from pipeline.contract import Context
from pipeline.verdict import Finding, Limits, Verdict, judged
from stages.report.stage import STAGE, Config, Inputs
from stages.report.verdict import PHOTOS_SHOWN, TROUBLES_SHOWN, verdict_shown

LIMITS = Limits(0.9, 0.5)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> SyntheticResults:
    return write_results(tmp_path_factory.mktemp("results"))


def decoded(uri: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(uri.partition("base64,")[2]), np.uint8), cv2.IMREAD_COLOR)


def found(results: SyntheticResults, **findings: tuple[Finding, ...]) -> SyntheticResults:
    """With these findings of these stages."""
    changed = {
        name: Located(getattr(results, name).artifact.model_copy(update={"findings": f}), getattr(results, name).folder)
        for name, f in findings.items()
    }
    return replace(results, **changed)


HELD_OUT = ("held_out_psnr", "held_out_mask_iou", "held_out_worst", "asset_against_model")  # the report's own, all good


def page_of(results: SyntheticResults, folder: Path) -> tuple[dict, str]:
    folder.mkdir(parents=True)
    STAGE.run(Inputs(**{n: getattr(results, n) for n in Inputs.__slots__}), Config(), Context(folder, folder / "s"))
    return json.loads((folder / "metrics.json").read_text()), (folder / "index.html").read_text()


def test_level_sentence_remedy_photo_and_table(results: SyntheticResults, tmp_path: Path) -> None:
    bad = judged(
        "mask_agreement", 0.2, LIMITS, "20 % <b>agree</b> & no more.", "shoot <again>", views=["3.png", "9.png"]
    )
    good = judged("photos_placed", 1.0, LIMITS, "All photos were placed.", "")
    metrics, page = page_of(found(results, masks=(bad,), poses=(good,)), tmp_path / "work")
    top = page[page.index('<section class="verdict unusable"') : page.index('<section class="figures"')]
    assert page.index('<section class="verdict') < page.index('<section class="warnings"')
    assert '<details class="troubles"><summary>' in top and "1 finding</b></span>; first, masks: 20 %" in top  # folded
    assert "\u2715 Unusable" in top  # the level in words and by a mark, not by colour alone
    assert (
        "20 % &lt;b&gt;agree&lt;/b&gt; &amp; no more." in top
        and "shoot &lt;again&gt;." in top
        and "<b>agree" not in page
    )
    assert top.count("data:image/jpeg") == 2 and 'alt="3.png"' in top and 'alt="9.png"' in top
    assert "<summary>All 6 checks</summary>" in top and "All photos were placed." in top
    verdict = metrics["verdict"]
    assert verdict["level"] == "unusable" and verdict["stages"]["masks"] == "unusable"
    assert list(verdict["stages"]) == [*Inputs.__slots__, "report"]
    assert [(f["stage"], f["check"], f["level"]) for f in verdict["findings"]] == [
        ("poses", "photos_placed", "good"),
        ("masks", "mask_agreement", "unusable"),
        *(("report", check, "good") for check in HELD_OUT),
    ]


def test_good_results_say_so(results: SyntheticResults, tmp_path: Path) -> None:
    metrics, page = page_of(results, tmp_path / "work")
    assert metrics["verdict"]["level"] == "good"
    assert [f["check"] for f in metrics["verdict"]["findings"]] == list(HELD_OUT)
    assert '<section class="verdict good"' in page and "\u2713 Good" in page and "<summary>All 4 checks" in page


def test_without_any_check_there_is_no_table(tmp_path: Path) -> None:
    metrics, page = page_of(write_results(tmp_path / "results", held_out=()), tmp_path / "work")
    assert metrics["verdict"]["findings"] == [] and "<summary>All" not in page


def test_few_photos_and_few_troubles_the_worst_first(results: SyntheticResults) -> None:
    names = [v.name for v in results.capture.artifact.views]
    fair = judged("a", 0.7, LIMITS, "Some.", "x", views=["gone.jpg", *names])
    bad = judged("b", 0.1, LIMITS, "Few.", "y")
    shown = verdict_shown(Verdict({"capture": (fair,) * 8, "uv": (bad,)}), results, 60)
    assert [t.finding.check for t in shown.troubles] == ["b", *["a"] * (TROUBLES_SHOWN - 1)]
    assert shown.more == 9 - TROUBLES_SHOWN and len(shown.checks) == 9
    first = shown.troubles[1]
    assert [p.caption for p in first.pictures] == names[: PHOTOS_SHOWN - 1]  # one of the first few has no photo
    assert first.unseen == ["gone.jpg", *names[PHOTOS_SHOWN - 1 :]]


def test_a_photo_without_a_mask_is_shown_as_it_is(results: SyntheticResults) -> None:
    masks = results.masks.artifact.model_copy(update={"masks": ()})
    shown = verdict_shown(
        Verdict({"poses": (judged("a", 0.1, LIMITS, "Lost.", "x", views=["3.png"]),)}),
        replace(results, masks=Located(masks, results.masks.folder)),
        60,
    )
    (picture,) = shown.troubles[0].pictures
    outlined = verdict_shown(
        Verdict({"poses": (judged("a", 0.1, LIMITS, "Lost.", "x", views=["3.png"]),)}), results, 60
    )
    assert picture.caption == "3.png"
    with_mask, without = (decoded(p.uri) for p in (outlined.troubles[0].pictures[0], picture))
    (view,) = (v for v in results.capture.artifact.views if v.name == "3.png")
    photo = cv2.imread(str(results.capture.path(view.image)))
    small = cv2.resize(photo, without.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(without.astype(float) - small).mean() < 6 < np.abs(with_mask.astype(float) - small).max()
