"""What a scene requires: balls that need a part of the model, and balls that do not, each next to the other.

The surface is the true one and the material the fit's first guess, so that nothing is trained: the evidence alone is
under test. tests/inverse_rendering/test_fit.py has it inside a fit.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.maths import sh
from pipeline.transforms import F64
from stages.inverse_rendering import cross_validation
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.footprint import footprint, supported
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.model_selection import Choices, restored, select_model, validation_views
from stages.inverse_rendering.observations import observe, pictures, skin_inside, surface_points
from stages.inverse_rendering.paper.config import PaperConfig
from tests.support.balls import FOCAL, RADIUS, Ball, gloss, start, texture

SMALL = Config(
    image_side=96,
    steps=200,
    batch=512,
    samples=8,
    levels=1,
    hash_levels=6,
    hash_log2_size=12,
    hash_fine=0.004,
    width=16,
)


def trainer(ball: Ball, radius: float = RADIUS, **settings: Any) -> Trainer:
    """A fit whose surface is right and whose prior had another radius."""
    t = new_trainer(ball.photos(), start(), SMALL.changed(**settings), False, "cpu")
    t.prior = start(radius)
    t.enter_level()
    return t


def chosen(ball: Ball, radius: float = RADIUS, **settings: Any) -> Choices:
    return select_model(trainer(ball, radius, **settings))[0]


@pytest.fixture(scope="module")
def dull() -> Choices:
    return chosen(Ball())


@pytest.fixture(scope="module")
def glossy() -> Choices:
    return chosen(Ball(gloss(5)))


# ------------------------------------------------------------------ decisions
def test_a_lambertian_ball_needs_no_lobe(dull: Choices) -> None:
    assert not dull.specular and dull.light_order == 3
    fact = dull.facts["specular"]
    assert fact["why"] == "cross-validation" and float(fact["error_without"]) - float(fact["error_with"]) < 1e-3


def test_a_glossy_ball_needs_one(glossy: Choices) -> None:
    assert glossy.specular
    assert float(glossy.facts["specular"]["error_without"]) > 3 * float(glossy.facts["specular"]["error_with"])


@pytest.mark.slow
def test_a_lobe_that_is_small_beside_what_stays_unexplained_is_none() -> None:
    """The same lobe with and without noise, which its own errors are far below."""
    faint, noise = gloss(4, 0.03), np.random.default_rng(0)

    def grainy(n: F64, wo: F64) -> F64:
        return faint(n, wo) + noise.normal(0, 0.2, len(n))

    assert chosen(Ball(faint)).specular
    got = chosen(Ball(grainy))
    lobe = [float(got.facts["specular"][k]) for k in ("error_without", "error_with")]
    assert not got.specular and cross_validation.more(*lobe) > 2 * cross_validation.NEGLIGIBLE


@pytest.mark.slow
@pytest.mark.parametrize("band", [1, 4, 7])
def test_the_light_has_the_order_that_the_lobe_shows(band: int) -> None:
    """A light of bands 0 and l needs order l, and never less than diffuse shading does."""
    assert chosen(Ball(gloss(band))).light_order == max(band, 3)


def test_cameras_of_one_colour_need_no_matrices(dull: Choices, glossy: Choices) -> None:
    """Nor do they where highlights make some photos brighter than others."""
    assert not dull.calibrated and not glossy.calibrated


@pytest.mark.slow
def test_cameras_of_several_colours_do() -> None:
    def gain(view: int) -> F64:
        return np.array([[1.08, 1.0, 0.95], [0.95, 1.02, 1.05], [1.0, 0.93, 1.0]][view % 3])

    got = chosen(Ball(gain=gain))
    assert got.calibrated and not got.specular
    both = chosen(Ball(gloss(4), gain))
    assert both.calibrated and both.specular and both.light_order == 4


def veil(view: int) -> float:
    """Sunlight in the lens of some photos: more than any gain here."""
    return 0.06 * math.sin(1 + 2.4 * view)


@pytest.mark.slow
def test_exposures_are_seen_behind_added_light() -> None:
    """Photos taken automatically, against a light that shines into the lens now and then: offsets do better than gains,
    but no lobe makes whole photos brighter like that."""

    def gain(view: int) -> F64:
        return np.full(3, 1 + 0.15 * math.sin(7.1 * view))

    fact = chosen(Ball(gain=gain, veil=veil)).facts["calibration"]
    assert fact["modelled"] and float(fact["error_with_offsets"]) < float(fact["error_with"])


def test_gains_are_found() -> None:
    def gain(view: int) -> F64:
        return np.full(3, 1.1 if view % 2 else 0.9)

    t = trial_of(trainer(Ball(gain=gain)))
    found = cross_validation.solve_response(t, None, gain=True).gain
    assert np.allclose(found[1::2] / found[::2], 1.1 / 0.9, rtol=0.02)


def test_the_same_surface_is_no_relief_whatever_its_lobe_does(glossy: Choices) -> None:
    """Both surfaces are looked up at the same places: what the lobe does to a point's mean is in both errors."""
    fact = glossy.facts["relief"]
    assert fact["error_without"] == fact["error_with"] and not glossy.refine_geometry


