"""Colours that hardly any photo shows and no other place has: a strip of skin with an orange patch."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.fields.protocol import Material
from pipeline.meshes import F32, F64, Indices, Mesh
from pipeline.visibility import FittedPhoto, Sight
from stages.bake.build import Baker, _believed, _known
from stages.bake.filling import Filler
from stages.bake.odd_colours import (
    FARTHEST,
    LEAST,
    MOST,
    RIGHT,
    UNIFORM,
    WIDE,
    WIDTH,
    WRONG,
    _kernels,
    apart,
    doubted,
)
from stages.bake.standard_fit import Fitted
from stages.surface.build import build as surface_build
from stages.uv.config import Config
from stages.uv.decimate import decimated
from stages.uv.unwrap import unwrap
from tests.bake.test_bake_unseen import strip
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.field_artifacts import camera

MESH: Mesh = strip(0.2, 0.001)
X = MESH.vertices[:, 0].astype(np.float64)
PATCH = (X > 0.09) & (X < 0.11)
SKIN, ORANGE = np.array([0.10, 0.05, 0.03]), np.array([0.40, 0.10, 0.02])
ONE = np.zeros(len(X), np.int64)


def colours(patch: F64 = ORANGE) -> F64:
    """Skin with a fine pattern of a tenth, and a patch."""
    return np.where(PATCH[:, None], patch, SKIN * (1 + 0.1 * np.sin(X / 0.0007))[:, None])


def sight(patch: float, elsewhere: float = 20.0) -> Sight:
    return Sight(np.full(len(X), 0.9), np.where(PATCH, patch, elsewhere))


def test_an_odd_colour_is_replaced_where_few_photos_show_it() -> None:
    found = doubted(MESH, colours(), ONE, sight(1.0))
    assert (found[PATCH] == 1).all() and (found[~PATCH] == 0).all()


def test_many_photos_are_believed() -> None:
    assert (doubted(MESH, colours(), ONE, sight(20.0)) == 0).all()
    share = [doubted(MESH, colours(), ONE, sight(k))[PATCH].mean() for k in (1.0, 4.0, 8.0, 11.0, 20.0)]
    assert (np.diff(share) <= 1e-12).all() and share[0] == 1 and share[-1] == 0


def test_colours_that_occur_elsewhere_are_believed() -> None:
    assert (doubted(MESH, colours(SKIN), ONE, sight(1.0)) == 0).all()
    twice = colours()
    twice[X < 0.02] = ORANGE  # a shirt, which many photos show
    assert (doubted(MESH, twice, ONE, sight(1.0)) == 0).all()


def test_a_region_has_its_own_colours() -> None:
    """A shirt's colour on the neck is odder than the same on the shirt."""
    twice, region = colours(), np.where(X < 0.02, 1, 0)
    twice[X < 0.02] = ORANGE
    neck, shirt = (doubted(MESH, twice, r, sight(0.3))[PATCH].mean() for r in (region, ONE))
    assert neck > 0.1 and shirt == 0


def test_the_formula() -> None:
    """Against a direct evaluation, at one vertex that few photos show, of a usual colour's tail."""
    colour = np.tile(SKIN, (len(X), 1))
    at = int(np.flatnonzero(PATCH)[5])
    shift = 3.4
    colour[at] = SKIN * np.exp(shift * WIDTH[0])
    few = Sight(np.full(len(X), 0.9), np.where(np.arange(len(X)) == at, 1.0, 20.0))
    f = np.exp(-0.5 * shift**2) / ((2 * np.pi) ** 1.5 * WIDTH.prod())
    p = WRONG
    doubt = p * UNIFORM / (p * UNIFORM + (1 - p) * f)
    t = np.clip((doubt - MOST[1]) / (MOST[0] - MOST[1]), 0, 1)
    assert 0.02 < t < 0.98
    assert doubted(MESH, colour, ONE, few)[at] == pytest.approx(t * t * (3 - 2 * t), rel=1e-3)


