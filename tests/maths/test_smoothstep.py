"""The smooth step: its ends, its middle, its slopes, and values far outside."""

from __future__ import annotations

import numpy as np

from pipeline.maths.smoothstep import smoothstep


def test_ends_middle_and_slopes() -> None:
    x = np.array([-np.inf, 1.0, 2.0, 1.5, 3.0, np.inf])
    np.testing.assert_array_equal(smoothstep(x, 1.0, 2.0), [0, 0, 1, 0.5, 1, 1])
    near = np.array([1.0, 1.5, 2.0])
    slope = (smoothstep(near + 1e-6, 1.0, 2.0) - smoothstep(near - 1e-6, 1.0, 2.0)) / 2e-6
    np.testing.assert_allclose(slope, [0, 1.5, 0], atol=1e-5)
    assert (np.diff(smoothstep(np.linspace(0, 3, 100), 1.0, 2.0)) >= 0).all()


def test_ends_of_each_value() -> None:
    found = smoothstep(np.full(3, 0.5), np.array([0.0, 0.5, 0.4]), np.array([1.0, 1.0, 0.5]))
    np.testing.assert_allclose(found, [0.5, 0, 1])
