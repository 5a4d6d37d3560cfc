"""A subject before a grey backdrop that has the backdrop's colour at a part of its contour."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from stages.masks import key_person, sources
from stages.masks.key_person import Network, agree_better, both, key_with_person
from stages.masks.keying import Background, key_out, keyed
from stages.masks.region import Disc
from tests.masks.test_masks_stage import ROI, SIZE, Scene, ball_alpha, build, camera, iou, paint, run

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]
GREY = 0.5
TRUTH: dict[bytes, F32] = {}


def greyed(alpha: F32, image: F32) -> F32:
    """The photo with a part of the subject, at its contour, in the backdrop's grey."""
    ys, xs = np.nonzero(alpha > 0.02)
    part = np.zeros((SIZE, SIZE, 1), bool)
    part[ys.min() : ys.min() + 30, (xs.min() + xs.max()) // 2 - 12 : (xs.min() + xs.max()) // 2 + 12] = True
    return np.asarray(np.where(part & (alpha > 0)[..., None], GREY, image), np.float32)


def eight(image: F32) -> U8:
    return np.asarray(np.round(image * 255), np.uint8)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Twelve views of a ball before grey; every second one has lost a part to the grey."""
    made = build(tmp_path / "capture", 12, GREY)
    TRUTH.clear()
    for c in made.cameras:
        alpha = ball_alpha(c)
        image = paint(alpha, GREY)
        if c.index % 2 == 0:
            image = greyed(alpha, image)
            made.repaint(c.index, image)
        TRUTH[eight(image).tobytes()] = alpha
    return made


def network(monkeypatch: pytest.MonkeyPatch, wrong: bool = False, blind: bool = False) -> list[int]:
    """A network that knows the truth; `wrong`: it adds another corner of the backdrop in each photo. The calls."""
    calls: list[int] = []

    def mask(image: U8, *_: object) -> npt.NDArray[np.bool_]:
        calls.append(1)
        inside = TRUTH[image.tobytes()] >= 0.5
        if wrong:
            inside |= np.roll(inside, 45 if len(calls) % 2 else -45, axis=len(calls) // 2 % 2)
        return inside

    def probability(image: U8, _: Disc) -> tuple[F32, float]:
        return (np.zeros((SIZE, SIZE), np.float32) if blind else TRUTH[image.tobytes()]), 1.0

    monkeypatch.setattr(key_person, "person_mask", mask)
    monkeypatch.setattr(key_person, "person_probability", probability)
    return calls


def test_the_network_gives_back_what_the_key_takes(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network(monkeypatch)
    found, alphas = run(scene, tmp_path / "s")
    assert {m.source for m in found.masks} == {"key+person"} and found.dropped == ()
    ious = [iou(a, ball_alpha(c)) for a, c in zip(alphas, scene.cameras, strict=True)]
    assert min(ious) > 0.985
    bare, keyed = run(scene, tmp_path / "s", method="key")  # as the user says
    assert {m.source.split("+")[0] for m in bare.masks} == {"key"} and "key+person" not in {
        m.source for m in bare.masks
    }
    lost = [iou(a, ball_alpha(c)) for a, c in zip(keyed, scene.cameras, strict=True) if c.index % 2 == 0]
    assert max(lost) < 0.95


def test_masks_that_agree_no_better_stay_keyed(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network(monkeypatch, wrong=True)
    found, _ = run(scene, tmp_path / "s")
    assert "key+person" not in {m.source for m in found.masks}


@pytest.mark.parametrize("blind", [True, False])
def test_a_key_that_takes_nothing_asks_no_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blind: bool) -> None:
    """Nothing of what the network sees is lost, or it sees no person at all."""
    whole = build(tmp_path / "capture", 12, GREY)
    TRUTH.update({eight(paint(ball_alpha(c), GREY)).tobytes(): ball_alpha(c) for c in whole.cameras})
    calls = network(monkeypatch, blind=blind)
    found, _ = run(whole, tmp_path / "s")
    assert {m.source for m in found.masks} == {"key"} and not calls


def test_the_keys_contour_stays_where_it_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network whose contour is a pixel off all around adds nothing; one with a whole part more does."""
    c = camera(5, 12)
    truth = ball_alpha(c)
    image, background, how = eight(paint(truth, GREY)), Background((128, 128, 128), 5.0), Network(0.5, SIZE, 0)
    disc = Disc(SIZE / 2, SIZE / 2, 50, 0)
    wider = ball_alpha(c, 0.1025) >= 0.5
    assert wider.sum() > (truth >= 0.5).sum() + 100
    monkeypatch.setattr(key_person, "person_mask", lambda *_: wider)
    assert np.array_equal(key_with_person(image, disc, background, how), key_out(image, background))
    holed = eight(greyed(truth, paint(truth, GREY)))
    own, inside = keyed(holed, background), truth >= 0.5
    whole = both(holed, disc, own, how)
    assert (inside & ~own).sum() > 600 and not (inside & ~whole).any()
    assert (whole & ~own & ~inside).sum() < 40  # the part's own edge; all around it would be 250


@pytest.mark.parametrize(
    ("helped", "alone", "better"),
    [(0.96, 0.95, True), (0.95, 0.95, False), (0.95, 0.96, False), (0.82, 0.80, False), (0.90, 0.10, True)],
)
def test_masks_that_contradict_each_other_choose_nothing(helped: float, alone: float, better: bool) -> None:
    """Photos under the wrong cameras: the larger of two masks agrees a little better, and says nothing."""
    assert agree_better(helped, alone) == better


def test_radius_of_the_region_counts(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The agreement is that of hulls in the capture's own units."""
    asked: list[float] = []
    network(monkeypatch)

    def agreement(*given: Any) -> float:
        asked.append(given[-1])
        return 0.0

    monkeypatch.setattr(sources, "_mean_iou", agreement)
    run(scene, scene.folder / "s")
    assert asked == [ROI, ROI]