def test_kernels_are_a_density() -> None:
    """Its integral over a box around the samples is 1."""
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(20, 3)) * [0.3, 0.1, 0.1]
    low, high = np.array([-3.0, -1.2, -1.2]), np.array([3.0, 1.2, 1.2])
    axes = [np.arange(a, b, w / 2) for a, b, w in zip(low, high, WIDTH, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    assert _kernels(nodes, samples).sum() * (WIDTH / 2).prod() == pytest.approx(1, abs=1e-4)


def test_few_cameras_count_more() -> None:
    """Where usual places are in two photos, one of them that shows a mole is believed more than one of twenty."""
    mole = colours(SKIN * [0.5, 0.42, 0.38])
    few, many = (doubted(MESH, mole, ONE, sight(0.9, usual))[PATCH].mean() for usual in (2.0, 20.0))
    assert few < 0.1 < 0.9 < many


def test_a_patch_goes_as_a_whole() -> None:
    """Spots of a usual colour in the middle of what few photos show wrongly."""
    spotted = colours()
    spots = PATCH & (np.round(X / 0.001) % 5 == 0)
    spotted[spots] = SKIN
    assert doubted(MESH, spotted, ONE, sight(1.0))[spots].min() > 0.9


# ------------------------------------------------------------------ photos that contradict each other
def test_a_usual_colour_is_doubted_where_two_photos_contradict_each_other() -> None:
    plain, off = colours(SKIN), np.where(PATCH, 0.6, 0.05)
    assert (doubted(MESH, plain, ONE, sight(2.0), off)[PATCH] > 0.9).all()
    assert (doubted(MESH, plain, ONE, sight(2.0), np.full(len(X), 0.05)) == 0).all()
    assert (doubted(MESH, plain, ONE, sight(20.0), off) == 0).all()
    unknown = np.full(len(X), np.nan)
    assert (doubted(MESH, plain, ONE, sight(2.0), unknown) == doubted(MESH, plain, ONE, sight(2.0))).all()


def test_a_contradicted_back_goes_as_a_whole_and_a_small_corner_does_not() -> None:
    """Every second vertex is in one photo, which nothing contradicts."""
    plain, pair = colours(SKIN), np.arange(len(X)) % 2 == 0

    def gone(half: float) -> F64:
        back = abs(X - 0.1) < half
        few = Sight(np.full(len(X), 0.9), np.where(back, np.where(pair, 2.0, 1.0), 20.0))
        off = np.where(back, np.where(pair, 0.6, np.nan), 0.05)
        return doubted(MESH, plain, ONE, few, off)[(abs(X - 0.1) < 0.9 * half) & ~pair]

    assert gone(0.04).min() > 0.9
    assert gone(0.0006).max(initial=0) < 0.1


def test_the_formula_of_contradicting_photos() -> None:
    """As the probability that m is of the wide one of two exponential densities."""
    from scipy import stats

    at, k, m = int(np.flatnonzero(PATCH)[5]), 3.0, 0.42
    few = Sight(np.full(len(X), 0.9), np.where(np.arange(len(X)) == at, k, 20.0))
    p = WRONG**k
    wrong, right = (stats.expon.pdf(m, scale=s) for s in (WIDE, RIGHT))
    doubt = p * wrong / (p * wrong + (1 - p) * right)
    t = np.clip((doubt - MOST[1]) / (MOST[0] - MOST[1]), 0, 1)
    assert 0.02 < t < 0.98
    found = doubted(MESH, np.tile(SKIN, (len(X), 1)), ONE, few, np.where(np.arange(len(X)) == at, m, 0.02))
    assert found[at] == pytest.approx(t * t * (3 - 2 * t), rel=1e-3)


def test_how_far_photos_are_apart_is_the_median_of_their_errors() -> None:
    rng = np.random.default_rng(2)
    vertex = rng.integers(0, 40, 300)
    vertex = np.concatenate([vertex[vertex != 7], [41]])
    colour, predicted = rng.uniform(0.01, 1, (2, len(vertex), 3))
    found = apart(vertex, colour, predicted, 43)
    y = np.array([0.2126, 0.7152, 0.0722])
    for v in range(43):
        off = np.abs(np.log(colour @ y) - np.log(predicted @ y))[vertex == v]
        assert np.isnan(found[v]) if len(off) < 2 else found[v] == pytest.approx(np.median(off), rel=1e-9)
    assert np.isnan(found[[7, 41, 42]]).all()


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e30])
def test_black_and_very_bright_colours_are_a_finite_way_apart(value: float) -> None:
    vertex, dark = np.array([0, 0, 0]), np.zeros((3, 3))
    found = apart(vertex, np.full((3, 3), value), dark, 1)
    assert found[0] == pytest.approx(max(np.log(max(value, LEAST) / LEAST), 0))
    doubt = doubted(MESH, colours(SKIN), ONE, sight(2.0), np.where(PATCH, 10 * FARTHEST, 0.0))
    assert np.isfinite(doubt).all() and doubt.max() == 1


