"""The benchmark of where the error is, on pictures whose error is put into one place."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.error_by_place import PLACES, shares, sums

Y, X = np.mgrid[:200, :200]
AWAY = np.hypot(X - 100, Y - 100)
BODY = AWAY < 80


def put(place: str) -> tuple[np.ndarray, np.ndarray]:
    """A model (H, W, 4) and a photo (H, W, 3), linear, that differ in one place of a grey disc."""
    photo = np.where(BODY[..., None], np.float32(0.4), np.float32(0.1)).repeat(3, 2).astype(np.float32)
    model = np.dstack([photo * BODY[..., None], BODY]).astype(np.float32)
    where = {
        "missing": (AWAY < 80) & (X > 140),
        "rim": (AWAY < 80) & (AWAY > 79),
        "inside": (AWAY < 60) & ((X + Y) % 2 == 0),
        "broad": AWAY < 60,
    }[place]
    if place == "missing":
        model[where] = 0
    else:
        model[where, :3] *= 0.5
    return model, photo


@pytest.mark.parametrize("place", PLACES)
def test_the_error_is_found_where_it_is(place: str) -> None:
    model, photo = put(place)
    found = shares([sums(model, photo, BODY.astype(np.float32), BODY)] * 2)
    of = "inside" if place == "broad" else place
    assert found[of].error == pytest.approx(1, abs=0.02)
    assert sum(found[n].error for n in PLACES[:3]) == pytest.approx(1)
    assert sum(found[n].pixels for n in PLACES[:3]) == pytest.approx(1)
    assert (found["broad"].error > 0.8) == (place == "broad")  # a pattern of single pixels is gone after the blur
    assert found["broad"].pixels == found["inside"].pixels


def test_what_does_not_count_is_left_out() -> None:
    model, photo = put("missing")
    counts = BODY & (X <= 140)
    found = shares([sums(model, photo, BODY.astype(np.float32), counts)])
    assert found["missing"].pixels == found["missing"].error == 0


def test_no_error_and_no_pixels_are_finite() -> None:
    model, photo = put("broad")
    same = sums(model, model[..., :3].copy(), BODY.astype(np.float32), BODY)
    assert {p.error for p in shares([same]).values()} == {0.0}
    nothing = sums(model, photo, np.zeros(BODY.shape, np.float32), np.zeros_like(BODY))
    assert {(p.pixels, p.error) for p in shares([nothing]).values()} == {(0.0, 0.0)}
