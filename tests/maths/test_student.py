"""Student's t weights against the density of scipy, and at the ends of their range."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pipeline.maths.student import student_weight


@pytest.mark.parametrize("nu", [0.5, 1.5, 4.0, 30.0])
def test_it_is_the_score_of_the_density_over_the_residual(nu: float) -> None:
    """-(d/dr ln p(r)) / r, the slope by differences of scipy's logarithm of the density."""
    r = np.array([1.0, 1.3, 2.0, 5.0, 20.0])
    step = 1e-5 * r
    slope = (stats.t.logpdf(r + step, nu) - stats.t.logpdf(r - step, nu)) / (2 * step)
    np.testing.assert_allclose(student_weight(r, nu), -slope / r, rtol=1e-7)


def test_the_ends() -> None:
    r = np.array([0.0, 1.0, np.inf, 1e200, 1e-300])
    np.testing.assert_allclose(student_weight(r, 4.0), [1, 1, 0, 0, 1], rtol=0, atol=1e-298)
    assert np.all(np.diff(student_weight(np.linspace(0, 50, 400), 1.5)) <= 0)


def test_fewer_degrees_of_freedom_hold_more_against_a_residual() -> None:
    each = student_weight(np.full(3, 3.0), np.array([1.5, 4.0, 1e9]))
    np.testing.assert_allclose(each, [2.5 / 10.5, 5 / 13, 1.0], rtol=1e-6)