def test_extremes() -> None:
    unseen = Sight(np.zeros(len(X)), np.zeros(len(X)))
    assert (doubted(MESH, colours(), ONE, unseen) == 0).all()
    for colour in (np.zeros((len(X), 3)), np.full((len(X), 3), 1e6)):
        found = doubted(MESH, colour, ONE, sight(1.0))
        assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1
    hardly = doubted(MESH, colours(), ONE, sight(1e-9))
    assert np.isfinite(hardly).all() and (hardly[PATCH] == 1).all()


def test_what_is_doubted_is_filled_by_what_is_not() -> None:
    """The patch goes on in the colour of its surroundings."""
    seen = sight(1.0)
    fill = Filler(MESH, seen, ONE, np.zeros(len(X)))
    plain, kept = fill(colours())
    assert (plain == 0).all()
    np.testing.assert_array_equal(kept, colours())
    replaced, filled = fill(colours(), doubted(MESH, colours(), ONE, seen))
    assert (replaced[PATCH] == 1).all() and (replaced[~PATCH] == 0).all()
    np.testing.assert_allclose(filled[PATCH], np.tile(SKIN, (PATCH.sum(), 1)), rtol=0.15)


def test_what_is_doubted_does_not_stand_for_its_region() -> None:
    """A region of which photos show a doubted patch alone goes on in the colour of the others."""
    seen = Sight(np.where(X < 0.05, 0.0, 0.9), np.where(X < 0.05, 0.0, np.where(PATCH, 1.0, 20.0)))
    region = np.where((X < 0.05) | PATCH, 1, 0)
    _, filled = Filler(MESH, seen, region, np.zeros(len(X)))(colours(), np.where(PATCH, 1.0, 0.0))
    np.testing.assert_allclose(filled[X < 0.001], np.tile(SKIN, ((X < 0.001).sum(), 1)), rtol=0.15)


class Patched(AnalyticField):
    """A field whose albedo is that of the strip."""

    def material(self, points: F32) -> Material:
        found = super().material(points)
        return Material(colours().astype(np.float32), found.rho, found.coefficients, found.inv_kappa)


@pytest.mark.parametrize("fitted", [False, True])
def test_the_correction_goes_with_the_colour(fitted: bool) -> None:
    """What made the colour odd may be the correction of the albedo: it goes on from around, too."""
    field, fill = Patched(sphere(0.08)), Filler(MESH, sight(1.0), ONE, np.zeros(len(X)))
    known = _known(field, fill, np.ones(len(X), np.float32))
    zero = np.zeros(len(X), np.float32)
    correction = np.where(PATCH[:, None], 2.5, 1.1 * np.ones((len(X), 3))).astype(np.float32)
    material = Fitted(correction, zero, zero, correction, {}) if fitted else None
    found, standard = _believed(known, field, fill, material)
    assert (known.replaced == 0).all() and (found.replaced[PATCH] == 1).all()
    np.testing.assert_allclose(found.albedo[PATCH], np.tile(SKIN, (PATCH.sum(), 1)), rtol=0.15)
    if fitted:
        assert standard is not None
        np.testing.assert_allclose(standard.correction, 1.1, rtol=1e-3)
    else:
        assert standard is None


def test_things_without_a_head_are_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def all_of_it(mesh: Mesh, colour: F64, region: Indices, sight: Sight, apart: F64 | None) -> F64:
        asked.append(len(region))
        return np.zeros(len(colour))

    monkeypatch.setattr("stages.bake.build.doubted", all_of_it)
    field = AnalyticField(sphere(0.08))
    mesh = decimated(surface_build(field, 24, lambda *_: None).mesh, 400)
    charts = unwrap(mesh, Config(texture_size=256, padding=4))
    for region, times in ((None, 0), (np.zeros(len(mesh.vertices), np.int64), 1)):
        Baker(field, mesh, charts, [FittedPhoto(camera(0, 0.0), None)], 64, lambda *_: None, region=region)
        assert len(asked) == times
