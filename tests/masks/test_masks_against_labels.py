"""The comparison of a run's masks with labelled pictures."""

from __future__ import annotations

import numpy as np

from benchmarks.masks_against_labels import FAR, agreement


def test_whole_parts_count_and_the_edge_does_not() -> None:
    truth = np.zeros((100, 100), bool)
    truth[20:80, 20:80] = True
    assert agreement(truth, truth) == (1, 0, 0)
    wider = np.zeros_like(truth)
    wider[18:82, 18:82] = True
    iou, added, lacking = agreement(wider, truth)
    assert iou == 60**2 / 64**2 and added == lacking == 0
    part = truth.copy()
    part[20:80, 60:80] = False
    deep = int(FAR)
    np.testing.assert_allclose(agreement(part, truth), (2 / 3, 0, (60 - 2 * deep) * (20 - deep) / 3600), rtol=1e-6)
    np.testing.assert_allclose(agreement(truth, part)[1], (20 - deep) * 60 / 2400, rtol=1e-6)


def test_empty_masks() -> None:
    nothing, all_ = np.zeros((9, 9), bool), np.ones((9, 9), bool)
    assert agreement(nothing, nothing) == (0, 0, 0)
    assert agreement(nothing, all_)[0] == 0 and agreement(all_, nothing)[0] == 0
