"""The picture of an eye from photos, and the iris in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.eyes.ball import Eye, turned
from pipeline.eyes.fit import FittedBall, fitted_eyes, paired
from pipeline.eyes.iris import LEAST_SCORE, find_iris
from pipeline.eyes.picture import (
    REACH,
    directions_at,
    looked_up,
    places_of,
    plane,
    quantile,
    shown_between_lids,
    sights,
)
from pipeline.registration.scan import Scan
from pipeline.visibility import Occluder
from tests.support.ball_head import ball_scan
from tests.support.eyes import IRIS, PUPIL, WHITE, gaze_to, photographed, slit

AHEAD = np.eye(3)
EYE = Eye(np.array([0.0, 0.0, 0.0]), 0.012, turned(AHEAD, gaze_to(8, -5)), 0.0059)
VIEWS = [(a, e) for e in (-8, 8) for a in (-35, -15, 0, 15, 35)]


def test_places_and_directions_are_each_other_s_inverse() -> None:
    places = plane(40).reshape(-1, 2)
    directions = directions_at(places)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(places_of(directions), places, atol=1e-12)
    np.testing.assert_allclose(np.arccos(directions[:, 2]), np.linalg.norm(places, axis=1), atol=1e-9)
    assert (places_of(np.array([[0.0, 0.0, 1.0]])) == 0).all()


def test_a_picture_is_read_between_its_pixels_and_at_its_border() -> None:
    image = (plane(50) * 2 + 1).astype(np.float32)
    places = np.random.default_rng(0).uniform(-0.95 * REACH, 0.95 * REACH, (100, 2))
    np.testing.assert_allclose(looked_up(image, places), places * 2 + 1, atol=1e-5)
    far = looked_up(image, np.array([[9.0, -9.0]]))
    np.testing.assert_allclose(far[0], image[-1, -1], atol=1e-6)


def test_the_quantile_is_the_weighted_one() -> None:
    random = np.random.default_rng(0)
    values = random.random((9, 50, 3)).astype(np.float32)
    equal = quantile(values, np.ones((9, 50), np.float32), 0.35)
    np.testing.assert_allclose(equal, np.sort(values, 0)[3])  # the fourth of nine reaches 35 %
    weights = np.zeros((9, 50), np.float32)
    weights[4] = 1
    np.testing.assert_allclose(quantile(values, weights, 0.35), values[4])
    assert (quantile(values, 0 * weights, 0.35) == 0).all() and quantile(values[:0], weights[:0], 0.5).shape == (50, 3)


def drawn(gaze: np.ndarray, angle: float, opening: float, white: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """A picture of an iris between lids `opening` radians apart, and what is seen of it."""
    places = plane(160)
    away = np.arccos(np.clip(directions_at(places) @ gaze, -1, 1))
    image = np.where(away < angle, 0.15, white)[..., None] * np.ones(3)
    seen = (np.abs(places[..., 1]) < opening / 2) & (np.abs(places[..., 0]) < 0.95)
    image = image + np.random.default_rng(0).normal(0, 0.02, image.shape)
    return image.astype(np.float32), seen.astype(np.float32)


@pytest.mark.parametrize("left", [-20, 0, 15])
@pytest.mark.parametrize("size", [0.92, 1.0, 1.08])
def test_the_iris_is_found_between_lids_that_hide_a_part_of_it(left: float, size: float) -> None:
    usual = 0.51
    found = find_iris(*drawn(gaze_to(left, -4), size * usual, 0.75), usual)
    assert found.found
    off = np.degrees(np.arccos(found.gaze @ gaze_to(left, -4)))
    assert off < 2.0 and found.angle == pytest.approx(size * usual, rel=0.05)


def test_skin_has_no_iris() -> None:
    image, seen = drawn(gaze_to(0, 0), 0.5, 0.8, white=0.15)
    assert not find_iris(image, seen, 0.5).found
    assert find_iris(image, 0 * seen, 0.5).score == 0 and find_iris(0 * image, seen, 0.5).score == 0


def test_photos_give_the_colours_without_the_lamp(tmp_path: Path) -> None:
    views = photographed(EYE, tmp_path, VIEWS)
    seen = sights(EYE, views, Occluder(slit(EYE)), 96)
    assert np.array_equal(shown_between_lids(EYE, views, Occluder(slit(EYE)), 96), seen.shown())
    colour, weight = seen.combined()
    angle = np.arccos(directions_at(plane(96))[..., 2])
    limbus = np.arcsin(EYE.iris / EYE.radius)
    for low, high, wanted in ((0, 0.33, PUPIL), (0.5, 0.85, IRIS), (1.15, 1.6, WHITE)):
        own = (weight > 0) & (angle > low * limbus) & (angle < high * limbus)
        assert own.sum() > 20
        np.testing.assert_allclose(colour[own], np.broadcast_to(wanted, (own.sum(), 3)), atol=0.03)
    height = EYE.points(directions_at(plane(96)))[..., 1]
    assert not weight[np.abs(height) > 0.008].any() and weight[np.abs(height) < 0.003].any()
    assert seen.pixels.max() == pytest.approx(900 / 0.3, rel=0.05)
    assert seen.colour.max() > 0.95 and colour.max() < 0.7  # the reflection was in the photos


def ball_of(eye: Eye) -> np.ndarray:
    """The template's eye, too large, behind the same lids."""
    return ball_scan(1.25 * eye.radius, 6).vertices.astype(np.float64) + eye.centre + [0, 0, -0.0035]


