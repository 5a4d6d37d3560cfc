"""Where the light stands still, on photos of a ball whose light is known; and a fit under a flash."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support.small_ball import RADIUS, SIDE, SMALL, ball_start, ball_view, hooks

from pipeline import transforms
from pipeline.colour import srgb_from_linear
from pipeline.maths import sh
from pipeline.maths.light_frame import CAMERA, FLASH, TURNTABLE, WORLD, level_axes
from stages.inverse_rendering import moving_light
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.moving_light import LAMPS, chosen_frame, decide, first_light, light_frame
from stages.inverse_rendering.outputs import predict_view
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.training_loop import run_fit

ABOVE = np.array([0.2, -0.3, -1.0])  # towards a lamp, in the camera's axes: above the lens, a little to the right
UNSEEN = 11
ROOM = np.array([0.5, 0.7, 0.5])  # towards a lamp in the room


def albedo_at(n: np.ndarray) -> np.ndarray:
    """(N, 3) patches that no light of low order explains."""
    checks = np.sign(np.sin(9 * n[:, 0] + 1) * np.sin(8 * n[:, 1]) * np.sin(7 * n[:, 2] + 2))
    return np.where(checks[:, None] > 0, [[0.6, 0.4, 0.3]], [[0.3, 0.35, 0.4]])


def unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


Arrives = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def still(n: np.ndarray, x: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return 0.3 + 0.7 * np.maximum(n @ unit(ROOM), 0)


def turning(n: np.ndarray, x: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return 0.3 + 0.7 * np.maximum(n @ (pose[:3, :3] @ unit(np.array([0.8, -0.6, -0.4]))), 0)


def on_a_turntable(n: np.ndarray, x: np.ndarray, pose: np.ndarray) -> np.ndarray:
    frame = level_axes(torch.from_numpy(pose[None, :3, :3].copy()))[0].numpy()
    return 0.3 + 0.7 * np.maximum(n @ (frame @ unit(np.array([0.8, -0.6, -0.4]))), 0)


def flash(n: np.ndarray, x: np.ndarray, pose: np.ndarray) -> np.ndarray:
    lamp = pose[:3, 3] + 0.05 * pose[:3, :3] @ np.array([0, -1, 0])
    away = lamp - x
    return np.maximum((n * unit(away)).sum(1), 0) * 0.25 / (away**2).sum(1)


def photo(index: float, arrives: Arrives, gain: float = 1.0) -> PhotoView:
    """The ball of small_ball with other colours: pi times its radiance is albedo times what arrives."""
    view = ball_view(index)  # type: ignore[arg-type]  (in between as well)
    o, d = transforms.rays(view.K, view.world_from_cam, np.zeros(5), transforms.pixel_centres(SIDE, SIDE))
    b = d @ o
    under = b * b - (o @ o - RADIUS**2)
    p = o + (-b - np.sqrt(under.clip(0)))[:, None] * d
    n = unit(p)
    rgb = gain * albedo_at(n) * arrives(n, p, view.world_from_cam)[:, None]
    rgb = np.where((under > 0)[:, None], rgb, 0).reshape(SIDE, SIDE, 3)
    return replace(view, rgb=rgb.astype(np.float32))


def photos(arrives: Arrives, gain: Callable[[int], float] = lambda i: 1.0) -> list[PhotoView]:
    return [replace(photo(i / 2, arrives, gain(i)), index=i) for i in range(24) if i != UNSEEN]


def found(views: list[PhotoView], wanted: str = "auto", flashed: float = 0.0) -> Any:
    return light_frame(views, ball_start(RADIUS), wanted, "cpu", flashed)


@pytest.mark.parametrize("gain", [lambda i: 1.0, lambda i: 1.4 ** ((-1) ** i)], ids=["one exposure", "auto exposure"])
@pytest.mark.parametrize(
    "arrives, frame", [(still, WORLD), (on_a_turntable, TURNTABLE), (turning, CAMERA), (flash, FLASH)]
)
def test_the_light_s_frame_is_found(arrives: Arrives, frame: str, gain: Callable[[int], float]) -> None:
    result = found(photos(arrives, gain))
    assert result.frame == frame and result.why == "cross-validation"
    # a ball of one round hardly tells a still light's nearest rivals apart; the others are far behind
    assert result.errors[frame] < 1.1 * min(result.errors.values())
    assert result.facts()["frame"] == frame
    assert (result.flux is None) == (frame == WORLD)
    gains = [gain(i) for i in range(24)]
    # the light is no exposure: photos of one exposure have one gain under any light
    assert result.spread == pytest.approx(np.std(gains) / np.mean(gains), abs=0.09)


def test_a_lamp_above_the_lens_is_found_there() -> None:
    flux = found(photos(flash)).flux
    towards = unit(flux @ sh.spiral(LAMPS))
    assert towards[2] < -0.9 and (flux >= 0).all()


def test_metadata_lower_the_threshold_but_do_not_decide_alone() -> None:
    """A flash that brightens nothing, as on photos of a bright day, is not the light."""
    assert found(photos(still), flashed=1.0).frame == WORLD
    views = photos(still)
    seen_dim = [replace(v, rgb=0.5 * v.rgb + 0.5 * w.rgb) for v, w in zip(views, photos(flash), strict=True)]
    plain, told = (found(seen_dim, flashed=f) for f in (0.0, 1.0))
    assert plain.errors == told.errors
    assert plain.frame == chosen_frame(plain.errors, flashed=False)[0]
    assert told.frame == chosen_frame(told.errors, flashed=True)[0]


def test_what_the_metadata_are_worth() -> None:
    """A moving light must be clearly better, or at all where a flash fired."""
    errors = {WORLD: 1.0, TURNTABLE: 0.97, CAMERA: 0.95, FLASH: 0.9}
    assert chosen_frame(errors, flashed=False)[0] == WORLD and chosen_frame(errors, flashed=True)[0] == FLASH
    assert chosen_frame(errors | {CAMERA: 0.5}, flashed=False)[0] == CAMERA
    assert chosen_frame(errors | {CAMERA: 0.5, TURNTABLE: 0.51}, flashed=False)[0] == TURNTABLE  # the common case
    assert chosen_frame(errors | {WORLD: 0.8}, flashed=True)[0] == WORLD


def test_few_photos_stay_in_a_still_light_unless_the_metadata_say_flash() -> None:
    views = photos(flash)[:5]
    assert found(views).frame == WORLD and found(views).why == "too few views to compare"
    told = found(views, flashed=1.0)
    assert told.frame == FLASH and told.why == "metadata"
    assert first_light(told.flux, 4)[0] > 0


def test_the_setting_decides() -> None:
    views = photos(still)
    assert found(views, CAMERA).frame == CAMERA and found(views, CAMERA).why == "setting"
    assert found(photos(flash), WORLD).frame == WORLD


def test_the_first_light_has_the_lamps_irradiance() -> None:
    """Against the sum of the lamps' cosines, and for a uniform light."""
    flux = np.maximum(sh.spiral(LAMPS) @ unit(ABOVE), 0) ** 2
    flux /= flux.sum()
    n = sh.spiral(40)
    expected = np.pi * np.maximum(n @ sh.spiral(LAMPS).T, 0) @ flux
    got = sh.irradiance(*(torch.from_numpy(a) for a in (np.repeat(first_light(flux, 6)[:, None], 3, 1), n))).numpy()[
        :, 0
    ]
    assert np.abs(got - expected).max() < 0.06 * expected.max()
    even = first_light(np.ones(LAMPS) / LAMPS, 2)
    assert np.abs(even[1:]).max() < 0.02 * even[0]
    assert len(first_light(flux, 0)) == 1


