"""`neuface turntable` writes a film that can be read."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.errors import UsageError
from workflows.cli import turntable
from workflows.cli.main import main
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


@pytest.mark.parametrize("kind", ["mp4", "webp"])
def test_a_full_disk_is_told_and_the_former_film_stays(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A limit for files stands for the disk: OpenCV's writer of MP4 tells of neither."""
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (128, 128, 3), np.uint8) for _ in range(20)]
    monkeypatch.setattr(turntable, "frames", lambda request: iter(noise))
    out = tmp_path / f"film.{kind}"
    out.write_bytes(b"the former film")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65536, limits[1]))
    try:
        code = main(["turntable", str(tmp_path), "--out", str(out), "--frames", "20", "--size", "128"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    said = capsys.readouterr().err
    assert code == 1 and "what to do:" in said and "Traceback" not in said
    assert [p.name for p in tmp_path.iterdir()] == [out.name] and out.read_bytes() == b"the former film"


def test_a_film_that_is_interrupted_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(request: TurntableRequest) -> Iterator[np.ndarray]:
        yield np.zeros((64, 64, 3), np.uint8)
        raise KeyboardInterrupt

    monkeypatch.setattr(turntable, "frames", broken)
    with pytest.raises(KeyboardInterrupt):
        write_turntable(TurntableRequest(tmp_path, tmp_path / "film.mp4", frames=5, size=64))
    assert list(tmp_path.iterdir()) == []
