"""Films of one turn in the asset's previews."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.colour import linear_from_srgb
from pipeline.film import animated_webp
from pipeline.images import read_encoded
from stages.usd.render.films import GREY, render_films
from stages.usd.stage import Config

LIGHTS = ("captured", "sunset")


def read(path: Path) -> tuple[list[np.ndarray], list[int]]:
    """RGB pictures and milliseconds of each."""
    done, film = cv2.imreadanimation(str(path))
    assert done
    return [f[..., 2::-1].astype(float) for f in film.frames], [int(d) for d in film.durations]


@pytest.fixture(scope="module")
def films(exported: tuple[Path, Any]) -> dict[str, tuple[list[np.ndarray], list[int]]]:
    return {n: read(exported[0] / f"previews/turn_{n}.webp") for n in LIGHTS}


def test_they_are_of_the_asset_and_take_four_seconds(exported: tuple[Path, Any], films: dict[str, Any]) -> None:
    named = {f.path for f in exported[1].files}
    assert {f"previews/turn_{n}.webp" for n in LIGHTS} <= named
    for frames, times in films.values():
        assert len(frames) == Config().film_frames and frames[0].shape == (64, 64, 3)
        assert sum(times) == pytest.approx(4000, abs=len(times))


def test_it_begins_with_the_front_as_the_preview_shows_it(exported: tuple[Path, Any], films: dict[str, Any]) -> None:
    front = read_encoded(exported[0] / "previews/front.png").astype(float)
    inside = front[..., 3] == 255
    assert inside.mean() > 0.1
    assert np.abs(films["captured"][0][0] - front[..., :3])[inside].mean() < 6  # WebP loses a little
    grey = films["captured"][0][0][front[..., 3] == 0]
    assert linear_from_srgb(np.median(grey, 0) / 255) == pytest.approx([GREY] * 3, rel=0.05)


def test_the_head_turns_and_the_lights_differ(films: dict[str, Any]) -> None:
    captured, sunset = films["captured"][0], films["sunset"][0]
    assert np.abs(captured[0] - captured[len(captured) // 2]).mean() > 2
    assert np.abs(captured[0] - sunset[0]).mean() > 2
    assert np.abs(captured[0] - captured[-1]).mean() < np.abs(captured[0] - captured[len(captured) // 2]).mean()


def test_none_are_made_where_none_are_asked_for(tmp_path: Path) -> None:
    nothing: Any = None
    assert render_films(nothing, 0, 64, tmp_path, lambda: None) == [] and list(tmp_path.iterdir()) == []


def test_equal_pictures_give_equal_bytes_and_a_film_that_moves() -> None:
    frames = [np.full((8, 8, 3), 60 * i, np.uint8) for i in range(4)]
    data = animated_webp(frames, 2.0, 90)
    assert data == animated_webp(frames, 2.0, 90) and data[:4] == b"RIFF" and b"ANMF" in data
