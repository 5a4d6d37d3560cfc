"""The weights in a fit: something covers a part of one photo of a ball."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from pipeline import transforms
from pipeline.maths.losses import RGB_SCALE
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.objective import terms
from stages.inverse_rendering.outputs import fitted_photos
from stages.inverse_rendering.photo_weights import CELLS, LOW, all_alike
from stages.inverse_rendering.ray_sampling import PhotoView, PixelTable, normalised_positions
from stages.inverse_rendering.residuals import ViewError
from stages.inverse_rendering.robust import Robust, _cell_from_plane, cells_of
from stages.inverse_rendering.training_loop import run_fit
from tests.support.small_ball import SIDE, SMALL, ball_start, ball_view, hooks

ROBUST = SMALL.changed(weigh_photos=True, specular="off", calibration="off", refine_geometry="on", light_order=2)
COVERED, TOP, LEFT, SIZE = 4, 26, 26, 10  # photo, and a square of its pixels on the ball


def photos(covered: bool) -> list[PhotoView]:
    """Twelve photos of the ball; a bright square in one of them."""
    found = [ball_view(i) for i in range(12)]
    if covered:
        rgb = found[COVERED].rgb.copy()
        rgb[TOP : TOP + SIZE, LEFT : LEFT + SIZE] = [0.9, 0.8, 0.1]
        found[COVERED] = replace(found[COVERED], rgb=rgb)
    return found


@cache
def fitted(covered: bool, robust: bool = True) -> Trainer:
    t = new_trainer(photos(covered), ball_start(), ROBUST.changed(weigh_photos=robust), False, "cpu")
    run_fit(t, hooks())
    return t


def block() -> tuple[slice, slice]:
    """The cells of the square, without its border."""
    first, last = (TOP + 1) * CELLS // SIDE, (TOP + SIZE - 1) * CELLS // SIDE
    return slice(first, last), slice(first, last)


@pytest.mark.slow
def test_what_covers_a_part_of_one_photo_counts_less() -> None:
    found = fitted(covered=True).robust.weights
    assert found is not None
    rows, columns = block()
    assert (found.table[COVERED, rows, columns] < LOW).mean() > 0.9
    others = np.delete(found.table, COVERED, 0)[np.delete(found.rays, COVERED, 0) > 0]
    assert (others < LOW).mean() < 0.04
    mean, low = zip(*fitted(covered=True).photo_weights(), strict=True)
    assert int(np.argmin(mean)) == COVERED == int(np.argmax(low)) and low[COVERED] > 0.1
    facts = fitted(covered=True).photo_facts()
    assert facts["weighed"] is True and facts["lowest_weight"] == min(mean)


@pytest.mark.slow
def test_photos_without_fault_count_as_before() -> None:
    found = fitted(covered=False).robust.weights
    assert found is not None
    assert (found.table[found.rays > 0] < LOW).mean() < 0.04  # cells at the edge between red and blue
    assert min(w for w, _ in fitted(covered=False).photo_weights()) > 0.9


@pytest.mark.slow
def test_what_is_behind_it_is_fitted_better() -> None:
    """The covered part's true colours, which other photos show too."""
    rgb = {}
    for robust in (False, True):
        t = fitted(covered=True, robust=robust)
        table = PixelTable(photos(covered=False), SIDE, "cpu")
        inside = table.inside[table.view[table.inside] == COVERED]
        batch = table.at(inside)
        cell = cells_of(batch.xy, batch.view, _cell_from_plane(t.views)).numpy()
        rows, columns = block()
        in_rows = (cell // CELLS >= rows.start) & (cell // CELLS < rows.stop)
        there = torch.from_numpy(in_rows & (cell % CELLS >= columns.start) & (cell % CELLS < columns.stop))
        found = terms(t.model, batch, t.settings, torch.Generator().manual_seed(0), 1.0).seen
        assert found is not None
        rgb[robust] = float(found.residual[there[found.rays]].mean())
    assert rgb[True] < 0.8 * rgb[False]


def test_off_keeps_nothing_and_weighs_nothing() -> None:
    t = new_trainer(photos(covered=True)[:6], ball_start(), ROBUST.changed(weigh_photos=False, steps=10), False, "cpu")
    while t.step < 10:
        t.advance()
    assert t.robust.weights is None and not t.robust.steps and t.photo_weights() == []
    assert t.photo_facts() == {"weighed": False, "why": "setting"}


def test_a_fit_too_short_to_weigh_says_so() -> None:
    t = new_trainer(photos(covered=True)[:6], ball_start(), ROBUST.changed(steps=1), False, "cpu")
    t.advance()
    assert t.photo_facts() == {"weighed": False, "why": "the fit was too short"}


# ------------------------------------------------------------------ the weights in the loss
def test_weights_multiply_the_colour_term_alone() -> None:
    t = new_trainer(photos(covered=False)[:4], ball_start(), SMALL, False, "cpu")
    batch = t.pixels.draw(256, 0.25, 1)

    def parts(weights: torch.Tensor | None) -> dict[str, float]:
        found = terms(t.model, batch, SMALL, torch.Generator().manual_seed(0), 1.0, weights)
        return {k: float(v.detach()) for k, v in found.scalars.items()}

    plain, ones, halves = parts(None), parts(torch.ones(256)), parts(torch.full((256,), 0.5))
    assert plain == ones
    assert halves.pop("rgb") == pytest.approx(0.5 * plain.pop("rgb")) and halves == plain
    one = torch.zeros(256)
    found = terms(t.model, batch, SMALL, torch.Generator().manual_seed(0), 1.0)
    cost, rays = found.values["rgb"]
    one[rays[7]] = 2.0
    assert parts(one)["rgb"] == pytest.approx(2 * float(cost[7]) / 256, rel=1e-5)


def test_what_is_weighed_is_the_absolute_residual() -> None:
    """Not the cost of the colour loss, which is smaller for small residuals."""
    t = new_trainer(photos(covered=False)[:4], ball_start(), SMALL, False, "cpu")
    found = terms(t.model, t.pixels.draw(256, 0.25, 1), SMALL, torch.Generator().manual_seed(0), 1.0)
    assert found.seen is not None
    cost, _ = found.values["rgb"]
    off = found.seen.residual
    assert ((off - RGB_SCALE / 2 <= cost + 1e-6) & (cost <= off)).all() and (off > 1.01 * cost).any()


def test_each_ray_has_the_weight_of_its_cell() -> None:
    t = new_trainer(photos(covered=False)[:4], ball_start(), ROBUST, False, "cpu")
    weights = all_alike(4)
    weights.cell[2, 16, 15] = 0.25
    weights.view[3] = 0.5
    t.robust.weights = weights
    batch = t.pixels.draw(4096, 0.25, 1)
    given = t.robust.of(batch)
    assert given is not None
    pixel = batch.xy.double().numpy() @ t.views[0].K[:2, :2].T + t.views[0].K[:2, 2]
    cell = np.floor(pixel / SIDE * CELLS)
    want = np.where(batch.view == 3, 0.5, 1.0)
    want[(batch.view.numpy() == 2) & (cell[:, 1] == 16) & (cell[:, 0] == 15)] = 0.25
    np.testing.assert_allclose(given.numpy(), want)
    assert (want == 0.25).any()


def test_cells_of_a_wide_photo() -> None:
    """The first and last pixels of its rows and columns: a wide photo uses the upper rows of the grid only."""
    K = np.array([[50.0, 0, 32], [0, 50.0, 16], [0, 0, 1]])
    view = PhotoView(0, np.zeros((32, 64, 3), np.float32), np.zeros((32, 64), np.float32), K, np.eye(4), np.zeros(5))
    xy = torch.from_numpy(normalised_positions(view, 1).reshape(-1, 2))
    cell = cells_of(xy, torch.zeros(len(xy), dtype=torch.int64), _cell_from_plane([view])).reshape(32, 64).numpy()
    assert cell[0, 0] == 0 and cell[0, 63] == CELLS - 1 and cell[31, 63] == 16 * CELLS - 1
    rows, columns = np.divmod(cell, CELLS)
    assert (rows == np.arange(32)[:, None] // 2).all() and (columns == np.arange(64) // 2).all()


def test_labels_are_counted_in_their_cells() -> None:
    views = photos(covered=False)[:3]
    codes = np.zeros((SIDE // 2, SIDE // 2), np.uint8)
    codes[:8, :] = 2  # 16 of 64 rows: the upper 8 of 32 rows of cells
    state = Robust(views, used=True, side=SIDE)
    state.know_labels([None, codes, codes.T.copy()], ["none", "face", "hair", "eyes"])
    assert not state.moves[0].any()
    np.testing.assert_allclose(state.moves[1], np.repeat([1.0, 0.0], [8, 24])[:, None] * np.ones(CELLS))
    np.testing.assert_allclose(state.moves[2], state.moves[1].T)


# ------------------------------------------------------------------ checkpoints and the report
def test_a_checkpoint_has_the_whole_state() -> None:
    t = new_trainer(photos(covered=True)[:5], ball_start(), ROBUST.changed(steps=12), False, "cpu")
    while t.step < 8:
        t.advance()
    other = Robust(t.views, used=True, side=SIDE)
    other.restore(t.robust.stored(), "cpu")
    assert other.due == t.robust.due > 0 and len(other.steps) == len(t.robust.steps) > 1
    for a, b in zip(other.steps, t.robust.steps, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
    assert other.weights is not None and t.robust.weights is not None
    np.testing.assert_array_equal(other.weights.table, t.robust.weights.table)


def test_an_empty_state_is_stored_too() -> None:
    state = Robust(photos(covered=False)[:2], used=True, side=SIDE)
    other = Robust(state.views, used=True, side=SIDE)
    other.restore(state.stored(), "cpu")
    assert other.steps == [] and other.weights is None


def test_photos_of_the_report() -> None:
    errors = [ViewError(i, 100, 0.01, 0.1, 0.0, 0.0, 0.01, 10.0 ** -(i + 1)) for i in (3, 7)]
    first, second = fitted_photos(errors, [3, 5, 7], [(0.9, 0.1), (0.8, 0.2), (0.3, 0.9)])
    assert (first.index, first.psnr, first.weight, first.low_share) == (3, 40.0, 0.9, 0.1)
    assert (second.index, second.weight, second.low_share) == (7, 0.3, 0.9)
    assert [(p.weight, p.low_share) for p in fitted_photos(errors, [3, 7], [])] == [(1.0, 0.0)] * 2


def test_the_ball_of_these_tests_is_where_the_square_is() -> None:
    """The square lies on the ball, as seen from its camera."""
    view = ball_view(COVERED)
    assert view.alpha[TOP : TOP + SIZE, LEFT : LEFT + SIZE].min() == 1
    middle = transforms.pixel_centres(SIDE, SIDE).reshape(SIDE, SIDE, 2)[TOP + SIZE // 2, LEFT + SIZE // 2]
    assert np.hypot(*(middle - SIDE / 2)) < 3
