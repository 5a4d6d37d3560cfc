"""HEIC and camera raw photos: upright, in the colours that were recorded, with their metadata; or refused by name.

The HEIC files (128 x 96, a colour in each quarter) were written by pillow-heif 1.8.1: plain (8 bit), turned (EXIF
orientation 6, which it writes as `irot` too), deep (10 bit), pq (10 bit, HDR). Each with EXIF but the last.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.dng import write_dng

from pipeline.artifacts import FileRef
from pipeline.colour import linear_from_srgb
from pipeline.errors import StageError
from pipeline.images import read_encoded
from stages.capture import develop
from stages.capture.import_photo import ImportedPhoto, import_photo
from stages.capture.scan import scan_capture

HEIC = Path(__file__).parent / "heic"
COLOURS = np.array([[200, 40, 40], [40, 200, 40], [40, 40, 200], [200, 200, 200]])  # by rows of quarters


def imported(path: Path, tmp_path: Path) -> ImportedPhoto:
    return import_photo(path, FileRef.of(path.parent, path), tmp_path / "photos" / path.name, None)


def refused(path: Path, tmp_path: Path) -> StageError:
    with pytest.raises(StageError) as caught:
        imported(path, tmp_path)
    assert caught.value.where == path.name and caught.value.remedy
    return caught.value


def quarters(image: np.ndarray) -> np.ndarray:
    """The colour in the middle of each quarter."""
    h, w = image.shape[:2]
    return np.array([image[y, x, :3] for y in (h // 4, 3 * h // 4) for x in (w // 4, 3 * w // 4)], np.float64)


# ------------------------------------------------------------------ HEIC
def test_heic_is_stored_as_it_looks(tmp_path: Path) -> None:
    photo = imported(HEIC / "plain.heic", tmp_path)
    assert photo.image.suffix == ".png" and (photo.width, photo.height) == (128, 96) and not photo.turned
    np.testing.assert_allclose(quarters(read_encoded(photo.image)), COLOURS, atol=3)
    assert photo.exif.body == "Phone Model" and photo.exif.focal_35mm == 26
    assert photo.exif.exposure == pytest.approx(0.01 * 100 / 2.0**2)


def test_an_upright_heic_is_not_turned_twice(tmp_path: Path) -> None:
    """The orientation in EXIF repeats what the decoder has done; a quarter turn clockwise here."""
    photo = imported(HEIC / "turned.heic", tmp_path)
    assert (photo.width, photo.height) == (96, 128) and photo.exif.orientation == 1
    np.testing.assert_allclose(quarters(read_encoded(photo.image)), COLOURS[[2, 0, 3, 1]], atol=3)


def test_heic_of_ten_bits_keeps_them(tmp_path: Path) -> None:
    image = read_encoded(imported(HEIC / "deep.heic", tmp_path).image)
    assert image.dtype == np.uint16
    np.testing.assert_allclose(quarters(image) / 257, COLOURS, atol=1)


def test_hdr_heic_is_refused(tmp_path: Path) -> None:
    assert refused(HEIC / "pq.heic", tmp_path).what == "the photo is HDR"


# ------------------------------------------------------------------ raw
def scene() -> np.ndarray:
    """(96, 128, 3) linear: a dim grey, a colour on the left, a patch beyond the sensor's limit above."""
    linear = np.full((96, 128, 3), 0.2)
    linear[:, :32], linear[:32, 96:] = (0.4, 0.1, 0.05), 3.0
    return linear