@pytest.mark.slow
def test_relief_is_there_where_the_prior_is_wrong(dull: Choices) -> None:
    assert not dull.refine_geometry
    assert chosen(Ball(), radius=RADIUS + 0.006).refine_geometry


@pytest.mark.slow
def test_one_lobe_needs_one_basis_and_two_need_more() -> None:
    """One angular profile all over the ball, or two, each on its own side."""
    even = gloss(4, 0.25)

    def two(n: F64, wo: F64) -> F64:
        tilt = (1 - (n * wo).sum(1)) / 0.65 - 0.5
        return even(n, wo) * (1 + np.where(n[:, 0] > 0.2, 1, -1) * tilt)

    assert chosen(Ball(even)).rank == 1
    assert chosen(Ball(two)).rank >= 2  # a third is taken for the seam, where boxes hold both


@pytest.mark.slow
def test_bases_stay_where_noise_hides_what_they_do() -> None:
    """One angular profile, under noise as large as the lobe's own differences: nothing tells that one is enough."""
    even, noise = gloss(4, 0.25), np.random.default_rng(0)

    def grainy(n: F64, wo: F64) -> F64:
        return even(n, wo) + noise.normal(0, 0.9, len(n))

    got = chosen(Ball(grainy))
    assert got.specular and got.rank == 3 and "too large" in str(got.facts["rank"]["why"])


# ------------------------------------------------------------------ settings
@pytest.mark.slow
def test_settings_are_never_overruled() -> None:
    got = chosen(
        Ball(), specular="on", rank=2, light_order=8, calibration="on", refine_geometry="on"
    )  # the Lambertian ball needs none of these
    assert (got.specular, got.rank, got.light_order, got.refine_geometry) == (True, 2, 8, True)
    assert all(f["why"] == "setting" for f in got.facts.values())
    assert not chosen(Ball(gloss(5)), specular="off").specular


def test_too_few_views_are_told() -> None:
    got = chosen(Ball(views=6))
    assert got.specular and got.rank == 3 and "fewer than 8 views" in str(got.facts["specular"]["why"])


def test_waiting_views_are_few_and_spread() -> None:
    for count in (8, 11, 43, 200):
        out = validation_views(count, Config())
        assert len(set(out)) == len(out) and 2 <= len(out) <= 6 and max(out) < count
    assert validation_views(43, PaperConfig()) == ()
    t = trainer(Ball())
    assert t.table is not None
    assert not np.isin(t.table.draw(2000, 0.25, 0).view.numpy(), t.validation).any()
    t.table.exclude(())
    assert np.isin(t.table.draw(2000, 0.25, 0).view.numpy(), t.validation).any()


