"""The hull's opinion of a mask: what it contradicts, what it lacks, and the trimap of a second segmentation."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.masks.hull_consistency import Opinion, contradiction, hole, lacking, opinions, outliers, tolerated, trimap
from tests.masks.test_masks_stage import RADIUS, ROI, SIZE, ball_alpha, camera
from tests.support.two_balls import cropped_bust


# ------------------------------------------------------------------ agreement
def test_opinions_measure_iou_where_truth_is_known() -> None:
    cameras = [camera(i, 12) for i in range(12)]
    alphas = [ball_alpha(c) for c in cameras]
    alphas[3] = ball_alpha(cameras[3], 0.5 * RADIUS)
    found = opinions(cameras, alphas, [True] * 12, ROI, 48)
    assert found[3].iou == pytest.approx(0.25, abs=0.05)
    assert min(o.iou for i, o in enumerate(found) if i != 3 and o.iou is not None) > 0.93


def test_outlier_rule() -> None:
    good = [0.97, 0.96, 0.98, 0.97, 0.965]
    assert outliers([*good, 0.85], 0.8, 0.05) == [False] * 5 + [True]
    assert outliers([*good, 0.93], 0.8, 0.05) == [False] * 6
    assert outliers([*good, None], 0.8, 0.05) == [False] * 6
    assert outliers([0.5, 0.4, 0.6], 0.8, 0.05) == [False] * 3  # all alike bad: nobody is the odd one out
    assert outliers([], 0.8, 0.05) == []
    assert [tolerated(n) for n in (3, 4, 5, 40, 79, 80)] == [0, 0, 1, 1, 1, 2]


def test_contradiction_and_trimap() -> None:
    y, x = np.mgrid[:100, :100]
    body = np.hypot(x - 50, y - 50) < 30
    opinion = Opinion(body, body, np.ones_like(body), 3, 1.0, np.zeros_like(body))
    assert contradiction(body, opinion, filled=True) == 0
    half = body & (x < 50)
    assert contradiction(half, opinion, filled=True) == pytest.approx(0.9, abs=0.15)
    for filled in (True, False):
        assert contradiction(np.ones_like(body), opinion, filled=filled) > 0.6
    found = trimap(half, opinion, filled=True)
    assert found[50, 70] == cv2.GC_FGD and found[5, 5] == cv2.GC_BGD
    elsewhere = replace(opinion, here=x < 0)
    there = trimap(half, elsewhere, filled=True)[:, 60:]
    assert (there[body[:, 60:]] == cv2.GC_BGD).all()  # outside the region: its own word


def test_a_hull_is_an_upper_limit_of_a_mask_that_is_no_outlier() -> None:
    """What the hull adds is no part of the subject by that alone; what it lacks is none, and a hole is one."""
    y, x = np.mgrid[:100, :100]
    disc = np.hypot(x - 50, y - 50)
    opinion = Opinion(disc < 30, disc < 30, np.ones_like(disc, bool), 3, 1.0, np.zeros_like(disc, bool))
    small = (disc < 20) & ~(np.hypot(x - 52, y - 52) < 5)
    assert contradiction(small, opinion, filled=False) == 0 < contradiction(small, opinion, filled=True)
    found = trimap(small, opinion, filled=False)
    beyond = found[(disc > 24) & (disc < 32)]  # the hull goes on there, the mask does not
    assert np.isin(beyond, (cv2.GC_BGD, cv2.GC_PR_BGD)).all() and found[52, 52] == cv2.GC_FGD
    large = disc < 45
    found = trimap(large, opinion, filled=False)
    assert (found[disc > 34] == cv2.GC_BGD).all() and (found[disc < 24] == cv2.GC_FGD).all()


def test_what_a_mask_lacks_of_the_core_is_the_subject() -> None:
    """A ray through the core meets the subject; one through the rim need not."""
    y, x = np.mgrid[:100, :100]
    disc = np.hypot(x - 50, y - 50)
    body, core = disc < 30, disc < 20
    opinion = Opinion(body, body, np.ones_like(body), 3, 1.0, core)
    notched = body & ~((x > 55) & (abs(y - 50) < 8))
    assert lacking(notched, opinion) == contradiction(notched, opinion, filled=False) > 0.05
    found = trimap(notched, opinion, filled=False)
    assert found[50, 60] == cv2.GC_FGD and found[50, 76] == cv2.GC_PR_BGD and found[50, 95] == cv2.GC_BGD
    rim = body & ~((x > 72) & (abs(y - 50) < 12))
    assert lacking(rim, opinion) == lacking(body, opinion) == 0
    assert lacking(notched, replace(opinion, here=x < 40)) == 0  # outside of the region of interest


def test_the_core_is_that_of_views_all_around() -> None:
    """Two of 24 masks lack the same part, and the core keeps it. Cameras on one side tell no core."""
    cameras, x = [camera(i, 24) for i in range(24)], np.mgrid[:SIZE, :SIZE][1] - SIZE / 2
    alphas = [ball_alpha(c) for c in cameras]
    cut = [np.where(x > 4, np.float32(0), a) if i in (3, 4) else a for i, a in enumerate(alphas)]
    found = opinions(cameras, cut, [True] * 24, ROI, 64)
    lacks = [lacking(a >= 0.5, o) for a, o in zip(cut, found, strict=True)]
    whole = opinions(cameras, alphas, [True] * 24, ROI, 64)
    assert lacks[3:5] == pytest.approx([lacking(cut[i] >= 0.5, whole[i]) for i in (3, 4)], abs=0.01)
    assert min(lacks[3:5]) > 0.1 and sum(lacks) == lacks[3] + lacks[4]
    arc = [camera(i, 72) for i in range(9)]
    one_side = opinions(arc, [ball_alpha(c) for c in arc], [True] * 9, ROI, 64)
    assert not any(o.core.any() for o in one_side)


def test_the_core_of_a_hull_is_empty_where_few_frames_show_it() -> None:
    """A torso that leaves half of the frames: the hull is deep, the view from the side is right."""
    cameras, alphas = cropped_bust()
    found = opinions(cameras, alphas, [True] * len(cameras), 0.18, 64)
    assert lacking(alphas[-1] >= 0.5, found[-1]) == 0
    assert found[0].core.any()  # that of the head


def test_a_hole_counts_where_the_hull_has_none() -> None:
    y, x = np.mgrid[:100, :100]
    body = np.hypot(x - 50, y - 50) < 30
    opinion = Opinion(body, body, np.ones_like(body), 3, 1.0, np.zeros_like(body))
    spot = np.hypot(x - 60, y - 50) < 4
    assert hole(body & ~spot, opinion) == pytest.approx(spot.sum() / (body & ~spot).sum())
    assert hole(body & ~spot & ~((y == 50) & (x > 50)), opinion) == 0  # a cut that leads in from outside is none
    ring = replace(opinion, silhouette=body & ~(np.hypot(x - 60, y - 50) < 9))  # the others look through there as well
    assert hole(body & ~spot, ring) == 0 and hole(body, opinion) == 0
    assert hole(np.zeros_like(body), opinion) == 0
