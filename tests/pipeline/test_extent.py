"""The part of a person that the asset is made of, as a solid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts import Cut, Extent
from pipeline.extent import BELOW, bounds, core, head_extent, signed, signed_and_gradient, within
from pipeline.faces.landmarks3d import head_frame
from pipeline.hull import Hull
from tests.support.faces import face


@pytest.mark.parametrize("degrees", [(0, 0, 0), (90, 0, 0), (20, -30, 10)])
def test_a_head_and_neck_are_inside_and_the_chest_is_not(degrees: tuple[float, float, float]) -> None:
    turn, shift = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), np.array([0.3, -1.0, 2.0])
    frame = head_frame(face() @ turn.T + shift)
    extent, h = head_extent(frame), frame.height
    left, up, front = frame.axes

    def at(x: float, y: float, z: float, start: np.ndarray) -> float:
        return float(signed(extent, (start + h * (x * left + y * up + z * front))[None])[0])

    assert np.isclose(signed(extent, np.array([extent.centre]))[0], -(BELOW + frame.axes[1] @ (
        np.asarray(extent.centre) - frame.chin) / h) * h)  # fmt: skip
    for inside in ((0, 0, 0), (0, -0.5, -0.2), (0.5, -0.55, -0.5), (0, 1.2, -0.4), (0, 0.6, -1.3)):
        assert at(*inside, frame.chin) < 0, inside
    for outside in ((0, -1.0, 0), (0, -1.0, -1), (1.8, 0.5, -0.5), (0, 0.5, 1.4), (0, 0.5, -2.2)):
        assert at(*outside, frame.chin) > 0, outside
    middle, radius = core(extent)
    ring = middle + radius * np.stack([left, -left, up, -up, front, -front])
    assert (signed(extent, ring) < 0).all()


def test_distances_and_gradients() -> None:
    down = Cut(normal=(0.0, -1.0, 0.0), offset=0.05)
    ball = Extent(centre=(0.1, 0, 0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), radii=(0.2,) * 3, cuts=(down,), head=0.18)
    assert signed(ball, np.array([[0.4, 0, 0], [0.1, -0.15, 0]])) == pytest.approx([0.1, 0.1])
    assert signed(ball, np.array([[0.4, 0, 0]]), 0.03) == pytest.approx([0.07])
    x = np.random.default_rng(0).uniform(-0.3, 0.4, (2000, 3))
    value, gradient = signed_and_gradient(ball, x)
    np.testing.assert_array_equal(value, signed(ball, x))
    step = 1e-6 * np.eye(3)
    numeric = np.stack([(signed(ball, x + s) - signed(ball, x - s)) / 2e-6 for s in step], 1)
    smooth = np.abs(np.linalg.norm(numeric, axis=1) - 1) < 1e-6
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(gradient[smooth], numeric[smooth], atol=1e-6)
    lo, hi = bounds(ball)
    inside = x[value < 0]
    assert len(inside) > 50 and (inside > lo).all() and (inside < hi).all()


def test_a_hull_is_cut_at_the_extent() -> None:
    level = np.full((40, 40, 40), -0.02, np.float32)
    hull = Hull(level <= 0, level, np.ones(level.shape, np.int16), np.full(3, -0.2), 0.01)
    ball = Extent(centre=(0, 0, 0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), radii=(0.12,) * 3, head=0.18)
    cut = within(hull, ball, 0.03)
    radius = np.linalg.norm(cut.centres(cut.level <= 0), axis=1)
    assert radius.max() == pytest.approx(0.15, abs=0.005)
    assert (cut.level <= 0).sum() * 0.01**3 == pytest.approx(4 / 3 * np.pi * 0.15**3, rel=0.02)
    assert not (cut.occupied & ~hull.occupied).any()