def test_nothing_to_see() -> None:
    views = [replace(v, alpha=0 * v.alpha) for v in photos(flash)]
    result = found(views)
    assert result.frame == WORLD and "error_world" not in result.facts()
    none = decide(*_no_observations(), "auto", 1.0)
    assert none.frame == FLASH and np.isfinite(none.distance)


def _no_observations() -> tuple[Any, list[PhotoView]]:
    from stages.inverse_rendering.observations import Observations

    empty, views = np.zeros((0, 3)), photos(flash)[:1]
    none = np.zeros(0, np.int64)
    return Observations(torch.zeros(0, 3), torch.zeros(0, 3), none, none, empty, empty), views


def test_light_from_behind_costs_and_light_from_the_camera_does_not() -> None:
    """Against the mean of the squares over a lat-long picture; a lamp at the lens rings, and costs a hundredth."""
    from pipeline.maths.latlong import latlong_directions, latlong_weights
    from stages.inverse_rendering.objective import BEHIND, hidden_light

    degree = np.sqrt(np.arange(121)).astype(int)
    cost = {}
    for name, d in (("behind", [0.2, 0.1, 1.0]), ("lens", [0.0, -0.2, -1.0])):
        at = torch.from_numpy(unit(np.array([d])))
        c = sh.sh_basis(at, 10).T * torch.from_numpy(np.exp(-degree * (degree + 1) / 40))[:, None]
        c = c.expand(121, 3).contiguous().requires_grad_()
        cost[name] = float(hidden_light(c.detach(), 2.0))
        w = latlong_directions(128, 64)
        weights = np.broadcast_to(latlong_weights(128, 64), w.shape[:2]) * (w[..., 2] > BEHIND)
        values = sh.radiance(c.detach(), torch.from_numpy(w.reshape(-1, 3))).numpy()[:, 0].reshape(w.shape[:2])
        assert cost[name] == pytest.approx((weights * values**2).sum() / weights.sum() / 4, rel=0.03, abs=1e-6)
        (gradient,) = torch.autograd.grad(hidden_light(c, 2.0), c)
        assert gradient.isfinite().all()
    assert cost["lens"] < 0.01 * cost["behind"]
    assert float(hidden_light(torch.zeros(1, 3), 0.0)) == 0