@pytest.mark.parametrize(("given", "kept"), [("true", "on"), (False, "off"), ("auto", "auto")])
def test_the_lobe_s_setting_takes_old_values(given: Any, kept: str) -> None:
    assert Config(specular=given).specular == kept


# ------------------------------------------------------------------ the model that goes on
def test_what_stays_of_the_model_stays_as_it_was() -> None:
    """The pruned model is the whole one with the columns and bands left out set to zero; momentum stays with its
    parameter; a checkpoint brings it all back."""
    t = trainer(Ball())
    for _ in range(3):
        t.advance()
    n = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    x = RADIUS * n
    a, rho, c, s = (v.detach().clone() for v in t.model.spatial(x))
    b = t.model.basis(n, n).detach().clone()
    light, moment = t.model.light().detach().clone(), t.optimiser.state[t.model.light.coefficients]["exp_avg"].clone()
    choices = Choices(True, 4, (0, 2), False, True, {})
    t.take(restored(choices.plain()))
    after = t.model.spatial(x)
    for found, expected in zip(after, (a, rho, c[:, [0, 2]], s), strict=True):
        assert torch.allclose(found, expected, atol=1e-7)
    assert torch.allclose(t.model.basis(n, n), b[:, [0, 2]], atol=1e-7)
    assert torch.equal(t.model.light(), light[: sh.count(4)])
    assert torch.equal(t.optimiser.state[t.model.light.coefficients]["exp_avg"], moment[: sh.count(4)])
    t.advance()
    assert t.model.spec.rank == 2 and t.model.spec.light_order == 4


@pytest.mark.slow
def test_a_checkpoint_of_a_chosen_model(tmp_path: Any) -> None:
    one, path = trainer(Ball(), steps=20), tmp_path / "c.pt"
    while one.step < 10:
        one.advance()
    one.save(path)
    two = trainer(Ball(), steps=20)
    assert two.load(path) and two.choices == one.choices and one.choices is not None
    for t in (one, two):
        while t.step < 14:
            t.advance()
    for (name, p), (_, q) in zip(one.model.state_dict().items(), two.model.state_dict().items(), strict=True):
        assert torch.equal(p, q), name


@pytest.mark.slow
def test_a_surface_that_rests_is_the_prior() -> None:
    t = trainer(Ball(), radius=0.104, refine_geometry="off", steps=20)
    t.prior = start(0.104)
    while t.step < 12:
        t.advance()
    d = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    assert float(t.model.geometry(0.104 * d)[0].detach().abs().max()) < 4e-4  # what a spline of samples is off


# ------------------------------------------------------------------ the arithmetic
def trial_of(t: Trainer) -> cross_validation.ValidationSamples:
    assert t.table is not None
    x, n = surface_points(t.model.geometry, t.table.draw(1500, 0.0, 3).rays)
    out = cross_validation.validation_samples(observe(t.model.geometry, pictures(t.views), x, n), t.validation, t.model)
    assert out is not None
    return out


def test_sightings_show_the_ball() -> None:
    """Colours are the photos', and no view sees the far side."""
    t = trainer(Ball())
    assert t.table is not None
    x, n = surface_points(t.model.geometry, t.table.draw(1500, 0.0, 3).rays)
    seen = observe(t.model.geometry, pictures(t.views), x, n)
    true = texture(seen.normal) * (0.7 + 0.3 * seen.normal[:, 1:2])
    assert np.sqrt(np.mean((seen.colour - true) ** 2)) < 0.01
    assert seen.cosine.min() > 0.35
    per_view = np.bincount(seen.view, minlength=24)
    assert per_view.min() > 100
    assert not seen.on_skin.any()  # no photo has labels
    upper = [replace(v, skin=np.arange(v.size[1])[:, None] < v.size[1] * np.ones(v.size[0]) / 2) for v in t.views]
    labelled = observe(t.model.geometry, pictures(upper), x, n)
    assert 0.2 < labelled.on_skin.mean() < 0.8
    assert labelled.normal[labelled.skin, 1].mean() > labelled.normal[~labelled.skin, 1].mean() + 0.5


