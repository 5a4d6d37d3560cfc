"""The mean F0 of a group from that of the regression: what is usual, and what a dielectric has at least."""

from __future__ import annotations

import numpy as np
import pytest

from stages.bake import standard_fit as fits


def test_the_mean_f0_of_skin_is_as_usual_unless_photos_tell() -> None:
    assert fits.drawn(0.02, 0.028, 0.0) == pytest.approx(0.028)
    assert fits.drawn(0.02, 0.028, 1.0) == pytest.approx(0.02)
    shares = [fits.drawn(0.02, 0.028, e) for e in (0.1, 0.3, 0.6, 0.9)]
    assert shares == sorted(shares, reverse=True) and shares[1] == pytest.approx(0.0243, abs=2e-4)


@pytest.mark.parametrize("best", [-2.0, -0.3, -0.01, 0.0, 0.004, 0.019, 0.3])
@pytest.mark.parametrize("free", [1e-8, 1e-4, 1.0])
def test_an_f0_is_raised_as_far_as_photos_allow(best: float, free: float) -> None:
    """Against a search: the largest F0 up to LEAST_F0 whose error is at most `free` above that of the regression's."""
    fitted, steps = max(best, 0.0), np.linspace(0, fits.LEAST_F0, 2_000_001)
    allowed = steps[(steps - best) ** 2 <= (fitted - best) ** 2 + free]
    wanted = max(fitted, allowed.max(initial=0.0))
    assert fits.at_least(fitted, best, free) == pytest.approx(wanted, abs=1e-7)


@pytest.mark.parametrize("fitted", [0.0, 0.003, 0.02, 0.5])
def test_an_f0_that_photos_exclude_stays(fitted: float) -> None:
    assert fits.at_least(fitted, fitted, 0.0) == fitted
    if fitted == 0:
        assert fits.at_least(fitted, -1e9, 0.0) == 0
        assert fits.at_least(fitted, -1e9, 1e-9) == 0  # lost to rounding
