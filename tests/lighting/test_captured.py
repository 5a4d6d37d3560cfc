"""The picture of the captured light: it has what photos show, and the subject's irradiance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.lighting.captured import captured_environment, irradiance_error
from pipeline.lighting.dome import environment, light_from_environment
from pipeline.lighting.surroundings import REACH, Surroundings
from pipeline.maths.latlong import latlong_directions, latlong_weights

H, W = 64, 128
D = latlong_directions(W, H)
SOLID = np.broadcast_to(latlong_weights(W, H), (H, W))
BEHIND = np.array([0, 0, -1.0])


def lamp(where: tuple[float, float, float], degrees: float) -> np.ndarray:
    """(H, W) 1 within an angle of a direction."""
    return (D @ (np.array(where) / np.linalg.norm(where)) > np.cos(np.radians(degrees))).astype(float)


def room(window: float = 0.0) -> np.ndarray:
    """(H, W, 3) walls, a lamp at the front that no photo shows, and a window at the back."""
    walls = np.stack([0.2 + 0.05 * D[..., 0], 0.2 + 0.05 * D[..., 1], 0.18 + 0 * D[..., 0]], -1)
    return walls + 6 * lamp((0.3, 0.6, 1), 15)[..., None] + window * lamp((0.4, 0.1, -1), 12)[..., None]


def irradiance(picture: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(N, 3) by quadrature."""
    cosine = np.maximum(normals @ D.reshape(-1, 3).T, 0) * SOLID.reshape(-1)
    return cosine @ picture.reshape(-1, 3)


def around(truth: np.ndarray, clip: float = 1.0, seen_from: float = 60.0) -> Surroundings:
    """Photos of the front show the back up to `seen_from` degrees from its middle, and are clipped at `clip`."""
    away = np.maximum(np.arccos((D @ BEHIND).clip(-1, 1)) - np.radians(seen_from), 0)
    clipped = (truth.max(-1) > clip) & (away < REACH[1])
    facing = np.maximum(D @ -BEHIND, 0)
    parts = truth.clip(max=clip), away, clipped, facing
    return Surroundings(*(x.astype(np.float32) for x in parts))


def seen_normals() -> np.ndarray:
    n = D[::4, ::4].reshape(-1, 3)
    return n[n @ -BEHIND > 0.2]


def test_without_surroundings_it_is_the_picture_of_the_harmonics() -> None:
    light = light_from_environment(room().astype(np.float32))
    np.testing.assert_array_equal(captured_environment(light, W, None), environment(light, W))


def test_it_shows_what_photos_show_and_keeps_the_irradiance_of_what_they_see() -> None:
    truth = room()
    light, shown = light_from_environment(truth.astype(np.float32)), around(truth)
    picture = captured_environment(light, W, shown)
    known = shown.share > 0.999
    np.testing.assert_allclose(picture[known], truth[known], rtol=1e-4, atol=1e-5)
    wanted, found = irradiance(truth, seen_normals()), irradiance(picture, seen_normals())
    assert np.abs(found - wanted).max() < 0.1 * wanted.mean()
    plain = environment(light, W)
    assert np.abs(plain[known] - truth[known]).mean() > 20 * np.abs(picture[known] - truth[known]).mean()
    assert irradiance_error(light, picture, shown) < 0.03


def test_light_that_was_made_up_behind_the_subject_is_not_believed() -> None:
    truth = room()
    wrong = truth + 2 * lamp((0, 0, -1), 40)[..., None]  # no surface that photos see receives it
    light, shown = light_from_environment(wrong.astype(np.float32)), around(truth)
    picture = captured_environment(light, W, shown)
    known = shown.share > 0.999
    np.testing.assert_allclose(picture[known], truth[known], rtol=1e-4, atol=1e-5)
    front = seen_normals()[seen_normals() @ -BEHIND > 0.7]
    assert np.abs(irradiance(picture, front) / irradiance(truth, front) - 1).max() < 0.08