def fit(eyes: dict[str, Eye], folder: Path, distance: float = 0.3, half: float = 0.0055) -> dict[str, FittedBall]:
    """The fit of eyes on one place, each with its own photos."""
    out = {}
    for name, eye in eyes.items():
        views = photographed(eye, folder, VIEWS, distance=distance, half=half)
        scan = ball_scan(eye.radius, 40)
        out |= fitted_eyes({name: ball_of(eye)}, AHEAD, Scan(scan, np.ones(len(scan.vertices))), views,
                           Occluder(slit(eye, half)), 1.0)  # fmt: skip
    return out


def test_ball_iris_and_gaze_are_those_of_the_photos(tmp_path: Path) -> None:
    found = fit({"eye_left": EYE}, tmp_path)["eye_left"]
    assert found.reason == "" and found.score > LEAST_SCORE and found.off < 2e-4
    assert np.linalg.norm(found.eye.centre - EYE.centre) < 4e-4
    assert np.degrees(np.arccos(found.eye.axes[2] @ EYE.axes[2])) < 2
    assert found.eye.iris == pytest.approx(EYE.iris, rel=0.05) and found.pixels == pytest.approx(35, rel=0.1)


def test_eyes_of_few_pixels_stay_the_template_s(tmp_path: Path) -> None:
    found = fit({"eye_left": EYE}, tmp_path, distance=2.2)["eye_left"]
    assert "pixels across" in found.reason and found.pixels < 6


def test_closed_lids_show_no_iris(tmp_path: Path) -> None:
    found = fit({"eye_left": EYE}, tmp_path, half=-1e-4)["eye_left"]
    assert found.reason


def test_gazes_that_are_no_pair_are_refused(tmp_path: Path) -> None:
    """One ball whose photos show an iris to the left beside one whose photos show it to the right."""
    found = {}
    for name, left in (("eye_left", 12), ("eye_right", -14), ("other", 10)):
        (tmp_path / name).mkdir()
        found |= fit({name: replace(EYE, axes=turned(AHEAD, gaze_to(left, 0)))}, tmp_path / name)
    assert not any(f.reason for f in found.values())
    crossed = paired({n: found[n] for n in ("eye_left", "eye_right")})
    assert all("26 degrees apart" in f.reason for f in crossed.values())
    alike = paired({n: found[n] for n in ("eye_left", "other")})
    assert not any(f.reason for f in alike.values()) and len({f.eye.iris for f in alike.values()}) == 1
    large = replace(found["other"], eye=replace(EYE, iris=1.3 * EYE.iris))
    assert all("irises differ" in f.reason for f in paired({"eye_left": found["eye_left"], "other": large}).values())
