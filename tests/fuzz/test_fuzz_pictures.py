"""Damaged pictures, masks and metadata."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings

from pipeline.artifacts import FileRef
from pipeline.errors import StageError
from pipeline.images import read_alpha, read_linear, write_exr
from pipeline.picture_size import declared_size_of
from stages.capture.exif import Exif, read_exif
from stages.capture.icc_profile import profile_name
from stages.capture.import_photo import ImportedPhoto, import_mask, import_photo
from stages.capture.photometry import exposures
from stages.capture.readers.sizes import picture_size
from tests.capture.test_capture_files import exif_jpeg, place_block
from tests.support.dng import write_dng
from tests.support.fuzzing import CASES, bounded, fuzzed
from tests.support.mutations import damaged, damages

PICTURE = np.random.default_rng(0).integers(0, 255, (70, 80, 3), np.uint8)
SUFFIXES = (".png", ".jpg", ".tif", ".exr")
MEGABYTES = 4000  # 10,000 pixels in each of 17 kB, as colours in floats: what a file of that size may hold
HEAD = 400  # bytes: half the damage goes to the header


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("whole")
    for suffix in SUFFIXES[:3]:
        cv2.imwrite(str(folder / f"a{suffix}"), PICTURE)
    write_exr(folder / "a.exr", PICTURE.astype(np.float32) / 255)
    return {s: (folder / f"a{s}").read_bytes() for s in SUFFIXES}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("place")


def in_head(how: list) -> int | None:
    return HEAD if int(how[0][1] * 1000) % 2 else None


@pytest.mark.parametrize("suffix", SUFFIXES)
@given(how=damages)
@fuzzed
def test_damaged_photos(whole: dict[str, bytes], place: Path, suffix: str, how: list) -> None:
    path = place / f"photo{suffix}"
    path.write_bytes(damaged(whole[suffix], how, in_head(how)))
    declared_size_of(path)
    with bounded():
        assert min(picture_size(path)) > 0
    with bounded():
        values = read_linear(path)
        assert values.dtype == np.float32 and values.shape[2] == 3
    with bounded():
        found = import_photo(path, FileRef.of(place, path), place / "photos" / path.name, None)
        assert min(found.width, found.height) >= 64 and np.isfinite(found.light)


@pytest.mark.slow  # a process for each file
@pytest.mark.parametrize("suffix", [".heic", ".dng"])
@given(how=damages)
@settings(fuzzed, max_examples=max(1, CASES // 10))
def test_damaged_heic_and_raw_photos(place: Path, suffix: str, how: list) -> None:
    path = place / f"photo{suffix}"
    if suffix == ".dng":
        write_dng(path, np.repeat(PICTURE[:, :, :1] / 300, 3, 2))
    else:
        path.write_bytes((Path(__file__).parents[1] / "capture/heic/plain.heic").read_bytes())
    path.write_bytes(damaged(path.read_bytes(), how, in_head(how)))
    with bounded():
        found = import_photo(path, FileRef.of(place, path), place / "photos" / path.name, None)
        assert min(found.width, found.height) >= 64 and np.isfinite(found.light)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".exr"])
@given(how=damages)
@fuzzed
def test_damaged_masks(place: Path, suffix: str, how: list) -> None:
    path = place / f"mask{suffix}"
    mask = np.zeros((70, 80), np.uint8)
    mask[20:50, 20:50] = 255
    if suffix == ".exr":
        write_exr(path, mask[..., None].astype(np.float32))
    else:
        cv2.imwrite(str(path), mask)
    path.write_bytes(damaged(path.read_bytes(), how, in_head(how)))
    photo = ImportedPhoto(place / "x.png", 80, 70, Exif(), False)
    target = place / "masks" / path.name
    with bounded():
        if import_mask(path, FileRef.of(place, path), target, photo) is None:
            assert 0 <= read_alpha(target).min() <= read_alpha(target).max() <= 1


@pytest.mark.parametrize("order", ["<", ">"])
@given(how=damages)
@fuzzed
def test_damaged_metadata(order: str, how: list) -> None:
    block = damaged(place_block(order), how)
    with bounded():
        for data in (block, exif_jpeg(block[:60_000], PICTURE[:8, :8])):
            exif = read_exif(data)
            focal = exif.focal_px(80, 70)
            assert focal is None or 1 <= focal <= 8000
            assert 1 <= exif.orientation <= 8
            exif.body.encode()
            assert all(np.isfinite(v) for v in dataclasses.astuple(exif) if isinstance(v, float))
            even = exposures([exif.exposure, 1.0, 2.0], [0.9, 0.1, 0.2])
            assert even is None or 0 < min(even) <= max(even) < 1e5


@given(how=damages)
@fuzzed
def test_damaged_colour_profiles(how: list) -> None:
    profile = b"\0" * 128 + b"\0\0\0\1desc\0\0\0\x90\0\0\0\x20" + b"desc\0\0\0\0\0\0\0\5sRGB\0".ljust(40, b"\0")
    segment = b"ICC_PROFILE\0\1\1" + damaged(profile, how)[:60_000]
    data = b"\xff\xd8\xff\xe2" + (len(segment) + 2).to_bytes(2, "big") + segment + b"\xff\xda"
    with bounded():
        (profile_name(data) or "").encode()


def test_a_small_file_that_claims_a_huge_picture_is_refused(place: Path) -> None:
    path = place / "bomb.exr"
    write_exr(path, np.zeros((70, 80, 3), np.float32))
    data = path.read_bytes()
    at = data.index(b"dataWindow\0box2i\0") + 21
    path.write_bytes(data[:at] + np.array([0, 0, 16383, 16383], "<i4").tobytes() + data[at + 16 :])
    with pytest.raises(StageError, match="more pixels than its file can hold"):
        read_linear(path)
