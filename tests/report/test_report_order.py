"""The views of the page: best, median and worst come first, whatever the others are."""

from __future__ import annotations

import numpy as np
import pytest

from stages.report.build import JudgedRow, best_median_worst
from stages.report.metrics import score
from stages.report.page import ViewRow
from stages.report.pictures import scale_colours, scaled_picture


def row(index: int, off: float | None) -> JudgedRow:
    """A view whose asset is `off` brighter than the photo; None: a view without scores."""
    photo, mask = np.full((32, 32, 3), 0.3, np.float32), np.ones((32, 32), np.float32)
    render = None if off is None else np.concatenate([photo + np.float32(off), mask[..., None]], -1)
    scores = None if render is None else score(render, photo, mask)
    return JudgedRow(index, True, None, scores, ViewRow(f"View {index}", "note", []))


@pytest.mark.parametrize("count", [3, 5])
def test_best_median_and_worst_come_first(count: int) -> None:
    rows = [row(i, off) for i, off in enumerate([0.05, 0.01, None, 0.2, 0.02, 0.1])]
    found = best_median_worst(rows, count)
    assert [r.row.title for r in found[:3]] == ["Best: view 1", "Median: view 0", "Worst: view 3"]
    assert [r.index for r in found[3:]] == [2, 4][: count - 3]
    assert [r.row.title for r in rows][:2] == ["View 0", "View 1"]


@pytest.mark.parametrize("offs", [[], [0.1], [0.1, 0.2], [None, None, None]])
def test_few_views_stay_as_they_are(offs: list[float | None]) -> None:
    rows = [row(i, off) for i, off in enumerate(offs)]
    assert best_median_worst(rows, 8) == rows


def test_maps_on_a_fixed_scale_do_not_depend_on_their_own_range() -> None:
    colours = scale_colours()
    assert (np.diff(colours @ [0.2126, 0.7152, 0.0722]) > -1).all()  # lightness grows, for every kind of colour vision
    ramp = np.linspace(-0.05, 0.15, 201, dtype=np.float32)[None, :, None]
    ramp[0, 0] = np.nan
    found = scaled_picture(ramp, 0.0, 0.1)
    assert (found[0, :50] == colours[0]).all() and (found[0, 151:] == colours[255]).all()
    assert (found[0, 100] == colours[128]).all() or (found[0, 100] == colours[127]).all()
    assert (scaled_picture(ramp[:, 40:160], 0.0, 0.1)[0] == found[0, 40:160]).all()
    assert (found[-1, [0, -1]] == colours[[0, 255]]).all()  # the scale itself
