"""The light in closed form: made-up sightings of a ball under a known light, by sums of their own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy.special import sph_harm_y

from pipeline.fields.appearance import TYPICAL_INV_KAPPA
from pipeline.maths import sh
from pipeline.maths.ggx_width import gauge_alpha
from pipeline.maths.microfacet import SKIN_F0
from stages.inverse_rendering import light_estimate as lamp_module
from stages.inverse_rendering.light_estimate import (
    MIN_EXPLAINED,
    level_by_skin,
    light_from_lobe,
    light_from_mirror,
    reflectance,
)
from stages.inverse_rendering.observations import MIN_COSINE, Observations

F64 = npt.NDArray[np.float64]
ORDER = 3
VIEWS, POINTS = 24, 600


def unit(x: F64) -> F64:
    return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))


def harmonics(d: F64, order: int) -> F64:
    """Real orthonormal harmonics without the Condon-Shortley phase, from scipy's complex ones."""
    theta, phi = np.arccos(d[:, 2].clip(-1, 1)), np.arctan2(d[:, 1], d[:, 0])
    out = []
    for band in range(order + 1):
        for m in range(-band, band + 1):
            y = sph_harm_y(band, abs(m), theta, phi) * (-1) ** abs(m)
            out.append(y.real if m == 0 else np.sqrt(2) * (y.imag if m < 0 else y.real))
    return np.stack(out, -1)


def true_light(seed: int = 0, ratio: float = 1.6) -> F64:
    """Coefficients whose band 0 is `ratio` times band 1."""
    c = np.random.default_rng(seed).normal(size=(ORDER + 1) ** 2) * 0.25
    c[1:4] *= 0.8 / np.linalg.norm(c[1:4])
    c[0] = ratio * 0.8
    return c


def observations(
    light: F64, noise: float = 0.0, lobe: float = 1.0, spots: float = 0.0, gain: Any = None
) -> Observations:
    """Points all over a ball, each seen by the cameras in front of it. spots: how uneven the albedo is."""
    rng = np.random.default_rng(1)
    n, eyes = unit(rng.normal(size=(POINTS, 3))), unit(rng.normal(size=(VIEWS, 3)))
    cosine = n @ eyes.T
    point, view = np.nonzero(cosine > MIN_COSINE)
    normal, wo = n[point], eyes[view]
    c = cosine[point, view]
    falls = np.repeat([np.exp(-b * (b + 1) * TYPICAL_INV_KAPPA / 2) for b in range(ORDER + 1)], [1, 3, 5, 7])
    lambdas = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0], [1, 3, 5, 7])
    albedo = 0.4 * np.exp(spots * rng.normal(size=POINTS))
    diffuse = albedo / np.pi * (harmonics(n, ORDER) @ (lambdas * light))
    mirror = 2 * c[:, None] * normal - wo
    shine = lobe * reflectance(c) * (harmonics(mirror, ORDER) @ (falls * light))
    colour = (diffuse[point] + shine)[:, None] * np.ones(3) + noise * rng.normal(size=(len(point), 3))
    if gain is not None:
        colour = colour * gain[view]
    x = torch.from_numpy(0.1 * n)
    return Observations(x, torch.from_numpy(n), point.astype(np.int64), view.astype(np.int64), colour, wo)


def solved(seen: Observations, **changes: Any) -> Any:
    return light_from_lobe(
        seen, changes.get("order", ORDER), changes.get("gain", np.ones((VIEWS, 3))), changes.get("kind", "exponential")
    )


def test_a_known_light_is_found_with_its_level() -> None:
    light = true_light()
    estimate = solved(observations(light))
    assert estimate.explained > 0.99 and estimate.scale == pytest.approx(1.0, rel=0.04)  # as fine as SCALES are
    assert np.allclose(estimate.coefficients, light, atol=0.04)


def test_spots_noise_and_gains_do_not_move_it() -> None:
    """Spots drop out exactly; noise as large as half the lobe averages out."""
    light = true_light(3)
    gain = np.random.default_rng(2).uniform(0.8, 1.2, (VIEWS, 3))
    estimate = solved(observations(light, noise=0.01, spots=0.3, gain=gain), gain=gain)
    shape = np.corrcoef(estimate.coefficients[1:], light[1:])[0, 1]
    assert shape > 0.98 and abs(estimate.coefficients[0] / light[0] - 1) < 0.05


