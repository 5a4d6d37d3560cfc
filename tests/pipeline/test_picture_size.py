"""Sizes from headers, against what the decoders say; bombs refused before they are decoded."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import images
from pipeline.errors import StageError
from pipeline.images import read_encoded, write_exr
from pipeline.picture_size import declared_size, png_claims_more

W, H = 37, 23


def picture(path: Path) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 255, (H, W, 3), np.uint8)
    if path.suffix == ".exr":
        write_exr(path, pixels.astype(np.float32))
    else:
        assert cv2.imwrite(str(path), pixels)
    return path.read_bytes()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
def test_size_is_the_decoders(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    assert declared_size(picture(path)) == (W, H)
    assert read_encoded(path).shape[:2] == (H, W)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
def test_a_header_that_is_cut_off_has_no_size_or_the_right_one(tmp_path: Path, suffix: str) -> None:
    data = picture(tmp_path / f"a{suffix}")
    for end in range(min(len(data), 600)):
        assert declared_size(data[:end]) in (None, (W, H))


HEADS = [b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"\x76\x2f\x31\x01", b"#?"]


@given(st.sampled_from(HEADS), st.binary())
def test_no_bytes_make_it_fail(head: bytes, rest: bytes) -> None:
    """None, or the numbers that stand in the bytes; a PNG's are where its standard puts them."""
    found = declared_size(head + rest)
    assert found is None or all(isinstance(n, int) for n in found)
    if head[:1] == b"\x89":
        assert found == (struct.unpack(">II", rest[8:16]) if len(rest) >= 16 else None)


@pytest.mark.parametrize("first", [2**63 - 1, 2**63, 2**64 - 1])
def test_a_big_tiff_whose_offset_is_beyond_any_memory_has_no_size(first: int) -> None:
    assert declared_size(b"II+\0\x08\0\0\0" + struct.pack("<Q", first)) is None


@pytest.mark.parametrize("length", [2**30, 2**31 - 1, 2**32 - 1])
def test_a_png_whose_chunk_claims_gigabytes_is_never_given_to_the_decoder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int
) -> None:
    """OpenCV makes room for the chunk before it reads it."""
    path = tmp_path / "a.png"
    data = picture(path)
    at = data.index(b"IDAT") - 4
    path.write_bytes(data[:at] + struct.pack(">I", length) + data[at + 4 :])
    monkeypatch.setattr(images.cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(StageError, match="can't be decoded"):
        read_encoded(path)


def test_a_whole_png_claims_no_more_than_it_has(tmp_path: Path) -> None:
    """With bytes behind its end, or between, that a decoder passes over; and cut off at every place."""
    data = picture(tmp_path / "a.png")
    text = b"".join((struct.pack(">I", 300), b"tEXt", bytes(300), struct.pack(">I", zlib.crc32(b"tEXt" + bytes(300)))))
    at = data.index(b"IDAT") - 4
    for whole in (data, data + b"\xff" * 40, data[:at] + text + data[at:]):
        assert not png_claims_more(whole)
        (tmp_path / "b.png").write_bytes(whole)
        assert read_encoded(tmp_path / "b.png").shape == (H, W, 3)
    at = data.index(b"IDAT") - 4
    (length,) = struct.unpack_from(">I", data, at)
    for end in range(at, len(data)):
        assert png_claims_more(data[:end]) == (at + 12 <= end < at + 12 + length)


def test_a_progressive_jpeg_and_one_with_a_long_comment() -> None:
    pixels = np.zeros((H, W, 3), np.uint8)
    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    comment = b"\xff\xfe" + struct.pack(">H", 60_002) + b"\xff\xc0" * 30_000
    assert declared_size(data[:2] + comment * 3 + data[2:]) == (W, H)


def png_bomb(path: Path, side: int) -> None:
    """A few kilobytes that decode to side x side pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    squeeze = zlib.compressobj(9)
    rows = b"".join(squeeze.compress(bytes(side // 8 + 1)) for _ in range(side)) + squeeze.flush()
    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))


def test_an_image_bomb_is_refused_undecoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """20,000 x 20,000 pixels in 50 kB: 400 MB decoded."""
    bomb = tmp_path / "bomb.png"
    png_bomb(bomb, 20_000)
    assert bomb.stat().st_size < 200_000
    monkeypatch.setattr(images, "_decoded", lambda path: pytest.fail("it was decoded"))
    tracemalloc.start()
    with pytest.raises(StageError) as e:
        read_encoded(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "20000 x 20000" in str(e.value) and "268 megapixels" in str(e.value)
    assert peak < 1e6


def test_a_file_beyond_any_photo_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    with path.open("wb") as f:
        f.truncate(5_000_000_000)  # a hole: takes no disk
    with pytest.raises(StageError, match="too large"):
        read_encoded(path)
