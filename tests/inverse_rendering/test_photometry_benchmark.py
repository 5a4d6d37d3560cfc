"""The benchmark of vignetting and tone curves finds either where it is, and nothing where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.photometry import Pixels, explained, fitted, levelled


def photos(vignetting: float = 0.0, tone: float = 0.0, count: int = 4) -> list[Pixels]:
    """Photos of the same kind, with 2 % of noise, each with a level of its own."""
    random, out = np.random.default_rng(3), []
    for _ in range(count):
        model = np.exp(random.normal(-1.5, 0.5, (4000, 1))) * [1.0, 0.9, 0.8]
        square = random.random(4000)
        t = np.log(model.mean(1) / 0.22)
        factor = np.exp(vignetting * square + tone * t**2 + random.normal(0, 0.02, 4000) + random.normal(0, 0.1))
        photo = model * factor[:, None]
        out.append(Pixels(photo, levelled(photo, model), square))
    return out


def test_each_is_found_where_it_is() -> None:
    for case, right, wrong in (
        ({"vignetting": -0.3}, "vignetting", "tone curve"),
        ({"tone": 0.1}, "tone curve", "vignetting"),
    ):
        found = explained(photos(**case))
        assert found[right] > found["none"] + 3 and found["both"] == pytest.approx(found[right], abs=0.1)
        assert found[wrong] < found["none"] + 0.5
    assert fitted(photos(vignetting=-0.3), "vignetting") == pytest.approx([-0.3, 0.0], abs=0.02)
    assert fitted(photos(tone=0.1), "tone curve")[1] == pytest.approx(0.1, abs=0.02)  # the level took a part of it


def test_nothing_is_gained_where_there_is_none() -> None:
    found = explained(photos())
    assert max(found.values()) - min(found.values()) < 0.02
    assert found["none"] == pytest.approx(-20 * np.log10(0.02 * 0.23), abs=2)  # 2 % of a mid grey


def test_the_level_is_the_photos_own() -> None:
    model = np.full((5, 3), 0.2)
    assert levelled(3 * model, model) == pytest.approx(3 * model, rel=1e-12)
    one = [Pixels(3 * model, levelled(3 * model, model), np.zeros(5))] * 2
    assert explained(one)["none"] > 200  # one pixel's colour, no error: finite
