"""`neuface turntable` writes a film that can be read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import UsageError
from workflows.cli import turntable
from workflows.cli.turntable import TurntableRequest, write_turntable


@pytest.mark.parametrize("kind", ["mp4", "webp"])
def test_a_film_has_its_frames(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of one grey each come back in their order."""
    grey = [np.full((64, 64, 3), 40 * i + 20, np.uint8) for i in range(5)]
    monkeypatch.setattr(turntable, "frames", lambda request: iter(grey))
    path = write_turntable(TurntableRequest(tmp_path, tmp_path / f"new/film.{kind}", frames=5, size=64))
    if kind == "mp4":
        film, found = cv2.VideoCapture(str(path)), []
        while (read := film.read())[0]:
            found.append(read[1])
    else:
        found = list(cv2.imreadanimation(str(path))[1].frames)
    assert [float(f[..., :3].mean()) for f in found] == pytest.approx([20, 60, 100, 140, 180], abs=4)


@pytest.mark.parametrize(("name", "size"), [("film.avi", 64), ("film", 64), ("film.mp4", 65)])
def test_films_that_no_player_shows_are_refused(name: str, size: int, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="film"):
        write_turntable(TurntableRequest(tmp_path, tmp_path / name, size=size))
