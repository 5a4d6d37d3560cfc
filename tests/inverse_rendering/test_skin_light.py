"""Correction of the light by the skin: oracles are lights whose irradiance is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from pipeline.fields.appearance import SpatialField
from pipeline.fields.face import FaceModel
from pipeline.fields.light import ShLight
from pipeline.meshes import F64
from stages.inverse_rendering import skin_light
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.observations import surface_hits
from stages.inverse_rendering.relight_model import change_light
from stages.inverse_rendering.skin_light import (
    DARKEST,
    EVEN_STD,
    MIN_POINTS,
    Skin,
    SkinLight,
    correct_light,
    correction,
    directions,
    irradiance_basis,
    least_irradiance,
    limited,
    skin_points,
    unevenness,
)
from tests.support.small_ball import fit_of_the_ball
from tests.support.spread import made_once

WHITE = np.array([3.0, 0, 0, 0, 0, 0, 0, 0, 0])
WINDOW = np.array([0, 0.3, 0.4, 0.9, 0.2, 0, 0, 0.1, 0.2])  # from the left, above and in front
KAPPA = np.array([0.5, 0.35, 0.28])


def face(count: int = 4000, seed: int = 0) -> F64:
    """Normals of a face: around +z."""
    n = np.random.default_rng(seed).normal(size=(count, 3)) + [0, 0, 1.2]
    n = n[n[:, 2] > 0]
    return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))


def fitted(n: F64, true: F64, seen: F64) -> tuple[F64, F64]:
    """Albedo that explains skin of colour KAPPA under the light `true` (9, 3) by the light `seen` (9, 3), and the
    latter's irradiance."""
    basis = irradiance_basis(n)
    return KAPPA * (basis @ true) / (basis @ seen), basis @ seen


def of_three(*colours: F64) -> F64:
    return np.stack(colours, 1)


def around(seen: F64) -> F64:
    """(DIRECTIONS, 3) irradiance of the light `seen` (9, 3) in all directions."""
    return np.asarray(irradiance_basis(directions()) @ seen)


BRIGHT = around(of_three(WHITE, WHITE, WHITE)) * 100  # so much light that no limit is reached


def test_the_basis_gives_the_irradiance_by_quadrature() -> None:
    """int L(w) max(n . w, 0) dw over a fine grid of the sphere."""
    z = (np.arange(400) + 0.5) / 200 - 1
    a = (np.arange(800) + 0.5) * 2 * np.pi / 800
    s = np.sqrt(1 - z * z)[:, None]
    w = np.stack([s * np.cos(a), s * np.sin(a), np.broadcast_to(z[:, None], (400, 800))], -1).reshape(-1, 3)
    clamped = np.array([np.pi, *[2 * np.pi / 3] * 3, *[np.pi / 4] * 5])
    radiance = irradiance_basis(w) / clamped @ (WHITE + WINDOW)
    for n in face(5):
        expected = (radiance * (w @ n).clip(0)).sum() * 4 * np.pi / len(w)
        assert irradiance_basis(n[None]) @ (WHITE + WINDOW) == pytest.approx(expected, rel=1e-3)


def test_a_window_of_another_colour_is_found_from_white_light() -> None:
    """Warm light from the left and cool light from the right, fitted as white: the albedo's sides have two colours."""
    n = face()
    true = of_three(WHITE + 1.2 * WINDOW, WHITE + 0.6 * WINDOW, WHITE - 0.3 * WINDOW)
    albedo, irradiance = fitted(n, true, of_three(WHITE, WHITE, WHITE))
    found = correction(albedo, irradiance, n, EVEN_STD, BRIGHT)
    assert found is not None and (found.explained > 0.99).all()
    np.testing.assert_allclose(found.change[1:], (true - of_three(WHITE, WHITE, WHITE))[1:], atol=0.05)
    np.testing.assert_array_equal(found.change[0], 0)  # the light stays white on the mean
    corrected = albedo * irradiance / (irradiance + irradiance_basis(n) @ found.change)
    assert corrected.std(0).max() < 0.01 * KAPPA.min()


