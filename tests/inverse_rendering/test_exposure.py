"""Whether photos differ in exposure, seen before anything is fitted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pipeline.transforms import F64
from stages.inverse_rendering.exposure import DRIFT, exposures_differ, gain_spread
from stages.inverse_rendering.initial_geometry import Start
from tests.support.balls import RADIUS, Ball, gloss, start


def automatic(by: float) -> Callable[[int], F64]:
    """Exposures that change from photo to photo, spread by about 0.7 `by`."""
    return lambda view: np.full(3, 1 + by * math.sin(7.1 * view))


@pytest.mark.parametrize("by", [0.02, 0.2, 0.7])
def test_the_spread_is_that_of_the_exposures(by: float) -> None:
    ball = Ball(gain=automatic(by))
    true = np.array([automatic(by)(v)[0] for v in range(ball.views)])
    assert gain_spread(ball.photos(), start(), "cpu") == pytest.approx(true.std() / true.mean(), rel=0.05, abs=0.002)


def test_exposures_differ_where_cameras_set_them() -> None:
    assert exposures_differ(Ball(gain=automatic(0.2)).photos(), start(), "cpu")
    assert exposures_differ(Ball(gloss(4), automatic(0.2)).photos(), start(), "cpu")


@pytest.mark.parametrize("ball", [Ball(), Ball(gloss(1, 0.03)), Ball(gloss(5, 0.03))])
def test_neither_shading_nor_the_shine_of_skin_is_exposure(ball: Ball) -> None:
    assert not exposures_differ(ball.photos(), start(), "cpu")


def test_a_start_that_is_off_tells_it_as_well() -> None:
    fat = start(RADIUS + 0.01)
    assert gain_spread(Ball().photos(), fat, "cpu") < DRIFT / 2
    assert gain_spread(Ball(gain=automatic(0.2)).photos(), fat, "cpu") == pytest.approx(0.14, abs=0.02)


def test_nothing_to_see_is_no_difference() -> None:
    nothing = Start(np.ones((8, 8, 8), np.float32), np.full(3, -0.1, np.float32), 0.03)
    assert gain_spread(Ball().photos(), nothing, "cpu") == 0
    assert gain_spread(Ball(views=2).photos(), start(), "cpu") == 0
    black = [replace(p, rgb=0 * p.rgb) for p in Ball().photos()]
    assert np.isfinite(gain_spread(black, start(), "cpu"))
