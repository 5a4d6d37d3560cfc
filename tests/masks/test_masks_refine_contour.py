"""Contours drawn anew, on pictures whose truth is known: what is missing comes back, what is right stays."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from pipeline.colour import linear_from_srgb, srgb_from_linear
from stages.masks.matting import between, soft_edge
from stages.masks.refine_contour import LOUD, REACH, continued, refined_contour
from stages.masks.segment_person import settled

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]
SIZE = 640
HAIR = (40.0, 34.0, 30.0)
SKIN, SHINE = (150.0, 110.0, 90.0), (205.0, 208.0, 214.0)
REACHES = round(REACH * SIZE)


def disc(radius: float) -> Bool:
    y, x = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    return np.asarray(np.hypot(x, y) <= radius)


def scene(background: F32, noise: float = 1.5) -> tuple[U8, Bool]:
    """A disc of skin with a bright rim on its right side, 8 pixels wide, before (SIZE, SIZE, 3) `background`."""
    truth, x = disc(180), np.mgrid[:SIZE, :SIZE][1]
    picture = np.where(truth[..., None], np.array(SKIN), background)
    picture[truth & ~disc(172) & (x > SIZE / 2)] = SHINE
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7)
    picture += np.random.default_rng(1).normal(0, noise, picture.shape)
    return np.asarray(picture.round().clip(0, 255), np.uint8), truth


def ramp(low: float = 245.0, high: float = 130.0) -> F32:
    """A wall that grows darker to the right; on the left it has the rim's own colour."""
    grey = np.linspace(low, high, SIZE)[None, :, None]
    return np.asarray(np.broadcast_to(grey, (SIZE, SIZE, 3)) * (0.95, 1.0, 1.04), np.float32)


def bitten() -> Bool:
    """The disc without its rim on the right."""
    x = np.mgrid[:SIZE, :SIZE][1]
    return disc(180) & ~((disc(180) & ~disc(172)) & (x > SIZE / 2))


def drawn(picture: U8, mask: Bool) -> Bool:
    """The contour drawn anew, and pixels that both sides share divided, as the stage does it."""
    return np.asarray(soft_edge(picture, refined_contour(picture, mask), 2) >= 0.5)


def off(mask: Bool, truth: Bool) -> float:
    """Mean distance between the contours, pixels."""
    return float((mask ^ truth).sum()) / (2 * np.pi * 180)


def test_a_rim_of_the_backgrounds_colour_comes_back() -> None:
    picture, truth = scene(ramp())
    assert off(bitten(), truth) > 3.8
    assert off(drawn(picture, bitten()), truth) < 0.5


@pytest.mark.parametrize("grow", [-3, 0, 3])
def test_a_contour_that_is_nearly_right_becomes_right(grow: int) -> None:
    picture, truth = scene(ramp(20, 60))
    start = disc(180 + grow)
    assert off(drawn(picture, start), truth) < 0.5


def test_a_background_of_all_colours_leaves_the_contour() -> None:
    """Beside tiles of random colours nothing can be told from the background, and nothing is taken from it."""
    tiles = np.random.default_rng(2).uniform(0, 255, (SIZE // 4, SIZE // 4, 3)).repeat(4, 0).repeat(4, 1)
    picture, truth = scene(tiles.astype(np.float32))
    assert off(drawn(picture, truth), truth) < 0.5


def test_crumbs_go_and_pinholes_close() -> None:
    """What the old mask has none of is no subject, and a few pixels of background within one are a mistake."""
    picture, truth = scene(ramp(20, 60))
    picture[300:310, 160:170] = (30, 30, 31)
    picture[313:318, 130:134] = SKIN
    pierced = truth.copy()
    pierced[300:310, 160:170] = False
    new = refined_contour(picture, pierced)
    assert new[300:310, 160:170].all()
    assert not new[313:318, 125:136].any()


def test_what_touches_the_subject_and_goes_on_is_background() -> None:
    """A bar behind the disc is as strange as its rim, but the photo has it further outside too."""
    wall = ramp(20, 60)
    wall[300:330] = (60.0, 140.0, 60.0)
    picture, truth = scene(wall)
    new = drawn(picture, truth)
    assert off(new, truth) < 0.5
    assert (new & ~truth)[300:330].sum() < 60


def test_a_noisy_photo_is_left_alone() -> None:
    picture, _ = scene(ramp(), noise=6 * LOUD)
    assert (refined_contour(picture, bitten()) == bitten()).all()


@pytest.mark.parametrize("mask", [np.zeros((40, 40), bool), np.ones((40, 40), bool), np.eye(40, dtype=bool)])
def test_masks_without_two_sides_stay(mask: Bool) -> None:
    picture = np.full((40, 40, 3), 128, np.uint8)
    assert (refined_contour(picture, mask) == mask).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 2)])
