"""Background in a mask, found by the hull of all masks and the photo's colours: made-up pictures, then the stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.masks import beyond_hull, segment
from stages.masks.beyond_hull import LARGE, LEAST, MAJORITY, MANY, THICK, background, beyond, cut, many, surely
from stages.masks.region import F32, U8, Bool, dilated
from stages.masks.sources import PhotoToMask
from tests.masks.test_masks_stage import SIZE, Scene, ball_alpha, build, iou, run

Y, X = np.mgrid[:160, :160]
BODY: Bool = np.hypot(X - 60, Y - 80) < 40
PATCH: Bool = (X > 85) & (X < 130) & (abs(Y - 80) < 15) & ~BODY
SKIN, WALL = (200, 150, 120), (90, 110, 160)
NONE: F32 = np.zeros((160, 160), np.float32)  # no photo of many contradicts


def picture(of_patch: tuple[int, int, int]) -> U8:
    """A round subject before a wall, with a patch beside it; noise of two levels."""
    image = np.where(BODY[..., None], SKIN, WALL).astype(np.float64)
    image[PATCH] = of_patch
    return np.asarray((image + np.random.default_rng(3).normal(0, 2, image.shape)).clip(0, 255), np.uint8)


# ------------------------------------------------------------------ regions and colours
def test_a_region_beyond_the_hull_with_the_walls_colours_is_background() -> None:
    found = background(picture(WALL), BODY | PATCH, ~BODY, NONE)
    assert (found & BODY).sum() == 0
    assert (found & PATCH).sum() > 0.97 * PATCH.sum()


def test_a_region_with_the_subjects_colours_stays_because_the_hull_may_lack_it() -> None:
    assert not background(picture(SKIN), BODY | PATCH, ~BODY, NONE).any()


def test_what_many_photos_contradict_is_background_whatever_it_looks_like() -> None:
    share = np.where(PATCH, np.float32(1.2 * MANY), 0)
    found = background(picture(SKIN), BODY | PATCH, ~BODY, share)
    assert found[PATCH].mean() > 0.97 and (found & BODY).sum() < 0.01 * BODY.sum()
    assert not background(picture(SKIN), BODY | PATCH, ~BODY, 0.7 * share).any()


def test_of_few_photos_three_must_contradict() -> None:
    assert many(7) == pytest.approx(2 / 7) and many(40) == MANY and many(0) >= MANY
    share = np.where(PATCH, np.float32(1 / 6), 0)  # two of seven, one forgiven
    assert not background(picture(SKIN), BODY | PATCH, ~BODY, share, many(6)).any()
    assert background(picture(SKIN), BODY | PATCH, ~BODY, 2 * share, many(6)).any()


def test_only_a_large_and_thick_region_is_surely_background() -> None:
    """A tuft of hair or a strip along the outline is often missing in many masks."""
    y, x = np.mgrid[:640, :640]
    body = np.hypot(x - 200, y - 320) < 150

    def told(width: int, height: int) -> bool:
        part = (abs(x - 500) < width / 2) & (abs(y - 320) < height / 2)
        return bool(surely(body | part, np.where(part, np.float32(0.9 * MAJORITY), 0), MANY))

    thick = 640 * THICK
    long = LARGE * body.sum() / thick
    assert told(round(1.5 * thick), round(2 * long))
    assert not told(round(0.5 * thick), round(4 * long))
    assert not told(round(1.2 * thick), round(0.6 * long))


def test_what_a_third_of_the_photos_contradict_is_background_of_any_shape() -> None:
    """Strands of a loop of hair that the other photos' masks have cut off."""
    y, x = np.mgrid[:640, :640]
    body, strand = np.hypot(x - 200, y - 320) < 150, (abs(y - 320) < 2) & (x > 360) & (x < 500)
    for share, cut_off in ((0.9 * MAJORITY, False), (1.1 * MAJORITY, True)):
        votes = np.where(strand, np.float32(share), 0)
        found = surely(body | strand, votes, MANY)
        assert bool(found) == cut_off
        assert not surely(body | strand, votes, 0.5)  # of few photos more must contradict
    assert (found[0] & strand).sum() > 0.9 * strand.sum() and not (found[0] & body).any()


@pytest.mark.parametrize("colour", [WALL, SKIN])
def test_what_the_hull_has_is_never_asked(colour: tuple[int, int, int]) -> None:
    assert not background(picture(colour), BODY | PATCH, ~(BODY | PATCH), NONE).any()


def test_between_a_region_and_the_hulls_outline_each_pixel_is_decided_alone() -> None:
    """The hull is a little too small on one side: skin there stays, although wall next to it is cut."""
    hull = BODY & (X < 94)
    found = background(picture(WALL), BODY | PATCH, ~hull, NONE)
    kept = BODY & ~hull
    assert kept.sum() > 100 and (found & kept).sum() < 0.05 * kept.sum() and found[PATCH].mean() > 0.95


def test_noise_of_an_outline_is_no_region() -> None:
    inside = BODY | (PATCH & (abs(Y - 80.5) < 1))  # a line of two pixels
    assert LEAST * inside.sum() < 4 and len(beyond(BODY | PATCH, ~BODY)) == 1
    assert not beyond(inside, ~BODY)