@pytest.mark.parametrize("brightness", [3.0, 30.0])
def test_a_clipped_window_gets_the_brightness_that_the_subject_tells(brightness: float) -> None:
    truth = room(brightness)
    shown = replace(around(truth, seen_from=120), facing=np.ones((H, W), np.float32))
    light = light_from_environment(truth.astype(np.float32))
    picture, window = captured_environment(light, W, shown), lamp((0.4, 0.1, -1), 9) > 0
    assert picture[window].mean() == pytest.approx(brightness, rel=0.15)
    assert picture[window].min() > 0.99


def test_a_window_behind_thin_bars_is_as_bright() -> None:
    """Pixels of the sum of squares are coarser, and partly clipped."""
    truth = room()
    bars = lamp((0.4, 0.1, -1), 25) * (np.arange(W) % 2)
    truth = truth + 10 * bars[..., None]
    shown = replace(around(truth, seen_from=120), facing=np.ones((H, W), np.float32))
    picture = captured_environment(light_from_environment(truth.astype(np.float32)), W, shown)
    assert picture[bars > 0].mean() == pytest.approx(10, rel=0.15)


def test_surroundings_that_contradict_the_light_are_left_out() -> None:
    """All directions are known, and the subject received three times as much."""
    truth = room()
    shown = replace(around(truth), away=np.zeros((H, W), np.float32), clipped=np.zeros((H, W), np.float32))
    light = light_from_environment(3 * truth.astype(np.float32))
    np.testing.assert_array_equal(captured_environment(light, W, shown), environment(light, W))
    near = light_from_environment(1.1 * truth.clip(max=1).astype(np.float32))
    np.testing.assert_allclose(captured_environment(near, W, shown), truth.clip(max=1), atol=1e-5)


def test_colours_are_those_of_the_light() -> None:
    tint = np.array([1.0, 0.6, 0.3])
    truth = room() * tint
    picture = captured_environment(light_from_environment(truth.astype(np.float32)), W, around(truth))
    far = around(truth).away > np.radians(30)
    got = picture[far].mean(0) / picture[far].mean()
    np.testing.assert_allclose(got, truth[far].mean(0) / truth[far].mean(), rtol=0.05)


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_a_brighter_room_gives_a_brighter_picture(factor: float) -> None:
    truth = room()
    light, shown = light_from_environment(truth.astype(np.float32)), around(truth)
    one = captured_environment(light, W, shown)
    scaled = captured_environment(
        light * np.float32(factor), W, replace(shown, radiance=shown.radiance * np.float32(factor))
    )
    np.testing.assert_allclose(scaled / factor, one, rtol=1e-3, atol=1e-4)


def test_every_size_has_the_same_energy() -> None:
    truth = room(20)
    shown = around(truth, seen_from=100)
    light = light_from_environment(truth.astype(np.float32))
    energies = [
        (captured_environment(light, w, shown) * latlong_weights(w, w // 2)[..., None]).sum() for w in (64, 128, 512)
    ]
    np.testing.assert_allclose(energies, energies[1], rtol=0.02)


def test_extremes_stay_finite_and_nowhere_negative() -> None:
    truth = room()
    shown, light = around(truth), light_from_environment(truth.astype(np.float32))
    zero, one = np.zeros((H, W), np.float32), np.ones((H, W), np.float32)
    cases = {
        "one constant": (light[:1], shown),
        "all clipped": (light, replace(shown, clipped=one, away=zero)),
        "all known": (light, replace(shown, clipped=zero, away=zero)),
        "nothing known": (light, replace(shown, clipped=zero, away=np.full_like(zero, np.pi))),
        "black walls": (light, replace(shown, radiance=np.zeros_like(shown.radiance))),
        "no light": (np.zeros_like(light), shown),
        "negative light": (-light, shown),
        "a colour without light": (light * np.array([1, 1, 0], np.float32), shown),
    }
    for name, (given, known) in cases.items():
        picture = captured_environment(given.astype(np.float32), W, known)
        assert np.isfinite(picture).all() and picture.min() >= 0, name
