"""Files and folders that the user names and that can't be there are told before any work, without a traceback."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from workflows.bench import speed
from workflows.cli import turntable
from workflows.cli.main import main


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file where a folder would be needed."""
    path = tmp_path / "file"
    path.write_text("mine")
    return path


def refused(code: int, wanted: int, capsys: pytest.CaptureFixture[str]) -> str:
    said = capsys.readouterr().err
    assert code == wanted and "what to do:" in said and "Traceback" not in said
    return said


@pytest.mark.parametrize("place", ["none/found.json", ".", "file/found.json"])
@pytest.mark.usefixtures("toys", "file")
def test_json_into_no_folder(
    place: str, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing was judged before: with --solve that takes minutes."""
    monkeypatch.setattr("workflows.cli.check.run_stages", None)
    monkeypatch.setattr("stages.usd.check.validate.validate", None)
    for command in (["check", str(photos)], ["validate", str(tmp_path / "a.usd")]):
        said = refused(main([*command, "--json", str(tmp_path / place)]), 2, capsys)
        assert "--json" in said and str(tmp_path / place) in said


def test_expressions_into_a_file(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "asset").mkdir()
    (tmp_path / "asset/head.usd").write_text("")
    monkeypatch.setattr("stages.usd.render.expressions.load_cage", lambda root: SimpleNamespace(shapes={}))
    said = refused(main(["expressions", str(tmp_path), "--out", str(file)]), 1, capsys)
    assert "a file is where a folder is needed" in said and file.read_text() == "mine"


@pytest.mark.parametrize("place", ["file/film.mp4", "folder.mp4", "file/below/film.webp"])
def test_a_film_where_none_can_be(
    place: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder.mp4").mkdir()
    monkeypatch.setattr(turntable, "frames", lambda request: iter([np.zeros((64, 64, 3), np.uint8)]))
    arguments = ["turntable", str(tmp_path), "--out", str(tmp_path / place), "--frames", "1", "--size", "64"]
    refused(main(arguments), 2 if place == "folder.mp4" else 1, capsys)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.mp4"]


def test_bench_speed_looks_for_the_run_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(speed.host_info, "apart", None)  # it measures nothing
    out = tmp_path / "out"
    arguments = ["bench", "speed", "--run", str(tmp_path / "none"), "--out", str(out)]
    assert "there is no asset" in refused(main(arguments), 1, capsys) and not out.exists()


def test_bench_into_a_file(file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(speed.host_info, "apart", None)
    refused(main(["bench", "speed", "--out", str(file)]), 1, capsys)
