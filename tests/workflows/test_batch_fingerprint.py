"""A finished capture of a batch is looked at again when any file changes that a run of it would read."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from stages.capture.readers.facescape_scale import NAME as SCALE
from tests.support.scripted_batch import capture_tree, go
from workflows.batch.fingerprint import fingerprint
from workflows.run.published import LIST
from workflows.run.request import RunRequest

PLACES = ["0.jpg", "images/0.jpg", "image/0.jpg", "input/0.jpg", "photos/0.jpg", "rgb/0.jpg", "mask/0.png",
          "masks/0.png", "clean_plate/0.jpg", "parallel/0.jpg", "cross/0.jpg", "brackets/0.jpg", "olat/cam/0.exr",
          "full_on/0.exr", "sparse/0/cameras.bin"]  # fmt: skip


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    folder = tmp_path / "capture"
    folder.mkdir()
    (folder / "params.json").write_text("{}")
    return folder


def of(capture: Path, **changes: object) -> str:
    return fingerprint(RunRequest(**{"capture": str(capture), "out": str(capture.parent / "out"), **changes}))


def written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize("place", PLACES)
def test_a_photo_is_noticed_wherever_it_lies(capture: Path, place: str) -> None:
    without = of(capture)
    photo = written(capture / place, "a")
    first = of(capture)
    assert first == of(capture) != without
    photo.write_text("other photo")
    second = of(capture)
    assert second != first
    os.utime(photo, (1, 1))  # the same size
    assert of(capture) != second


def test_photos_in_a_folder_below_are_done_again_by_a_batch(tmp_path: Path) -> None:
    tree = capture_tree(tmp_path)
    photo = written(tree / "2/1_neutral/images/0.jpg", "a")
    go(tree, {})
    photo.write_text("another")
    assert [name for name, *_ in go(tree, {})[1].started] == ["2/1_neutral"]


def test_a_capture_that_is_a_video(tmp_path: Path) -> None:
    film = written(tmp_path / "a.mp4", "film")
    first = of(film)
    written(tmp_path / "b.mp4", "another person's")
    assert of(film) == first
    film.write_text("another film")
    assert of(film) != first


@pytest.mark.parametrize("setting", ["masks.model", "masks.hair_model", "inverse_rendering.light_file"])
def test_a_file_that_a_setting_names(capture: Path, tmp_path: Path, setting: str) -> None:
    file = written(tmp_path / "file", "a")
    stage, name = setting.split(".")
    for asked in ({"sets": (f"{setting}={file}",)}, {"config": {stage: {name: str(file)}}}):
        file.write_text("a")
        first = of(capture, **asked)
        file.write_text("another")
        assert of(capture, **asked) != first


@pytest.mark.parametrize("option", ["template", "light", "also"])
def test_what_an_option_names(capture: Path, tmp_path: Path, option: str) -> None:
    """Of a folder every file counts, at any depth."""
    place = tmp_path / "light.exr" if option == "light" else tmp_path / "folder"
    file = written(place if option == "light" else place / "below/file", "a")
    first = of(capture, **{option: str(place)})
    file.write_text("another")
    assert of(capture, **{option: str(place)}) != first


def test_the_scales_of_facescape_lie_above_the_capture(capture: Path) -> None:
    first = of(capture)
    written(capture.parent / SCALE, json.dumps({"1": 2}))
    assert of(capture) != first


def test_results_and_hidden_files_do_not_count(capture: Path) -> None:
    """Else a batch with its folder of results among the photos would never be done."""
    out, store = capture / "runs/anna", capture / "finished"
    asked = {"out": str(out), "store": str(store)}
    first = of(capture, **asked)
    for path in (out / "asset/head.usd", store / "capture/key/a.jpg", capture / ".thumbnails/a.jpg", capture / ".a"):
        written(path, "new")
    written(capture / "runs/ben" / LIST, "{}")  # another run's results
    written(capture / "runs/ben/asset/head.usd", "new")
    assert of(capture, **asked) == first


def test_linked_folders_are_followed_and_a_ring_of_links_ends(capture: Path, tmp_path: Path) -> None:
    photo = written(tmp_path / "disk/0.jpg", "a")
    (capture / "images").symlink_to(tmp_path / "disk")
    (capture / "ring").symlink_to(capture)
    first = of(capture)
    photo.write_text("another")
    assert of(capture) != first