def test_the_bands_scale_comes_from_even_skin(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that takes the lobe for wider than it is finds bands from 1 on too strong; even skin takes that back."""
    light = true_light(ratio=2.4)
    seen = observations(light)
    grid = np.linspace(0, 1, 1001)
    table = reflectance(grid)
    monkeypatch.setattr(lamp_module, "TYPICAL_INV_KAPPA", 0.4)
    monkeypatch.setattr(lamp_module, "reflectance", lambda c: np.interp(c, grid, table))  # as strong, but wider
    found = solved(seen)
    assert found.scale < 0.85
    assert abs(found.coefficients[1:4] / light[1:4] - 1).max() < 0.25


def test_a_light_without_a_first_band_is_not_blown_up() -> None:
    light = np.zeros((ORDER + 1) ** 2)
    light[0], light[5] = 1.5, 0.5
    found = solved(observations(light, noise=0.002))
    assert np.allclose(found.coefficients, light, atol=0.15)


def test_matt_cloth_does_not_dim_the_light() -> None:
    """Three quarters of the points reflect a fifth of what skin does: all together tell half of the light."""
    light = true_light()
    shiny, matt = observations(light), observations(light, lobe=0.2, noise=0.005)
    skin = shiny.point < POINTS // 4
    seen = replace(shiny, colour=np.where(skin[:, None], shiny.colour, matt.colour), skin=skin)
    found, blind = solved(seen), solved(replace(seen, skin=None))
    assert blind.coefficients[0] < 0.6 * light[0] and blind.level == 1.0
    assert found.coefficients[0] == pytest.approx(light[0], rel=0.1)
    assert found.explained_on_skin > found.explained == blind.explained
    assert found.level == pytest.approx(found.coefficients[0] / blind.coefficients[0])


def test_the_level_of_skin_like_all_else_stays() -> None:
    light = true_light()
    seen = observations(light, noise=0.01)
    found = solved(replace(seen, skin=seen.point < POINTS // 2))
    assert found.level == pytest.approx(1.0, abs=0.03)


def test_the_level_by_skin_counts_by_its_certainty() -> None:
    """Skin asks for twice the light. Its share is the squared correlation, .64; ln g is known to .06 ((1 - e) / e)^1.5.
    With .25 over all points its weight is 1 - ((.36 / .64) / 3)^3; with no more than all points it is 0."""
    lobe, off = np.array([1.0, -1.0, 1.0, -1.0]), np.array([1.0, 1.0, -1.0, -1.0])
    seen = 2 * lobe + 1.5 * off
    level, share = level_by_skin(lobe, seen, 0.25)
    assert share == pytest.approx(0.64)
    assert level == pytest.approx(2 ** (1 - (0.5625 / 3) ** 3))
    assert level_by_skin(lobe, seen, 0.7) == (1.0, 0.7)
    assert level_by_skin(-lobe, seen, 0.25) == (1.0, 0.25)
    assert level_by_skin(0 * lobe, seen, 0.25) == (1.0, 0.25)


def test_nothing_is_made_of_noise() -> None:
    assert solved(observations(true_light(), noise=0.05, lobe=0.0)) is None
    assert solved(observations(true_light()), order=0) is None
    few = observations(true_light())
    keep = few.point < 100
    few = Observations(few.x, few.n, few.point[keep], few.view[keep], few.colour[keep], few.wo[keep])
    assert solved(few) is None
    assert MIN_EXPLAINED > 0


def test_black_and_constant_photos_have_no_light() -> None:
    seen = observations(true_light())
    for value in (0.0, 0.5):
        flat = Observations(seen.x, seen.n, seen.point, seen.view, np.full_like(seen.colour, value), seen.wo)
        assert solved(flat) is None


def test_reflectance_is_the_hemisphere_integral_of_a_rough_dielectric() -> None:
    """GGX with height-correlated Smith shadowing and Schlick's Fresnel, integrated over the light's direction by the
    midpoint rule on a fine grid."""
    alpha = float(gauge_alpha(torch.tensor([TYPICAL_INV_KAPPA], dtype=torch.float64))[0])
    count = 400
    z = (np.arange(count) + 0.5) / count
    phi = (np.arange(count) + 0.5) / count * 2 * np.pi
    z, phi = (a.ravel() for a in np.meshgrid(z, phi))
    toward = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], -1)

    def lam(c: F64) -> F64:
        return np.asarray((np.sqrt(1 + alpha**2 * (1 - c * c) / (c * c)) - 1) / 2)

    for c in (0.4, 0.7, 0.95):
        eye = np.array([np.sqrt(1 - c * c), 0, c])
        h = unit(toward + eye)
        d = alpha**2 / (np.pi * (h[:, 2] ** 2 * (alpha**2 - 1) + 1) ** 2)
        f = SKIN_F0 + (1 - SKIN_F0) * (1 - (h @ eye)) ** 5
        whole = d * f / (1 + lam(z) + lam(np.full_like(z, c))) / (4 * z * c) * z
        assert reflectance(np.array([c]))[0] == pytest.approx(whole.sum() * 2 * np.pi / len(z), rel=0.02)


def test_harmonics_agree_with_the_projects() -> None:
    d = unit(np.random.default_rng(0).normal(size=(50, 3)))
    assert np.allclose(harmonics(d, ORDER), sh.sh_basis(torch.from_numpy(d), ORDER).numpy(), atol=1e-10)


@pytest.mark.slow
def test_a_fit_takes_the_light_over() -> None:
    """A glossy ball: the light is put in, the lobe begins anew, and the fit goes on with both; a checkpoint knows."""
    from stages.inverse_rendering.model_selection import restored
    from tests.inverse_rendering.test_cross_validation import trainer
    from tests.support.balls import Ball, gloss

    t = trainer(Ball(gloss(4, 0.02)))
    before = t.model.light().detach().clone()
    t.select_model()
    c = t.choices
    assert c is not None and c.light_known and c.facts["light"]["from"] == "view-dependent residuals"
    light = t.model.light().detach()
    assert not torch.equal(before[: len(light)], light) and torch.equal(light[:, 0], light[:, 2])
    strongest = int(light[1:, 0].abs().argmax()) + 1
    assert 16 <= strongest < 25  # the ball's light is of band 4
    x = 0.1 * torch.nn.functional.normalize(torch.randn(9, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    n = torch.nn.functional.normalize(x, dim=-1)
    with torch.no_grad():
        _, rho, k, s = t.model.spatial(x)
        strength = rho * t.model.basis.integral(x, k, n, n)
    assert torch.allclose(strength, torch.full((9,), float(reflectance(np.ones(1))[0])), rtol=0.05)
    assert torch.allclose(s, torch.full((9,), TYPICAL_INV_KAPPA), rtol=1e-3)
    assert t.weights().albedo_sparsity == 0 and restored(c.plain()).light_known
    for _ in range(3):
        t.advance()
    assert np.isfinite(t.loss)


@pytest.mark.parametrize(
    "changes",
    [
        {"light_from": "uniform_albedo"},
        {"specular": "off"},
    ],
)
@pytest.mark.slow
def test_where_the_lobe_is_not_asked(changes: dict[str, Any]) -> None:
    from tests.inverse_rendering.test_cross_validation import trainer
    from tests.support.balls import Ball, gloss

    t = trainer(Ball(gloss(4, 0.25)), **changes)
    t.select_model()
    assert t.choices is not None and not t.choices.light_known and t.weights().albedo_sparsity > 0


@pytest.mark.parametrize("index", [20, 30, 45])
def test_the_scale_is_that_which_makes_the_albedo_even(index: int) -> None:
    """D = a E / pi of one albedo, and the lobe's part of any size beside it: nothing is left to explain at the scale
    with which the colours were made."""
    light, scale, rng = true_light(ratio=3.0), lamp_module.SCALES[index], np.random.default_rng(4)
    n = unit(rng.normal(size=(400, 3)))
    glow, even = 0.3 * light[0] * rng.normal(size=400), rng.uniform(0.02, 0.06, 400)
    lambdas = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0], [1, 3, 5, 7])
    scaled = light * np.concatenate([[1.0], np.full(15, scale)])
    lit = 0.4 / np.pi * harmonics(n, ORDER) @ (lambdas * scaled)
    none = np.zeros(0, np.int64)
    seen = Observations(torch.zeros(400, 3), torch.from_numpy(n), none, none, np.zeros((0, 3)), np.zeros((0, 3)))
    total = lit + scale * glow + even * light[0]
    found = lamp_module._evenest(seen, light, total, glow, even, np.ones(400, bool))
    assert (lit > 0.05 * lit.mean()).all() and found == pytest.approx(scale, rel=1e-9)


def test_dark_hair_above_is_not_taken_for_a_dark_sky() -> None:
    """A light from above on a head with dark hair on top: all points alone say that there is hardly any light from
    above. With the skin of the front the scale is right."""
    rng = np.random.default_rng(5)
    n = unit(rng.normal(size=(1500, 3)))
    light = np.zeros(16)
    light[[0, 1, 2]] = 3.0, 0.9, 0.3  # above, and a little in front
    hair, skin = n[:, 1] > 0.3, (n[:, 1] < 0.3) & (n[:, 2] > 0.4)
    albedo = np.where(hair, 0.05, np.where(skin, 0.4, 0.25)) * np.exp(rng.normal(0, 0.1, 1500))
    lambdas = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0], [1, 3, 5, 7])
    lit = albedo / np.pi * (harmonics(n, ORDER) @ (lambdas * light))
    every, views = np.arange(1500), np.zeros(1500, np.int64)
    flat = np.zeros((1500, 3))
    found = []
    for shown in (None, skin):
        seen = Observations(torch.zeros(1500, 3), torch.from_numpy(n), every, views, flat, flat, shown)
        found.append(lamp_module._evenest(seen, light, lit, np.zeros(1500), np.zeros(1500), np.ones(1500, bool)))
    assert found[1] == pytest.approx(1.0, rel=0.25)
    assert found[0] is not None and found[0] < 0.6


def test_the_largest_scale_is_none() -> None:
    """An albedo that follows the light gets more even up to the last scale; one against it up to the least, which
    stays: a light that is too even does no harm."""
    n = unit(np.random.default_rng(6).normal(size=(900, 3)))
    light = np.array([3.0, 0.0, 0.3, *[0.0] * 13])
    none = np.zeros(0, np.int64)
    seen = Observations(torch.zeros(900, 3), torch.from_numpy(n), none, none, np.zeros((0, 3)), np.zeros((0, 3)))
    lambdas = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0], [1, 3, 5, 7])
    for times, wanted in ((9.0, None), (1.0, 1.0), (-1.0, lamp_module.SCALES[0])):
        lit = 0.3 / np.pi * (harmonics(n, ORDER) @ (lambdas * light * np.array([1.0, *[times] * 15])))
        zero = np.zeros(900)
        found = lamp_module._evenest(seen, light, lit, zero, zero, np.ones(900, bool))
        assert found is None if wanted is None else found == pytest.approx(wanted, rel=0.05)


def test_skin_is_what_most_photos_show_as_skin() -> None:
    point = np.array([0, 0, 0, 1, 1, 2])
    seen = Observations(
        torch.zeros(4, 3), torch.zeros(4, 3), point, point, np.zeros((6, 3)), np.zeros((6, 3)),
        np.array([True, True, False, True, False, True]),
    )  # fmt: skip
    assert seen.on_skin.tolist() == [True, False, True, False]
    assert not replace(seen, skin=None).on_skin.any()


def mirrors_alone(light: F64, noise: float = 0.0) -> Observations:
    """What polarised pairs show of `observations`: with black skin nothing but the lobe is left."""
    seen, dull = observations(light, noise), observations(light, lobe=0.0)
    return Observations(seen.x, seen.n, seen.point, seen.view, seen.colour - dull.colour, seen.wo)


@pytest.mark.parametrize("ratio", [0.9, 1.6, 4.0])
def test_polarised_pairs_tell_the_light_with_its_mean(ratio: float) -> None:
    light = true_light(ratio=ratio)
    found = light_from_mirror(mirrors_alone(light), ORDER, np.ones((VIEWS, 3)), "exponential")
    assert found.explained > 0.99 and found.scale == 1
    assert np.allclose(found.coefficients, light, atol=0.03)


def test_noise_moves_it_less_than_it_moves_the_estimate_from_residuals() -> None:
    light = true_light(2)
    found = light_from_mirror(mirrors_alone(light, 0.01), ORDER, np.ones((VIEWS, 3)), "exponential")
    other = solved(observations(light, noise=0.01))
    off = [float(np.abs(c.coefficients - light).max()) for c in (found, other)]
    assert off[0] < off[1] and off[0] < 0.1


def test_pairs_without_highlights_tell_no_light() -> None:
    gain = np.ones((VIEWS, 3))
    assert light_from_mirror(mirrors_alone(0 * true_light(), 0.01), ORDER, gain, "exponential") is None
    assert light_from_mirror(mirrors_alone(true_light()), 0, gain, "exponential") is None