def test_the_border_of_the_skin_does_not_count() -> None:
    view = trainer(Ball()).views[0]
    skin = np.zeros(view.size[::-1], np.bool_)
    skin[8:24, 8:24] = True
    inside = skin_inside(replace(view, skin=skin), 1)
    assert inside is not None and inside.sum() == 14 * 14 and inside[9, 9] and not inside[8, 8]
    assert skin_inside(replace(view, skin=None), 1) is None


def test_the_lobe_is_a_least_squares_fit() -> None:
    """The closed form against numpy's own solver on dummies for every point."""
    t = trial_of(trainer(Ball(gloss(3))))
    few = np.flatnonzero(t.train & (t.point < 60))
    keep = np.isin(t.point, t.point[few])
    sub = replace_rows(t, keep)
    left, _ = cross_validation.lobe(sub, 2, cross_validation.alike(sub))
    points, which = np.unique(sub.point, return_inverse=True)
    dummies = np.eye(len(points))[which]
    a = np.concatenate([dummies, sub.features[:, :9]], 1)
    b, *_ = np.linalg.lstsq(a[sub.train], sub.colour[sub.train], rcond=None)
    assert np.abs(left - (sub.colour - a @ b))[sub.train].max() < 1e-5


def replace_rows(t: cross_validation.ValidationSamples, keep: Any) -> cross_validation.ValidationSamples:
    return cross_validation.ValidationSamples(
        t.point[keep], t.view[keep], t.colour[keep], t.features[keep], t.cosine[keep], t.x[keep],
        t.train[keep], t.tune[keep], t.test[keep], t.counts,
    )  # fmt: skip


def test_errors_are_compared_in_quadrature() -> None:
    assert cross_validation.more(5.0, 4.0) == pytest.approx(3.0) and cross_validation.more(4.0, 5.0) == pytest.approx(
        -3.0
    )
    assert cross_validation.more(2.0, 2.0) == 0.0


def test_the_least_rank_is_not_led_by_noise() -> None:
    assert cross_validation.least_rank([0.13, 0.1001, 0.1]) == 2
    assert cross_validation.least_rank([0.1001, 0.1, 0.102]) == 1
    assert cross_validation.least_rank([0.004, 0.001]) == 1  # both are negligible


# ------------------------------------------------------------------ resolution
def test_the_footprint_is_a_pixel_on_the_ball() -> None:
    """From 0.5 to 0.56 m at 170 pixels of focal length, the nearest point at 0.4: 2.35 to 3.3 mm, a little more at an
    angle; and the ball's own area."""
    looked = footprint(start(), Ball().photos(), 96)
    assert looked is not None
    assert 0.4 / FOCAL < looked.pixel < 0.5 / FOCAL * 1.3
    assert looked.area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.06)
    coarse = footprint(start(), Ball().photos(), 48)
    assert coarse is not None and coarse.pixel == pytest.approx(2 * looked.pixel)
    assert looked.texture == 2 * coarse.texture


def test_settings_no_finer_than_the_photos() -> None:
    looked = footprint(start(), Ball().photos(), 96)
    assert looked is not None
    wish = SMALL.changed(grid_cells=1000, hash_fine=1e-5)
    cell = 0.2 / 1000
    got = supported(wish, looked, Start(start().values, start().lo, cell))
    assert got.grid_cells * looked.pixel == pytest.approx(1000 * cell, rel=0.02)
    assert got.hash_fine == pytest.approx(0.5 * looked.pixel)
    modest = SMALL.changed(grid_cells=20, hash_fine=0.01)
    assert supported(modest, looked, Start(start().values, start().lo, 0.01)) == modest
    assert supported(wish, None, start()) == wish