@pytest.mark.slow
def test_a_fit_under_a_flash_predicts_a_photo_that_it_did_not_see() -> None:
    views, unseen = photos(flash), photo(UNSEEN / 2, flash)
    psnr = {}
    for frame in ("auto", WORLD):
        lit = light_frame(views, ball_start(RADIUS), frame, "cpu")
        t = new_trainer(views, ball_start(), SMALL.changed(shadows=False), False, "cpu", lit=lit)
        model = run_fit(t, hooks())
        shown = predict_view(model, unseen, 1, 8, "cpu")[..., :3]
        inside = unseen.alpha > 0.99
        error = (srgb_from_linear(shown.clip(0, 1)) - srgb_from_linear(unseen.rgb))[inside]
        psnr[frame] = -10 * np.log10((error**2).mean())
    assert psnr["auto"] > psnr[WORLD] + 4 and psnr["auto"] > 27
    assert model.spec.light_frame == WORLD


def test_a_flash_says_nothing_of_a_turntable() -> None:
    errors = {WORLD: 1.0, TURNTABLE: 0.9, CAMERA: 0.97, FLASH: 0.95}
    assert chosen_frame(errors, flashed=True)[0] == WORLD
    assert chosen_frame(errors | {TURNTABLE: 0.7}, flashed=True)[0] == TURNTABLE


def test_errors_are_those_of_points_that_had_no_vote() -> None:
    """Every second point of the views without a vote gives their gain, the others the error: .1 of the mean here."""
    from stages.inverse_rendering.observations import Observations

    point, view = (a.ravel() for a in np.meshgrid(np.arange(240), np.arange(12), indexing="ij"))
    colour = np.repeat(np.random.default_rng(0).uniform(0.5, 1.5, 240)[point, None], 3, 1)
    n = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(240, 3))))
    seen = Observations(n, n, point, view, colour, np.zeros((len(point), 3)))
    parts = moving_light._divided(seen)
    assert not (parts.train & parts.test).any() and not (parts.tune & parts.test).any()
    lit = np.ones((len(point), 1))
    assert moving_light._solve(seen, parts, lit).error < 1e-6
    wrong = replace(seen, colour=colour + 0.1 * parts.test[:, None])
    assert moving_light._solve(wrong, parts, lit).error == pytest.approx(0.1 / wrong.colour.mean(), rel=1e-6)


def test_a_flash_falls_off_with_the_square_of_the_distance() -> None:
    """A camera at the origin looks along +z at two places that face it, at 1 and at 2 metres."""
    from stages.inverse_rendering.observations import Observations

    one, toward = np.arange(2), np.array([[0.0, 0, -1], [0, 0, -1]])
    x = torch.tensor([[0.0, 0, 1], [0, 0, 2]])
    seen = Observations(x, torch.from_numpy(toward), one, np.zeros(2, np.int64), np.ones((2, 3)), toward)
    view: Any = type("V", (), {"world_from_cam": np.eye(4)})()
    stations, distance = moving_light._stations(seen, [view])
    lit = {f: moving_light._lit(f, seen, stations, distance) for f in (WORLD, CAMERA, FLASH)}
    np.testing.assert_allclose(lit[FLASH][0], 4 * lit[FLASH][1], rtol=1e-9)
    np.testing.assert_allclose(lit[CAMERA][0], lit[CAMERA][1], rtol=1e-9)
    assert lit[WORLD].shape == (2, 1) and (lit[FLASH] > 0).any()
