"""How many photos contradict a pixel: against a plain loop in float64, then what it must tell of a ball."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from pipeline.artifacts import Camera
from pipeline.support import Support
from pipeline.transforms import inverse_rigid, matrix, pixel_centres, project, rays
from stages.masks.hull_consistency import POSSIBLE
from stages.masks.hull_votes import (
    DOUBT,
    F64,
    FEW,
    FEWEST,
    FORGIVEN,
    KNOWN,
    OUTER,
    STEP,
    TOLERANCE,
    beyond_all,
    contradicting,
    votes_of,
)
from stages.masks.region import F32, Bool, dilated
from tests.masks.test_masks_stage import RADIUS, ROI, SIZE, ball_alpha, camera

COUNT = 12
CAMERAS = [camera(i, COUNT) for i in range(COUNT)]
BALLS = [ball_alpha(c) for c in CAMERAS]
ALL = [True] * COUNT
Y, X = np.mgrid[:SIZE, :SIZE] - SIZE / 2
KNOB: Bool = (abs(Y) < 4) & (X > 0) & (X < 52)
EVERY: Bool = np.ones((SIZE, SIZE), bool)


def with_knob(number: int) -> list[F32]:
    return [np.where(KNOB & (i == number), np.float32(1), a) for i, a in enumerate(BALLS)]


def plainly(cameras: list[Camera], gaps: list[F64], number: int, pixel: tuple[int, int], many: bool) -> float:
    """The share of one pixel (row, column), place by place and view by view. gaps: exact distances to each mask."""
    c = cameras[number]
    origin, d = rays(matrix(c.K), matrix(c.world_from_cam), np.array(c.distortion),
                     np.array([[pixel[1] + 0.5, pixel[0] + 0.5]]))  # fmt: skip
    middle, voters = -float(d[0] @ origin), range(len(cameras))
    away = float(origin @ origin) - middle**2
    least, far = 1.0, (OUTER if many else POSSIBLE) * ROI
    steps = int(np.sqrt(far**2 - away) / (STEP * ROI))
    for k in range(-steps, steps + 1):
        x = origin + (middle + k * STEP * ROI) * d[0]
        seen = against = 0
        for i in voters:
            if i == number:
                continue
            v = cameras[i]
            uv, depth = project(matrix(v.K), inverse_rigid(matrix(v.world_from_cam)), np.array(v.distortion), x[None])
            column, row = np.floor(uv[0])
            if depth[0] <= 0 or not (0 <= column < SIZE and 0 <= row < SIZE):
                continue
            seen += 1
            against += gaps[i][int(row), int(column)] > max(1.0, TOLERANCE * SIZE)
        near = abs(k * STEP * ROI) <= np.sqrt((POSSIBLE * ROI) ** 2 - away)
        fewest = (max(FEWEST, np.ceil(KNOWN * len(voters))) if near else FEW) if many else 1
        if seen >= fewest:
            least = min(least, max(against - FORGIVEN, 0) / seen)
        elif near:
            return 0.0
    return least


@pytest.mark.parametrize("lens", [(0.0,) * 5, (0.15, -0.1, 0.01, -0.02, 0.03)])
def test_shares_are_those_of_a_plain_loop(lens: tuple[float, ...]) -> None:
    cameras = [c.model_copy(update={"distortion": lens}) for c in CAMERAS]
    alphas = [np.where(Y > 20, np.float32(0), a) if i in (0, 4, 9) else a for i, a in enumerate(with_knob(7))]
    votes = votes_of(cameras, alphas, ALL)
    share = contradicting(votes, 7, cameras[7], EVERY, ROI)
    outer = beyond_all(votes, 7, cameras[7], EVERY, ROI)
    gaps = [np.asarray(ndimage.distance_transform_edt(a < 0.5)) for a in alphas]
    rng = np.random.default_rng(1)
    for row, column in rng.integers(SIZE // 2 - 48, SIZE // 2 + 48, (12, 2)):
        expected = plainly(cameras, gaps, 7, (row, column), many=True)
        if expected > DOUBT:
            assert share[row, column] == pytest.approx(expected, abs=1e-6)
        else:
            assert share[row, column] <= DOUBT
        assert outer[row, column] == (plainly(cameras, gaps, 7, (row, column), many=False) > 0)


# ------------------------------------------------------------------ what it must tell
@pytest.mark.parametrize("number", range(0, COUNT, 3))
def test_no_photo_contradicts_a_true_mask(number: int) -> None:
    inside = BALLS[number] >= 0.5
    votes = votes_of(CAMERAS, BALLS, ALL)
    assert not beyond_all(votes, number, CAMERAS[number], inside, ROI).any()
    assert contradicting(votes, number, CAMERAS[number], inside, ROI).max() <= DOUBT


def test_a_knob_of_one_mask_is_beyond_the_hull_to_a_few_pixels() -> None:
    """The hull of eleven views is some pixels larger than the ball."""
    alphas = with_knob(7)
    votes, inside = votes_of(CAMERAS, alphas, ALL), alphas[7] >= 0.5
    outer = beyond_all(votes, 7, CAMERAS[7], inside, ROI)
    own = BALLS[7] >= 0.5
    assert not (outer & own).any() and outer[inside & ~dilated(own, 7)].all()
    share = contradicting(votes, 7, CAMERAS[7], outer, ROI)
    assert share[KNOB & (X > 46)].min() > 0.25 and share[own].max() == 0
    assert (share[~outer] == 0).all()


def test_its_own_mask_has_no_vote_and_one_wrong_mask_is_forgiven() -> None:
    inside = BALLS[7] >= 0.5

    def lost(small: tuple[int, ...], voting: list[bool] = ALL) -> float:
        alphas = [ball_alpha(c, 0.5 * RADIUS) if i in small else a
                  for i, (c, a) in enumerate(zip(CAMERAS, BALLS, strict=True))]  # fmt: skip
        votes = votes_of(CAMERAS, alphas, voting)
        return float(beyond_all(votes, 7, CAMERAS[7], inside, ROI)[inside].mean())

    assert lost((7,)) == 0 and lost((3,)) == 0
    assert lost((3, 7)) == 0  # one that is wrong besides its own
    assert lost((3, 8)) > 0.1
    assert lost((3, 8), [i != 3 for i in range(COUNT)]) == 0  # held out, or empty


def test_what_few_frames_show_is_not_known() -> None:
    """Of twelve photos three show more than the upper half: the rest is not told, whatever these three say."""
    halves = [c if i < 3 else c.model_copy(update={"K": ((380, 0, SIZE / 2), (0, 380, SIZE * 1.2), (0, 0, 1))})
              for i, c in enumerate(CAMERAS)]  # fmt: skip
    alphas = [np.zeros((SIZE, SIZE), np.float32) for _ in halves]
    whole = contradicting(votes_of(CAMERAS, alphas, ALL), 0, CAMERAS[0], EVERY, ROI)
    part = contradicting(votes_of(halves, alphas, ALL), 0, halves[0], EVERY, ROI)
    assert (whole[SIZE // 2] > 0.5).all()
    assert (part == 0).mean() > (whole == 0).mean() + 0.2


def test_what_lies_beneath_the_support_is_not_the_subjects() -> None:
    votes, inside = votes_of(CAMERAS, BALLS, ALL), BALLS[5] >= 0.5
    table = Support(np.array([0.0, 1.0, 0.0]), 0.0)
    outer = beyond_all(votes, 5, CAMERAS[5], inside, ROI, table)
    assert 0.05 < outer[inside].mean() < 0.6
    assert not beyond_all(votes, 5, CAMERAS[5], inside, ROI, Support(np.array([0.0, 1.0, 0.0]), -1.0)).any()


# ------------------------------------------------------------------ extremes
def test_without_enough_votes_nothing_is_told() -> None:
    nobody = votes_of(CAMERAS, BALLS, [False] * COUNT)
    assert not beyond_all(nobody, 0, CAMERAS[0], EVERY, ROI).any()
    few = votes_of(CAMERAS, [0 * a for a in BALLS], [i < 4 for i in range(COUNT)])
    assert not contradicting(few, 8, CAMERAS[8], EVERY, ROI).any()
    assert not contradicting(few, 8, CAMERAS[8], ~EVERY, ROI).any()


def test_where_all_masks_are_empty_all_photos_contradict() -> None:
    votes = votes_of(CAMERAS, [0 * a for a in BALLS], ALL)
    share = contradicting(votes, 0, CAMERAS[0], EVERY, ROI)
    # a place far out that only so many photos see
    assert share[SIZE // 2, SIZE // 2] == pytest.approx((FEW - FORGIVEN) / FEW, abs=1e-6)


@pytest.mark.parametrize("size", [64, 512])
def test_masks_may_have_another_size_than_their_photos(size: int) -> None:
    alphas = [np.asarray(cv2.resize(a, (size, size), interpolation=cv2.INTER_AREA), np.float32) for a in with_knob(7)]
    outer = beyond_all(votes_of(CAMERAS, alphas, ALL), 7, CAMERAS[7], alphas[7] >= 0.5, ROI)
    row, column = size // 2, int((0.5 + 50 / SIZE) * size)
    assert outer[row, column] and not outer[row, size // 2]


def test_directions_of_a_photo_are_those_of_its_pixels() -> None:
    """A ray through each pixel's centre; a mask of half the size has every second one between them."""
    c = CAMERAS[3]
    assert pixel_centres(SIZE, SIZE)[0] == pytest.approx([0.5, 0.5])
    votes = votes_of(CAMERAS, BALLS, ALL)
    share = contradicting(votes, 3, c, EVERY, ROI)
    half = contradicting(votes, 3, c, EVERY[::2, ::2], ROI)
    assert half.shape == (SIZE // 2, SIZE // 2)
    assert abs(half - share.reshape(SIZE // 2, 2, SIZE // 2, 2).mean((1, 3))).mean() < 0.02
