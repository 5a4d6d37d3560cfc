"""Photos for the names in a cameras' file, which programs spell in several ways."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.capture.readers.described import find_photo
from tests.capture.test_capture_readers import transforms
from tests.support.textured_ball import flat


def files(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


def found(folder: Path, written: str) -> str | None:
    path = find_photo(folder, written)
    return None if path is None else path.relative_to(folder).as_posix()


@pytest.mark.parametrize(("written", "there"), [
    ("DSC_0001", "DSC_0001.JPG"),  # Metashape's labels
    ("DSC_0001", "images/DSC_0001.Jpg"),
    ("IMG_1.jpg", "IMG_1.JPG"),
    ("img_1.JPG", "images/IMG_1.jpg"),
    ("IMG_1.jpg", "photos/IMG_1.jpg.TIF"),
    ("sub/a.png", "sub/A.PNG"),
    ("C:\\photos\\a.jpg", "rgb/a.jpg.JPG"),
])  # fmt: skip
def test_capital_letters_do_not_matter(tmp_path: Path, written: str, there: str) -> None:
    assert found(files(tmp_path, there, "other.jpg"), written) == there


def test_the_exact_spelling_comes_first(tmp_path: Path) -> None:
    files(tmp_path, "A.JPG", "images/a.jpg", "b.JPG", "B.jpg")
    assert found(tmp_path, "a.jpg") == "images/a.jpg"
    assert found(tmp_path, "A.JPG") == "A.JPG"
    assert found(tmp_path, "b.jpg") == found(tmp_path, "b.jpg") == "B.jpg"  # none is exact: the first by name
    assert found(tmp_path, "b.JPG") == "b.JPG"


def test_what_is_no_photo_is_not_found(tmp_path: Path) -> None:
    files(tmp_path, "A.TXT", "B.NEF", "c.JPG/inner.jpg")
    for written in ("a.txt", "a", "b", "B.NEF", "c", "c.jpg", "", ".", "..", "../A.jpg", "\0", "sub/none.jpg"):
        assert found(tmp_path, written) is None, written
    os.utime(tmp_path, ns=(1, 1))
    assert found(tmp_path, "d") is None
    files(tmp_path, "D.JPG")
    assert found(tmp_path, "d") == "D.JPG"  # the listing is not an old one


def test_a_folder_is_listed_once_for_all_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cameras' file may name ten thousand photos that are not there."""
    files(tmp_path, *(f"{i}.JPG" for i in range(30)))
    listed, whole = [], Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda folder: listed.append(folder) or whole(folder))
    assert all(found(tmp_path, f"absent{i}") is None for i in range(50))
    assert found(tmp_path, "29.jpg") == "29.JPG" and listed == [tmp_path]


def test_a_capture_whose_names_differ_in_capital_letters(tmp_path: Path, gather) -> None:
    folder = tmp_path / "c"
    transforms(folder)
    for path in list((folder / "images").iterdir()):
        path.rename(path.with_name(f"v{path.stem}.PNG"))
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace("images/", "images/V"))
    (folder / "mask").mkdir()
    (folder / "clean_plate").mkdir()
    mask = np.zeros((80, 96), np.uint8)
    mask[20:60, 30:70] = 255
    for i in range(4):
        cv2.imwrite(str(folder / f"mask/v{i:03d}.png"), mask)
        cv2.imwrite(str(folder / f"clean_plate/v{i:03d}.PNG.png"), flat((96, 80), 50))
    capture = gather(folder).artifact
    assert len(capture.views) == 4 and not capture.left_out
    assert all(v.mask is not None and v.plate is not None for v in capture.views)