def test_a_known_light_is_corrected_from_the_side_only() -> None:
    """A darker chin is the skin's own, where the lobe tells the light; a darker left side is not."""
    n = face()
    side, below = np.zeros(9), np.zeros(9)
    side[3], below[1] = 0.6, 0.6
    assert irradiance_basis(np.array([[1.0, 0, 0]])) @ side > 0.5 < irradiance_basis(np.array([[0, 1.0, 0]])) @ below
    for extra, found_share in ((side, 1.0), (below, 0.0)):
        true = of_three(*[WHITE + extra] * 3)
        found = correction(*fitted(n, true, of_three(WHITE, WHITE, WHITE)), n, 1e-3, BRIGHT)
        assert found is not None
        wanted = found_share * (true - of_three(WHITE, WHITE, WHITE))
        np.testing.assert_allclose(irradiance_basis(n) @ (found.change - wanted), 0, atol=0.1)


def test_lips_and_brows_do_not_turn_the_light() -> None:
    n = face()
    albedo, irradiance = fitted(n, of_three(WHITE, WHITE, WHITE), of_three(WHITE, WHITE, WHITE))
    lips = (np.abs(n[:, 0] - 0.3) < 0.1) & (n[:, 1] < 0)
    albedo[lips] *= [1.0, 0.4, 0.4]
    found = correction(albedo, irradiance, n, EVEN_STD, BRIGHT)
    assert 0.01 < lips.mean() < 0.1 and found is not None and np.abs(found.change).max() < 0.05


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_change_scales_with_the_light(scale: float) -> None:
    n = face()
    white, true = of_three(WHITE, WHITE, WHITE), of_three(WHITE + WINDOW, WHITE, WHITE)
    one = correction(*fitted(n, true, white), n, EVEN_STD, around(white))
    many = correction(*fitted(n, scale * true, scale * white), n, EVEN_STD, around(scale * white))
    assert one is not None and many is not None
    np.testing.assert_allclose(many.change, scale * one.change, rtol=1e-6, atol=1e-9 * scale)


def test_nothing_is_corrected_without_skin_light_or_finite_values() -> None:
    n = face()
    albedo, irradiance = fitted(n, of_three(WHITE, WHITE, WHITE), of_three(WHITE, WHITE, WHITE))
    few = MIN_POINTS - 1
    assert correction(albedo[:few], irradiance[:few], n[:few], EVEN_STD, BRIGHT) is None
    assert correction(albedo, 0 * irradiance, n, EVEN_STD, BRIGHT) is None
    assert correction(0 * albedo, irradiance, n, EVEN_STD, BRIGHT) is None
    hole = np.where(np.arange(len(n))[:, None] == 7, np.nan, 1)
    assert correction(albedo * hole, irradiance, n, EVEN_STD, BRIGHT) is None
    assert correction(albedo, irradiance, n, EVEN_STD, BRIGHT * np.inf) is None


def test_the_least_irradiance_is_a_tenth_of_the_mean_or_what_there_was() -> None:
    found = least_irradiance(np.array([1.0, 1.5, 0.6, 0.05, -0.15]))
    np.testing.assert_allclose(found, [0.06, 0.06, 0.06, 0.05, -0.15])
    assert DARKEST == 0.1


@pytest.mark.parametrize("behind", [0.0, -0.5, -1.5])
def test_a_light_that_is_dark_where_nothing_faces_is_corrected_all_the_same(behind: float) -> None:
    """Dark or less behind the head, by high bands that no skin feels: the sides of the face become equal, and the light
    stays as bright behind as it must."""
    n = face()
    true, white = of_three(WHITE + WINDOW, WHITE, WHITE - 0.5 * WINDOW), of_three(WHITE, WHITE, WHITE)
    albedo, irradiance = fitted(n, true, white)
    behind_it = (directions()[:, 2] < -0.8)[:, None]
    everywhere = np.where(behind_it, behind, around(white))
    found = correction(albedo, irradiance, n, EVEN_STD, everywhere)
    assert found is not None
    corrected = albedo * irradiance / (irradiance + irradiance_basis(n) @ found.change)
    assert corrected.std(0).max() < 0.25 * albedo.std(0).max()
    left = everywhere + irradiance_basis(directions()) @ found.change
    assert (left >= np.stack([least_irradiance(c) for c in everywhere.T], 1) - 1e-6).all()


