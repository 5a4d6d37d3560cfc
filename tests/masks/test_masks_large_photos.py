"""Masks of large photos: the memory that a photo takes, and that working in strips changes nothing."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from stages.masks import matting
from stages.masks.keying import EDGE, MAX_SPREAD, UNCHANGED, Background, _inside, key_out, key_out_plate
from stages.masks.matting import soft_edge
from stages.masks.photos import MOST_AT_ONCE, PIXEL_BYTES, ROOM, at_once

U8 = npt.NDArray[np.uint8]
BLACK = Background((0.0, 0.0, 0.0), 2 * MAX_SPREAD)


def picture(height: int, width: int, noise: float = 4.0) -> tuple[U8, npt.NDArray[np.bool_]]:
    """A waved ellipse in front of black, with noise; and where it is."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    along = np.arctan2(y - height / 2, x - width / 2)
    inside = np.hypot((y - height / 2) / height, (x - width / 2) / width) < 0.35 + 0.03 * np.sin(9 * along)
    rng = np.random.default_rng(0)
    value = inside[..., None] * np.array([150, 110, 90]) + rng.normal(0, noise, (height, width, 3))
    return value.clip(0, 255).astype(np.uint8), inside


@pytest.mark.parametrize("rows", [1, 40, 97, 10_000])
@pytest.mark.parametrize("radius", [2, 4])
def test_strips_give_what_the_whole_gives(rows: int, radius: int, monkeypatch: pytest.MonkeyPatch) -> None:
    image, inside = picture(300, 240)
    whole = soft_edge(image, inside, radius)
    monkeypatch.setattr(matting, "STRIP", rows * 240)
    found = soft_edge(image, inside, radius)
    assert np.abs(found - whole).max() < 1e-6
    assert np.array_equal(np.round(found * 255), np.round(whole * 255))


def test_photos_of_usual_size_are_matted_in_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, ...]] = []
    solve = matting._solve

    def solved(colour: Any, *rest: Any) -> Any:
        seen.append(colour.shape)
        return solve(colour, *rest)

    monkeypatch.setattr(matting, "_solve", solved)
    soft_edge(*picture(1024, 1024), 3)
    assert len(seen) == 1


def test_a_plate_is_compared_in_its_farthest_channel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the formulas on whole arrays: gain over the pixels that differ least, then the largest difference."""
    image, inside = picture(180, 220)
    rng = np.random.default_rng(1)
    plate = rng.integers(40, 200, image.shape).astype(np.float32)
    photo = np.where(inside[..., None], image, plate * 1.25).clip(0, 255).astype(np.uint8)
    given: list[npt.NDArray[np.float32]] = []

    def told(away: Any, tolerance: float) -> Any:
        given.append(away)
        return _inside(away, tolerance)

    monkeypatch.setattr("stages.masks.keying._inside", told)
    monkeypatch.setattr("stages.masks.keying.cv2.GaussianBlur", lambda a, *_: a)
    key_out_plate(photo, plate.astype(np.uint8))
    full, empty = photo.astype(np.float32), plate.astype(np.uint8).astype(np.float32)
    like = np.abs(full - empty).max(2)
    same = like <= np.quantile(like, UNCHANGED)
    gain = np.float32(np.median((full[same] + 1) / (empty[same] + 1)))
    assert np.array_equal(given[0], np.abs(full - empty * gain).max(2)) and gain > 1.1


@pytest.mark.parametrize(
    "work",
    [
        lambda image: key_out(image, BLACK),
        lambda image: key_out_plate(image, np.zeros_like(image)),
        lambda image: soft_edge(image, image[..., 0] > 60, EDGE),
    ],
)
def test_a_photo_takes_no_more_than_is_reckoned(work: Callable[[U8], Any]) -> None:
    """With the photo itself, three bytes a pixel."""
    image, _ = picture(2400, 3200, 1.0)
    tracemalloc.start()
    try:
        work(image)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak / (2400 * 3200) + 3 < PIXEL_BYTES


def test_fewer_large_photos_at_once() -> None:
    def views(*megapixels: float) -> Any:
        return [SimpleNamespace(width=round(1e3 * m), height=1000) for m in megapixels]

    assert [at_once(views(1), n) for n in (1, 4, 64)] == [1, 4, MOST_AT_ONCE]
    assert at_once(views(1, 24, 2), 64) == ROOM // (PIXEL_BYTES * 24_000_000) == 3
    assert at_once(views(268), 64) == 1 and at_once([], 2) == 2  # the largest that is read; nothing
