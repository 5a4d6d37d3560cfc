"""What is recognised in a user's folder, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import pytest

from pipeline.errors import StageError
from stages.capture.scan import natural_key, scan_capture
from tests.support.textured_ball import flat


def photos(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        ok, data = cv2.imencode(Path(name).suffix.lower() or ".jpg", flat((80, 70), i))
        assert ok
        (folder / name).write_bytes(data.tobytes())
    return folder


def names(refs) -> list[str]:
    return [r.path for r in refs]


def test_plain_photos_in_natural_order_of_any_suffix_case(tmp_path: Path) -> None:
    folder = photos(tmp_path / "c", "img10.JPG", "img2.jpg", "img1.Png", "x.tiff", ".hidden.jpg")
    photos(folder / "previews", "img99.jpg")
    (folder / "notes.txt").write_text("not a photo")
    found = scan_capture(folder).artifact
    assert found.kind == "photos" and found.cameras == () and found.masks == ()
    assert names(found.photos) == ["img1.Png", "img2.jpg", "img10.JPG", "x.tiff"]
    assert all(r.size == (folder / r.path).stat().st_size and len(r.sha256) == 64 for r in found.photos)


def test_natural_key_compares_numbers_as_numbers() -> None:
    assert sorted(["a10b2", "a9b10", "a9b9", "B1"], key=natural_key) == ["a9b9", "a9b10", "a10b2", "B1"]


def test_facescape_takes_only_the_photos_that_params_names(facescape) -> None:
    folder, _ = facescape
    photos(folder, "contact_sheet.jpg", "99.jpg")
    found = scan_capture(folder).artifact
    assert found.kind == "facescape" and names(found.cameras) == ["params.json"]
    assert names(found.photos) == [f"{i}.jpg" for i in range(6)]


@pytest.mark.parametrize("sub", ["mask", "masks"])
def test_masks_are_matched_by_stem_and_others_ignored(tmp_path: Path, sub: str) -> None:
    folder = photos(tmp_path / "c", "a.jpg", "b.jpg", "c.jpg")
    photos(folder / sub, "b.png", "c.jpg.png", "stray.png")
    assert names(scan_capture(folder).artifact.masks) == [f"{sub}/b.png", f"{sub}/c.jpg.png"]


def test_the_same_content_elsewhere_has_the_same_digest(tmp_path: Path) -> None:
    a = photos(tmp_path / "a", "1.jpg", "2.jpg", "3.jpg")
    b = Path(shutil.copytree(a, tmp_path / "b"))
    assert scan_capture(a).artifact.digest() == scan_capture(b).artifact.digest()
    photos(b, "1.jpg", "3.jpg")  # 3.jpg now has another picture
    assert scan_capture(a).artifact.digest() != scan_capture(b).artifact.digest()


def refused(folder: Path) -> StageError:
    with pytest.raises(StageError) as caught:
        scan_capture(folder)
    return caught.value


def test_no_folder_and_a_file_for_a_folder(tmp_path: Path) -> None:
    assert "does not exist" in str(refused(tmp_path / "nowhere"))
    assert "a file" in str(refused(photos(tmp_path, "a.jpg") / "a.jpg"))


def test_no_photos(tmp_path: Path) -> None:
    assert "no photos" in refused(tmp_path).what


def test_photos_of_other_kinds_or_one_folder_down_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.WEBP").write_bytes(b"x")
    assert "a.WEBP" in refused(tmp_path).value and "convert" in refused(tmp_path).remedy
    (tmp_path / "a.WEBP").unlink()
    photos(tmp_path / "images", "a.jpg")
    assert "images/" in refused(tmp_path).remedy


@pytest.mark.parametrize("count", [1, 2])
def test_one_photo_or_two_are_too_few(tmp_path: Path, count: int) -> None:
    error = refused(photos(tmp_path, *["a.jpg", "b.jpg"][:count]))
    assert error.what == "too few photos" and str(error.value).startswith(f"{count} (a.jpg")
    assert "3 views" in str(error.limit)


def test_params_that_name_none_of_the_photos(facescape) -> None:
    folder, _ = facescape
    for i in range(6):
        (folder / f"{i}.jpg").rename(folder / f"view{i}.jpg")
    assert "params.json lists" in refused(folder).value


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '{"cameras": []}', '"0_K"', "[" * 100000])
def test_params_that_are_not_facescape(facescape, text: str) -> None:
    folder, _ = facescape
    (folder / "params.json").write_text(text)
    assert "params.json" in refused(folder).what


def test_two_files_for_one_view_or_mask(facescape) -> None:
    folder, _ = facescape
    photos(folder, "3.png")
    assert "view 3" in refused(folder).where
    (folder / "3.png").unlink()
    photos(folder / "mask", "2.png", "2.jpg")
    assert "two masks" in refused(folder).what
    photos(folder / "masks", "1.png")
    assert "two folders" in refused(folder).what


def test_binary_params(facescape) -> None:
    folder, params = facescape
    (folder / "params.json").write_bytes(b"\xff\xfe" + json.dumps(params).encode("utf-16-le"))
    assert scan_capture(folder).artifact.kind == "facescape"  # JSON in UTF-16 with its mark is JSON
    (folder / "params.json").write_bytes(bytes(range(256)))
    assert "can't be read" in refused(folder).what
