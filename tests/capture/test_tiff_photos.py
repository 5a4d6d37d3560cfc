"""TIFF photos with an orientation: turned upright once, as JPEG and PNG are; the oracle is Pillow."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from pipeline.artifacts import FileRef
from pipeline.images import read_encoded
from pipeline.picture_size import declared_size, without_orientation
from stages.capture.exif import read_exif
from stages.capture.import_photo import import_photo
from stages.capture.integrity import fault_of
from tests.capture.test_capture_files import camera_block, exif_jpeg
from tests.support.textured_ball import flat

PICTURE = flat((96, 80), 3)[..., ::-1].copy()


def tiff(image: np.ndarray, orientation: int, order: str = "<", big: bool = False) -> bytes:
    """A TIFF of one strip, written byte by byte: (H, W, 3) of 8 or 16 bits, or of floats."""
    pixels = image.astype(image.dtype.newbyteorder(order)).tobytes()
    bits, whole = 8 * image.dtype.itemsize, np.issubdtype(image.dtype, np.integer)
    values = {256: image.shape[1], 257: image.shape[0], 258: bits, 259: 1, 262: 2, 273: 0, 274: orientation, 277: 3,
              278: image.shape[0], 279: len(pixels), 339: 1 if whole else 3}  # fmt: skip
    offset, head, at = ("Q", 16, 8) if big else ("I", 8, 2)
    room = 8 if big else 4
    ends = head + at + len(values) * (4 + 2 * room) + room
    values[273] = ends + 16
    entries = b""
    for tag, value in values.items():
        many = tag in (258, 339)  # one number for each channel: three shorts, which fit into an entry of a BigTIFF
        kind, count = (4, 1) if tag in (273, 279) else (3, 3 if many else 1)
        payload = struct.pack(f"{order}{count}{'I' if kind == 4 else 'H'}", *[value] * count).ljust(room, b"\0")
        if len(payload) > room:
            payload = struct.pack(f"{order}I", ends + (0 if tag == 258 else 8))
        entries += struct.pack(f"{order}HH{offset}", tag, kind, count) + payload
    mark = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}H", 43 if big else 42)
    mark += struct.pack(f"{order}HHQ", 8, 0, head) if big else struct.pack(f"{order}I", head)
    triples = struct.pack(f"{order}3H2x3H2x", *[bits] * 3, *[values[339]] * 3)
    count = struct.pack(f"{order}{'Q' if big else 'H'}", len(values))
    return mark + count + entries + bytes(room) + triples + pixels


def imported(path: Path, declared: tuple[int, int] | None = None):
    return import_photo(path, FileRef.of(path.parent, path), path.parent / "photos" / path.name, declared)


def upright(orientation: int) -> np.ndarray:
    """PICTURE (H, W, 3) as Pillow shows it with this orientation."""
    data = io.BytesIO()
    Image.fromarray(PICTURE).save(data, "PNG", exif=camera_block("<", orientation))
    return np.asarray(ImageOps.exif_transpose(Image.open(data)))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("order", "big"), [("<", False), (">", False), ("<", True), (">", True)])
def test_a_tiff_is_turned_upright_once(tmp_path: Path, orientation: int, order: str, big: bool) -> None:
    for kind, times in ((np.uint8, 1), (np.uint16, 257), (np.float32, 1 / 512)):
        image = (PICTURE * np.float64(times)).astype(kind)
        path = tmp_path / f"{np.dtype(kind)}.tif"
        path.write_bytes(tiff(image, orientation, order, big))
        assert declared_size(path.read_bytes()) == (96, 80) and fault_of(path.read_bytes()) is None
        np.testing.assert_array_equal(read_encoded(path), image)  # as stored
        found = imported(path)
        expected = (upright(orientation) * np.float64(times)).astype(kind)
        assert (found.height, found.width) == expected.shape[:2] and found.turned == (orientation != 1)
        back = read_encoded(found.image)
        assert back.dtype == kind
        np.testing.assert_array_equal(back, expected)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_tiff_of_another_program_is_as_the_jpeg_beside_it(tmp_path: Path, orientation: int) -> None:
    Image.fromarray(PICTURE).save(tmp_path / "a.tif", tiffinfo={274: orientation})
    (tmp_path / "b.jpg").write_bytes(exif_jpeg(camera_block(">", orientation), PICTURE[..., ::-1]))
    a, b = (read_encoded(imported(tmp_path / n).image).astype(int) for n in ("a.tif", "b.jpg"))
    np.testing.assert_array_equal(a, upright(orientation))
    assert a.shape == b.shape and np.abs(a - b).mean() < 12  # JPEG of fine texture


def test_a_given_camera_belongs_to_the_stored_pixels_of_a_tiff(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(tiff(PICTURE, 6))
    found = imported(tmp_path / "a.tif", (96, 80))
    assert (found.width, found.height, found.turned) == (96, 80, False)
    assert found.image.read_bytes() == (tmp_path / "a.tif").read_bytes()
    np.testing.assert_array_equal(read_encoded(found.image), PICTURE)  # what every later stage reads


@pytest.mark.parametrize("big", [False, True])
def test_damaged_directories(big: bool) -> None:
    """Only entries that lie in the file are changed, and a file without the tag is not copied."""
    whole = tiff(PICTURE, 6, big=big)
    assert read_exif(whole).orientation == 6 and read_exif(without_orientation(whole)).orientation == 1
    start = 16 if big else 8
    for end in range(0, start + 300):
        assert len(without_orientation(whole[:end])) == end
    for first in (0, len(whole) - 1, len(whole), 2**31, 2**32 - 1):
        place = struct.pack("<Q", first) if big else struct.pack("<I", first)
        broken = whole[: start - len(place)] + place + whole[start:]
        assert len(without_orientation(broken)) == len(broken)
    for other in (tiff(PICTURE, 1, big=big), cv2.imencode(".png", PICTURE)[1].tobytes(), b""):
        assert without_orientation(other) is other
