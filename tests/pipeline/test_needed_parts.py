"""Parts that some masks lack and the others need, found by votes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.hull import render_silhouette
from pipeline.needed_parts import F32, Bool, Needed, needed_parts
from tests.support.two_balls import BOTTOM, WIDTH, balls_alpha, bust_alpha, camera_at, ring_camera

COUNT, ROI = 24, 0.2
CAMERAS = [ring_camera(i, COUNT) for i in range(COUNT)]
ALPHAS = [bust_alpha(c) for c in CAMERAS]
TORSO: Bool = np.broadcast_to((np.arange(WIDTH) >= BOTTOM)[:, None], (WIDTH, WIDTH))
EVERY = [True] * COUNT


def lacking(where: Bool, *views: int) -> list[F32]:
    """The masks, of which some lack a part of the photo."""
    return [np.where(where, np.float32(0), a) if i in views else a for i, a in enumerate(ALPHAS)]


@pytest.mark.parametrize("views", [(0,), (0, 12, 13), (3, 4, 5)])
def test_what_a_few_masks_lack_and_the_others_need_is_found(views: tuple[int, ...]) -> None:
    found = needed_parts(CAMERAS, lacking(TORSO, *views), EVERY, ROI)
    assert tuple(found.parts) == views
    for i, part in found.parts.items():
        lost = (ALPHAS[i] > 0.5) & TORSO
        assert (part & lost).sum() > 0.9 * lost.sum() and (part & ~lost).sum() < 0.15 * lost.sum()


def test_a_view_without_a_vote_is_told_as_well_and_does_not_vote() -> None:
    votes = [i not in (1, 2, 3, 4, 5, 6) for i in range(COUNT)]
    assert tuple(needed_parts(CAMERAS, lacking(TORSO, 1, 2, 3, 4, 5, 6), votes, ROI).parts) == (1, 2, 3, 4, 5, 6)


def test_good_masks_and_what_a_single_mask_adds_lack_nothing() -> None:
    assert needed_parts(CAMERAS, ALPHAS, EVERY, ROI).parts == {}
    chair = np.zeros((WIDTH, WIDTH), bool)
    chair[60:140, 120:158] = True
    added = [np.where(chair, np.float32(1), a) if i == 7 else a for i, a in enumerate(ALPHAS)]
    assert needed_parts(CAMERAS, added, EVERY, ROI).parts == {}


def test_a_gap_that_few_masks_rightly_have_is_no_part() -> None:
    """Two balls side by side: front and back see between them; 20 views from the sides do not, and need nothing."""
    sides = np.radians([*np.linspace(50, 130, 10), *np.linspace(-130, -50, 10)])
    cameras = [camera_at(a, 0.1, i) for i, a in enumerate((0.0, np.pi, *sides))]
    pair = [balls_alpha(c, (((-0.1, 0.0, 0.0), 0.07), ((0.1, 0.0, 0.0), 0.07))) for c in cameras]
    found = needed_parts(cameras, pair, [True] * len(cameras), ROI)
    assert found.parts == {} and found.hull is not None
    shown = render_silhouette(found.hull, cameras[0], WIDTH, WIDTH) >= 0.5
    assert shown[80, 80] and pair[0][80, 80] == 0  # the tolerant hull fills the gap


def test_what_half_of_the_masks_lack_is_not_taken_for_the_subject() -> None:
    """Between head and torso: which half is right, no vote tells."""
    gap = np.zeros((WIDTH, WIDTH), bool)
    gap[86:94] = True  # across the neck, where the balls touch
    parts = needed_parts(CAMERAS, lacking(gap, *range(0, COUNT, 2)), EVERY, ROI).parts
    assert parts == {}  # as many lack it as have it


@pytest.mark.parametrize("votes", [[False] * COUNT, [i < 2 for i in range(COUNT)]])
def test_too_few_votes_tell_nothing(votes: list[bool]) -> None:
    assert needed_parts(CAMERAS, lacking(TORSO, 0), votes, ROI) == Needed()


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_masks_of_nothing_and_of_everything(value: float) -> None:
    assert needed_parts(CAMERAS, [np.full((WIDTH, WIDTH), value, np.float32)] * COUNT, EVERY, ROI).parts == {}