@pytest.mark.parametrize("count", [0, 1, 40])
def test_the_limited_solution_is_that_of_a_general_solver(count: int) -> None:
    """Against sequential quadratic programming [scipy]; without limits it is the linear system's."""
    rng = np.random.default_rng(count)
    rows, g = rng.normal(size=(20, 5)), 10 * rng.normal(size=5)
    gram, limits = rows.T @ rows, rng.normal(size=(count, 5)) + [1.0, 0, 0, 0, 0]
    found = limited(gram, g, limits)
    by_steps = minimize(
        lambda s: s @ gram @ s / 2 - g @ s,
        np.zeros(5),
        jac=lambda s: gram @ s - g,
        constraints={"type": "ineq", "fun": lambda s: limits @ s} if count else (),
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    np.testing.assert_allclose(found, by_steps.x, atol=1e-5)
    assert (limits @ found >= -1e-9).all() and (count == 0 or (limits @ np.linalg.solve(gram, g) < 0).any())


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_limits_count_by_their_direction_not_their_size(scale: float) -> None:
    limits = np.array([[-1.0, 1.0], [-1.0, -0.5]]) * scale
    np.testing.assert_allclose(limited(np.eye(2), np.array([1.0, 0.0]), limits), [0, 0], atol=1e-9)
    np.testing.assert_allclose(limited(np.eye(2), np.array([1.0, 0.0]), limits[:1]), [0.5, 0.5])


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return made_once(tmp_path_factory, "fit_of_the_ball", fit_of_the_ball)


def test_the_photos_stay_when_the_light_changes(ball: Trainer) -> None:
    """The ball's colour is a (0.7 + 0.3 n_y), for which c_1 / c_0 is 0.371 (test_fit). A light without that side gets
    an albedo that is darker below; the skin then finds the side again, and both times the ball looks the same."""
    model, light, views = ball.model, ball.model.light, ball.views
    rays = ball.pixels.draw(20_000, 0.0, 3).rays
    x, n, _ = surface_hits(model.geometry, rays, torch.arange(len(rays.d)))

    def look() -> torch.Tensor:
        with torch.no_grad():
            return torch.as_tensor(model.shade(x, n, n).total)

    def even() -> None:
        with torch.no_grad():
            light.coefficients[1:] = 0

    assert len(skin_points(model, views, "cpu")[0]) == 0 and correct_light(model, views, rays, None, "cpu") is None
    seen = look()
    assert isinstance(model.spatial, SpatialField)
    assert change_light(model, model.spatial, x, n, even) < 0.01
    assert float((look() / seen - 1).abs().mean()) < 0.03
    with torch.no_grad():
        albedo = model.spatial(x)[0].mean(-1)
    assert float(albedo[n[:, 1] > 0.5].mean() / albedo[n[:, 1] < -0.5].mean()) > 1.3
    lit = light.irradiance(n).detach().mean()
    asked = correct_light(model, [replace(v, skin=v.alpha > 0.99) for v in views], rays, None, "cpu")
    found = light().detach().mean(-1)
    assert asked is not None and asked.changed and float(asked.facts["skin_explains"]) > 0.8
    assert float(asked.facts["skin_uneven_corrected"]) < 0.5 * float(asked.facts["skin_uneven"])
    assert float(found[1] / found[0]) == pytest.approx(0.371, abs=0.06)
    assert float((look() / seen - 1).abs().mean()) < 0.03
    assert float(light.irradiance(n).detach().mean()) == pytest.approx(float(lit), rel=0.02)  # hence the albedo's level


def test_what_leaves_the_skin_as_uneven_as_it_was_is_left_out(ball: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A correction that makes an even skin uneven: the light stays, and the report says why."""
    views, rays = [replace(v, skin=v.alpha > 0.99) for v in ball.views], ball.pixels.draw(2_000, 0.0, 3).rays
    before = ball.model.light().detach().clone()
    change = np.zeros((9, 3))
    change[3] = 0.8
    monkeypatch.setattr(skin_light, "correction", lambda a, e, n, even, around: SkinLight(change, np.ones(3)))
    asked = correct_light(ball.model, views, rays, None, "cpu")
    assert asked is not None and not asked.changed and "skin_explains" not in asked.facts
    assert float(asked.facts["skin_uneven_corrected"]) > float(asked.facts["skin_uneven"])
    np.testing.assert_array_equal(ball.model.light().detach(), before)


def points(model: FaceModel, n: F64, albedo: F64) -> Skin:
    """Points on the unit sphere with these normals and colours (N, 3), under the model's light."""
    x = torch.from_numpy(n).float()
    with torch.no_grad():
        return Skin(x, x, model.light.irradiance(x), torch.from_numpy(albedo).float())


def test_skin_of_the_face_s_colour_counts_wherever_it_is_near_the_head(ball: Trainer) -> None:
    """A face around +z, and all around a neck in its colour, hair and a sheer collar; no neck is far from the head."""
    n = np.random.default_rng(3).normal(size=(9000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    kinds = np.arange(len(n)) % 3
    colour = np.array([0.8 * KAPPA, 0.05 * KAPPA, [0.5, 0.2, 0.3]])[kinds]
    front = n[n[:, 2] > 0.5]
    face_alone, others = points(ball.model, front, np.tile(KAPPA, (len(front), 1))), points(ball.model, n, colour)
    skin = face_alone.with_bare(others, lambda x: x[:, 1] < 0.5)
    expected = n[(kinds == 0) & (n[:, 1] < 0.5)]
    np.testing.assert_allclose(skin.n, expected, atol=1e-6)
    np.testing.assert_allclose(skin.albedo, np.tile(0.8 * KAPPA, (len(expected), 1)), rtol=1e-6)
    np.testing.assert_allclose(skin.irradiance, others.irradiance[(kinds == 0) & (n[:, 1] < 0.5)])
    for near in (None, lambda x: np.arange(len(x)) < MIN_POINTS - 1):
        assert face_alone.with_bare(others, near) is face_alone
    empty = points(ball.model, np.zeros((0, 3)), np.zeros((0, 3)))
    assert empty.with_bare(others, lambda x: x[:, 1] < 0.5) is empty


def test_light_from_behind_is_told_by_the_neck(ball: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """One photo labels its side of the ball as the face; the other side is skin that no photo labels. Where the head is
    known, the normals of both enter the correction, and without it that side alone."""
    asked: list[F64] = []
    monkeypatch.setattr(skin_light, "correction", lambda a, e, n, even, around: asked.append(n))
    view, rays = ball.views[0], ball.pixels.draw(8_000, 0.0, 3).rays
    to_camera = view.world_from_cam[:3, 3] / np.linalg.norm(view.world_from_cam[:3, 3])
    for near in (None, lambda x: np.full(len(x), True)):
        assert correct_light(ball.model, [replace(view, skin=view.alpha > 0.99)], rays, None, "cpu", near) is None
    assert (asked[0] @ to_camera).min() > 0 and (asked[1] @ to_camera).min() < -0.9


def test_what_evens_the_neck_but_not_the_face_is_left_out(ball: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """All skin has a slope that the correction evens; the face is even, and would get one."""
    n = np.random.default_rng(4).normal(size=(6000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    change = np.zeros((9, 3))
    change[1] = 0.5  # from above
    model = ball.model
    with torch.no_grad():
        before = model.light.irradiance(torch.from_numpy(n).float()).double().numpy()
    sloped = KAPPA * (before + irradiance_basis(n) @ change) / before
    face_alone, others = points(model, n[:2000], np.tile(KAPPA, (2000, 1))), points(model, n, sloped)
    views, rays = [replace(v, skin=v.alpha > 0.99) for v in ball.views], ball.pixels.draw(100, 0.0, 3).rays
    monkeypatch.setattr(skin_light, "correction", lambda a, e, n, even, around: SkinLight(change, np.ones(3)))
    monkeypatch.setattr(Skin, "of", classmethod(lambda cls, *given: face_alone))
    monkeypatch.setattr(Skin, "with_bare", lambda self, other, near: others)
    asked = correct_light(model, views, rays, None, "cpu", lambda x: np.full(len(x), True))
    assert asked is not None and not asked.changed
    assert float(asked.facts["skin_uneven_corrected"]) < 0.1 * float(asked.facts["skin_uneven"])
    assert float(asked.facts["face_uneven_corrected"]) > float(asked.facts["face_uneven"])


@pytest.mark.parametrize("gain", [1e-3, 1.0, 1e3])
def test_unevenness_is_the_spread_of_the_logarithm_and_ignores_lips(gain: float) -> None:
    rng = np.random.default_rng(2)
    skin = gain * np.exp(0.2 * rng.normal(size=(4000, 1))) * KAPPA
    assert unevenness(skin) == pytest.approx(0.2, rel=0.05)
    skin[:200] *= 0.01
    assert unevenness(skin) == pytest.approx(0.2, rel=0.15)
    assert unevenness(np.tile(KAPPA, (9, 1))) == 0 and np.isfinite(unevenness(np.zeros((9, 3))))


@pytest.mark.parametrize(("explained", "wanted"), [(0.45, 0.02), (0.25, 0.29), (0.1, 0.3), (None, 0.3)])
def test_light_from_above_is_free_only_where_the_lobe_did_not_tell_it(
    ball: Trainer, monkeypatch: pytest.MonkeyPatch, explained: float | None, wanted: float
) -> None:
    """The numbers of the heads beside the constant."""
    asked: list[float] = []
    monkeypatch.setattr(skin_light, "correction", lambda a, e, n, even, around: asked.append(even))
    views = [replace(v, skin=v.alpha > 0.99) for v in ball.views]
    assert correct_light(ball.model, views, ball.pixels.draw(100, 0.0, 3).rays, explained, "cpu") is None
    assert asked == pytest.approx([wanted], abs=0.003)


def test_noise_counts_as_that_of_fifty_places() -> None:
    """Against the posterior mean of a linear model with noise of a known deviation: a skin's spots are no 4,000
    independent observations, so that a strong pattern is drawn towards the prior."""
    n, rng, a = face(), np.random.default_rng(5), 0.8
    rows = irradiance_basis(n)
    rows[:, 0] = 1
    true = np.array([1.0, 0, 0, 0.3, 0, 0, 0, 0, 0])
    y = rows @ true + a * rng.uniform(-1, 1, len(n))
    found = correction(np.repeat(y[:, None], 3, 1), np.ones((len(n), 3)), n, EVEN_STD, BRIGHT)
    std = np.array([10.0, 0.3, 0.3, 0.5, 0.5, 0.3, 0.3, 0.5, 0.3])  # xy, xz and x are odd
    weight = 50 / len(n) / (1.4826 * a / 2) ** 2
    y = y / np.median(y)
    best = np.linalg.solve(weight * rows.T @ rows + np.diag(std**-2), weight * rows.T @ y)
    free = np.linalg.lstsq(rows, y, rcond=None)[0]
    assert found is not None
    np.testing.assert_allclose(found.change[1:, 0], best[1:] / best[0], atol=0.012)
    assert abs(best[3] / best[0] - free[3] / free[0]) > 0.03


def test_the_fitted_light_may_have_sides_of_its_own() -> None:
    """E' = E + E_0 sum b A Y is exact for lights of one mean radiance, however uneven the fitted one is."""
    n = face()
    seen = of_three(WHITE + 0.8 * WINDOW, WHITE + 0.5 * WINDOW, WHITE - 0.4 * WINDOW)
    true = of_three(WHITE - 0.5 * WINDOW, WHITE + WINDOW, WHITE + 0.3 * WINDOW)
    found = correction(*fitted(n, true, seen), n, EVEN_STD, around(seen))
    assert found is not None and (found.explained > 0.99).all()
    np.testing.assert_allclose(found.change[1:], (true - seen)[1:], atol=0.05)


@pytest.mark.parametrize("size", [0.5, -0.5])
def test_the_faces_mean_irradiance_stays(size: float) -> None:
    """Light from the front makes a face brighter and dimmer as a whole; its albedo's level must not follow."""
    n = torch.from_numpy(face()).float()
    light, change = ShLight(4, 1.0), np.zeros((9, 3))
    change[2] = size  # z
    before = light.irradiance(n).detach()
    skin_light._apply(light, SkinLight(change, np.ones(3)), n, before)
    after = light.irradiance(n).detach()
    assert float(after.mean()) == pytest.approx(float(before.mean()), rel=1e-5)
    assert float(after.std()) > 0.02 * float(after.mean())