def test_raw_is_developed_linearly(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", scene())
    photo = imported(tmp_path / "a.dng", tmp_path)
    image = read_encoded(photo.image)
    assert photo.image.name == "a.png" and image.dtype == np.uint16 and (photo.width, photo.height) == (128, 96)
    linear = linear_from_srgb(image / 65535)
    np.testing.assert_allclose(linear[48, 64], 0.2, rtol=5e-3)  # the camera's white balance makes it grey
    np.testing.assert_allclose(linear[48, 12], (0.4, 0.1, 0.05), rtol=1e-2)
    assert photo.exif.body == "Maker Model" and photo.exif.focal_35mm == 50


def test_the_scale_does_not_depend_on_the_brightest_place(tmp_path: Path) -> None:
    """Photos of one exposure stay comparable: no brightness and no white level are taken from the picture."""
    for name, top in (("dark", 0.2), ("bright", 0.9)):
        linear = scene()
        linear[:32, 96:] = top
        write_dng(tmp_path / f"{name}.dng", linear)
    dark, bright = (read_encoded(imported(tmp_path / f"{n}.dng", tmp_path).image) for n in ("dark", "bright"))
    np.testing.assert_array_equal(dark[48, 12:80], bright[48, 12:80])


def test_saturated_places_count_as_clipped(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", scene())
    photo = imported(tmp_path / "a.dng", tmp_path)
    assert photo.clipped is not None
    where = read_encoded(photo.clipped)[..., 0] > 0
    assert where[4:28, 100:124].all() and not where[40:].any() and not where[:, :90].any()


def test_raw_is_turned_by_its_exif(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", scene(), orientation=6)
    photo = imported(tmp_path / "a.dng", tmp_path)
    assert (photo.width, photo.height) == (96, 128) and photo.turned
    image = linear_from_srgb(read_encoded(photo.image) / 65535)
    np.testing.assert_allclose(image[12, 48], (0.4, 0.1, 0.05), rtol=1e-2)  # the left side is on top


# ------------------------------------------------------------------ refused
@pytest.mark.parametrize("suffix", [".heic", ".HIF", ".dng", ".CR2", ".nef", ".arw"])
@pytest.mark.parametrize("content", [b"", b"x" * 500, b"II*\0" + bytes(300)])
def test_what_can_not_be_read_is_refused_by_name(tmp_path: Path, suffix: str, content: bytes) -> None:
    (tmp_path / f"a{suffix}").write_bytes(content)
    assert "can't be read" in (said := refused(tmp_path / f"a{suffix}", tmp_path).what) or said == "the image is empty"


@pytest.mark.parametrize("kind", ["heic", "dng"])
def test_half_a_file_is_refused(tmp_path: Path, kind: str) -> None:
    write_dng(tmp_path / "a.dng", scene())
    shutil.copy(HEIC / "plain.heic", tmp_path / "a.heic")
    path = tmp_path / f"a.{kind}"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert refused(path, tmp_path).what in {"the HEIC photo can't be read", "the raw photo can't be read"}


@pytest.mark.parametrize("ends", ["os.kill(os.getpid(), signal.SIGSEGV)", "time.sleep(60)"])
def test_a_decoder_that_crashes_or_hangs_takes_nothing_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: str
) -> None:
    (tmp_path / "child.py").write_text(f"import os, signal, time\n{ends}\n")
    monkeypatch.setattr(develop, "CHILD", tmp_path / "child.py")
    monkeypatch.setattr(develop, "SECONDS", 1)
    said = str(refused(HEIC / "plain.heic", tmp_path).value)
    assert said == ("not decoded after 1 s" if "sleep" in ends else "the decoder crashed")


def test_more_pixels_than_the_file_can_hold_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(develop, "SMALL", 100)
    monkeypatch.setattr(develop, "DENSEST", 0)
    write_dng(tmp_path / "a.dng", scene())
    for path in (HEIC / "plain.heic", tmp_path / "a.dng"):
        assert refused(path, tmp_path).what == "the image is too large"


# ------------------------------------------------------------------ a folder of them
def noisy(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.05, 0.6, (96, 128, 1)) * np.ones(3)


def write_jpeg(path: Path, seed: int) -> None:
    cv2.imwrite(str(path), np.random.default_rng(seed).integers(0, 255, (96, 128, 3), np.uint8))


def test_a_folder_of_raw_photos_is_a_capture(tmp_path: Path, gather) -> None:
    folder = tmp_path / "c"
    (folder / "clean_plate").mkdir(parents=True)
    for i in range(3):
        write_dng(folder / f"{i}.DNG", noisy(i))
        write_dng(folder / f"clean_plate/{i}.dng", noisy(i + 10))
    capture = gather(folder).artifact
    assert [v.name for v in capture.views] == ["0.DNG", "1.DNG", "2.DNG"]
    assert [v.image.path for v in capture.views] == ["photos/0_0.png", "photos/1_1.png", "photos/2_2.png"]
    assert all(v.plate is not None for v in capture.views) and not capture.warnings


def test_of_one_stem_the_cameras_own_picture_is_taken(tmp_path: Path) -> None:
    for i in range(3):
        write_jpeg(tmp_path / f"p{i}.jpg", i)
        write_dng(tmp_path / f"p{i}.dng", noisy(i))
    shutil.copy(HEIC / "plain.heic", tmp_path / "q.heic")
    write_dng(tmp_path / "q.dng", noisy(5))
    source = scan_capture(tmp_path).artifact
    assert [p.path for p in source.photos] == ["p0.jpg", "p1.jpg", "p2.jpg", "q.heic"] and not source.passed_over


def test_raw_beside_other_photos_is_told(tmp_path: Path, gather) -> None:
    folder = tmp_path / "c"
    folder.mkdir()
    write_dng(folder / "z.dng", noisy(0))
    for i in range(3):
        write_jpeg(folder / f"{i}.jpg", i)
    told = gather(folder).artifact.warnings
    assert any("1 of 4 photos are raw, such as z.dng" in w for w in told)