def test_without_samples_nothing_is_cut() -> None:
    """A mask that lies nowhere deep in the hull, and one that leaves no background."""
    thin = PATCH & (abs(Y - 80) < 3)
    assert not background(picture(WALL), thin, np.ones_like(thin), NONE).any()
    assert not background(picture(WALL), np.ones_like(thin), ~BODY, NONE).any()


@pytest.mark.parametrize("value", [0, 255])
def test_where_colours_do_not_tell_the_hull_is_believed(value: int) -> None:
    found = background(np.full((160, 160, 3), value, np.uint8), BODY | PATCH, ~BODY, NONE)
    assert found[PATCH].mean() > 0.9 and not (found & BODY).any()


def test_alpha_changes_only_where_background_was_found() -> None:
    inside, image = BODY | PATCH, picture(WALL)
    alpha = (dilated(inside, 2) * np.random.default_rng(0).uniform(0.8, 1, inside.shape)).astype(np.float32)
    found = background(image, inside, ~BODY, NONE)
    less = cut(alpha, image, inside, found)
    far = np.hypot(X - 60, Y - 80) < 34
    assert np.array_equal(less[far | (X > 140)], alpha[far | (X > 140)])
    other_side = X < 60  # at the outline, matting anew would give other values
    assert np.array_equal(less[other_side], alpha[other_side])
    assert (less <= alpha).all() and less[PATCH].mean() < 0.05
    double = cut(np.repeat(np.repeat(alpha, 2, 0), 2, 1), np.repeat(np.repeat(image, 2, 0), 2, 1), inside, found)
    assert double.shape == (320, 320) and double[::2, ::2][PATCH].mean() < 0.05  # the photo is larger than its mask


# ------------------------------------------------------------------ the stage
@pytest.mark.parametrize(("like", "share"), [("wall", 0.1), ("subject", 1.0)])
@pytest.mark.parametrize("resegment", [True, False])
def test_single_masks_lose_the_wall_but_not_what_looks_like_the_subject(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, like: str, share: float, resegment: bool
) -> None:
    """A knob on two masks of twelve, one of them held out; too small for a second segmentation, and no photo counts as
    many."""
    monkeypatch.setattr(beyond_hull, "many", lambda _: 2.0)
    scene: Scene = build(tmp_path / "capture", 12, 0.1)
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    knob = (abs(y) < 4) & (x > 0) & (x < 52)
    for i in (2, 7):
        own = ball_alpha(scene.cameras[i])
        shade = np.where((knob | (own > 0.5))[..., None], (0.75, 0.6, 0.5), 0.1)
        if like == "subject":
            scene.repaint(i, shade.astype(np.float32))

    def made(view: PhotoToMask, *_: Any) -> tuple[F32, str]:
        alpha = ball_alpha(scene.cameras[view.index])
        return np.where(knob & (view.index in (2, 7)), np.float32(1), alpha), "grabcut"

    monkeypatch.setattr(segment, "mask", made)
    monkeypatch.setattr(segment, "CONTRADICTED", 1.0)
    found, alphas = run(scene, tmp_path / "s", faces=False, resegment=resegment)
    outer = knob & (x > 46)
    for i in (2, 7):
        expected = share if resegment else 1.0
        assert alphas[i][outer].mean() == pytest.approx(expected, abs=0.1)
        assert found.masks[i].source == ("grabcut+hull" if resegment and like == "wall" else "grabcut")
    assert iou(alphas[5], ball_alpha(scene.cameras[5])) > 0.99


def test_what_all_other_masks_contradict_goes_even_if_it_looks_like_the_subject(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table of the colour of a statue, at the edge of one frame."""
    scene = build(tmp_path / "capture", 12, 0.1)
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    table = (abs(y) < 7) & (x > 0) & (x < 56)
    own = ball_alpha(scene.cameras[7])
    scene.repaint(7, np.where((table | (own > 0.5))[..., None], (0.75, 0.6, 0.5), 0.1).astype(np.float32))

    def made(view: PhotoToMask, *_: Any) -> tuple[F32, str]:
        alpha = ball_alpha(scene.cameras[view.index])
        return np.where(table & (view.index == 7), np.float32(1), alpha), "object"

    monkeypatch.setattr(segment, "mask", made)
    monkeypatch.setattr(segment, "CONTRADICTED", 1.0)
    found, alphas = run(scene, tmp_path / "s", faces=False)
    assert found.masks[7].source == "object+hull"
    assert alphas[7][table & (x > 46)].mean() < 0.1 and iou(alphas[7], own) > 0.96


def test_given_masks_are_not_cut(tmp_path: Path) -> None:
    scene = build(tmp_path / "capture", 12, 0.1)
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    for i, c in enumerate(scene.cameras):
        alpha = ball_alpha(c)
        scene.give(i, np.where((abs(y) < 4) & (x > 0) & (x < 52) & (i == 7), np.float32(1), alpha))
    found, alphas = run(scene, tmp_path / "s", faces=False)
    assert found.masks[7].source == "given" and alphas[7][SIZE // 2, SIZE // 2 + 50] == 1