def test_the_smallest_pictures(shape: tuple[int, int]) -> None:
    mask = np.zeros(shape, bool)
    mask[: (shape[0] + 1) // 2, : (shape[1] + 1) // 2] = True
    assert (refined_contour(np.zeros((*shape, 3), np.uint8), mask) == mask).all(), "black on black tells nothing"


def test_a_subject_cut_by_the_frame_keeps_the_frame() -> None:
    picture, truth = scene(ramp(20, 60))
    half = slice(0, SIZE // 2)
    new = refined_contour(np.ascontiguousarray(picture[half]), truth[half])
    assert (new[-1] == truth[half][-1]).mean() > 0.99


def test_an_affine_background_goes_on_behind_the_subject() -> None:
    """Least squares held back: right where it is known, and behind the strip nearer to it than the mean is."""
    y, x = np.mgrid[:200, :200].astype(np.float32)
    colour = np.dstack([0.5 * x, 100 - 0.3 * y, 20 + 0.2 * x + 0.1 * y]).astype(np.float32)
    known = x < 100
    value, variance, there = continued(colour, known, 8.0)
    assert np.abs(value - colour)[30:170, 30:80].max() < 0.6
    behind = (slice(30, 170), slice(100, 100 + REACHES))
    assert there[behind].all()
    assert np.abs(value - colour)[behind].max() < 0.5 * 0.5 * (REACHES + 8)
    assert variance[30:170, 30:80].max() < 0.2 * (0.5 * 8) ** 2
    assert not there[:, 180:].any()


def test_two_runs_are_the_same() -> None:
    picture, _ = scene(ramp())
    assert (refined_contour(picture, bitten()) == refined_contour(picture, bitten())).all()


# ------------------------------------------------------------------ what both contours disagree about
def test_loose_hair_is_divided_by_its_share_of_the_pixel() -> None:
    """A dark disc whose cover falls from 1 to 0 over 12 pixels, before a wall."""
    y, x = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    cover = ((192 - np.hypot(x, y)) / 12).clip(0, 1)[..., None]
    light = cover * linear_from_srgb(np.array(HAIR) / 255) + (1 - cover) * linear_from_srgb(ramp(235, 225) / 255)
    picture = np.asarray((255 * srgb_from_linear(light)).round(), np.uint8)
    alpha = between(picture, disc(178), disc(196))
    band = (cover[..., 0] > 0) & (cover[..., 0] < 1)
    np.testing.assert_allclose(alpha[band], cover[..., 0][band], atol=0.06)
    assert (alpha[disc(170)] == 1).all() and (alpha[~disc(200)] == 0).all()
    assert off(settled(picture, disc(178)), cover[..., 0] >= 0.5) < 1.0


@pytest.mark.parametrize("wall", [(245.0, 130.0), (200.0, 130.0), (120.0, 60.0)])
def test_a_highlight_is_no_mixture_and_stays(wall: tuple[float, float]) -> None:
    picture, truth = scene(ramp(*wall))
    assert off(settled(picture, bitten()), truth) < 0.6


def test_without_contrast_or_colours_of_both_sides_the_wider_contour_holds() -> None:
    grey = np.full((SIZE, SIZE, 3), 128, np.uint8)
    assert ((between(grey, disc(170), disc(180)) >= 0.5) == disc(180)).all()
    everything, nothing = np.ones((SIZE, SIZE), bool), np.zeros((SIZE, SIZE), bool)
    for narrow, wide in ((everything, everything), (nothing, nothing), (nothing, disc(180)), (disc(180), everything)):
        assert (between(grey, narrow, wide) == wide).all()
