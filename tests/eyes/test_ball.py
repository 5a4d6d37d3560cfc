"""The ball of an eye, its cornea, and its axes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.eyes.ball import CORNEA, IRIS, RADIUS, Eye, cornea_height, sphere_on, turned

CENTRE = np.array([0.03, 0.01, 0.06])


def patch(radius: float, count: int = 400, noise: float = 0.0) -> np.ndarray:
    """Places on a ball about CENTRE that lids 30 degrees apart show."""
    random = np.random.default_rng(0)
    a, b = random.uniform(-0.9, 0.9, count), random.uniform(-0.3, 0.3, count)
    away = np.stack([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)], 1)
    return CENTRE + (radius + random.normal(0, noise, (count, 1))) * away


@pytest.mark.parametrize("shift", [(0, 0, 0), (0.001, -0.001, 0.002)])
def test_the_ball_lies_on_what_the_lids_show(shift: tuple[float, float, float]) -> None:
    points = patch(0.0123, noise=1e-4)
    centre, radius = sphere_on(points, np.ones(len(points)), CENTRE + shift, RADIUS)
    assert abs(radius - 0.0123) < 5e-4 and np.linalg.norm(centre - CENTRE) < 8e-4
    off = np.linalg.norm(points - centre, axis=1) - radius
    assert np.abs(off).mean() < 1.5e-4


def test_skin_that_was_taken_for_the_eye_hardly_counts() -> None:
    points = np.concatenate([patch(RADIUS), patch(RADIUS + 0.002, 60)])
    centre, radius = sphere_on(points, np.ones(len(points)), CENTRE, RADIUS)
    assert np.linalg.norm(centre - CENTRE) + abs(radius - RADIUS) < 4e-4


def test_without_evidence_the_eye_stays_where_the_skin_puts_it() -> None:
    for points in (np.zeros((0, 3)), patch(0.013, 10)):
        centre, radius = sphere_on(points, np.ones(len(points)), CENTRE, RADIUS)
        assert (centre == CENTRE).all() and radius == RADIUS


def test_a_ball_in_another_unit_is_as_much_larger() -> None:
    points = 50 * patch(0.0123)
    centre, radius = sphere_on(points, np.ones(len(points)), 50 * CENTRE, 50 * RADIUS, 50.0)
    one, r = sphere_on(patch(0.0123), np.ones(len(points)), CENTRE, RADIUS)
    np.testing.assert_allclose([*centre, radius], 50 * np.array([*one, r]), rtol=1e-9)


def test_the_cornea_is_a_sphere_that_meets_the_ball_at_the_iris() -> None:
    limbus = np.arcsin(IRIS / RADIUS)
    t = np.linspace(0, np.pi, 1001)
    far = RADIUS + cornea_height(t, RADIUS, IRIS, CORNEA)
    place = np.stack([far * np.sin(t), far * np.cos(t)], 1)
    z = np.sqrt(RADIUS**2 - IRIS**2) - np.sqrt(CORNEA**2 - IRIS**2)
    inside = t < limbus
    np.testing.assert_allclose(np.linalg.norm(place[inside] - [0, z], axis=1), CORNEA, atol=1e-12)
    assert (far[~inside] == RADIUS).all()
    assert cornea_height(np.array([limbus - 1e-9]), RADIUS, IRIS, CORNEA)[0] == pytest.approx(0, abs=1e-9)
    assert 0.0009 < far[0] - RADIUS < 0.0014  # textbooks: about a millimetre


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.4, 1.5])
def test_axes_turn_the_shortest_way(angle: float) -> None:
    start = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    step = Rotation.from_rotvec(angle * start[0])
    gaze = step.apply(start[2])
    np.testing.assert_allclose(turned(start, gaze), step.apply(start), atol=1e-12)


def test_directions_of_the_eye_s_own_frame() -> None:
    axes = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    eye = Eye(CENTRE, 0.012, axes, 0.006)
    own = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    np.testing.assert_allclose(eye.points(own)[0], CENTRE + 0.012 * axes[2])
    np.testing.assert_allclose(eye.local(eye.points(own)), own, atol=1e-12)
