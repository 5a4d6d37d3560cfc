"""Colour profiles: names out of profiles written byte by byte, in JPEG, PNG and TIFF; and what EXIF and EXR say."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.colour import ACESCG, REC709
from pipeline.images import write_exr
from pipeline.picture_size import exr_attribute
from stages.capture.exif import ADOBE_RGB, UNCALIBRATED, read_exif
from stages.capture.icc_profile import OTHER_PRIMARIES, is_srgb, profile_name
from tests.capture.test_capture_files import exif_jpeg, tiff_block
from tests.support.textured_ball import flat


def profile(name: str, new: bool) -> bytes:
    if new:
        text = name.encode("utf-16-be")
        tag = b"mluc" + struct.pack(">IIIHHII", 0, 1, 12, 0x656E, 0x5553, len(text), 28) + text
    else:
        text = name.encode() + b"\0"
        tag = b"desc" + struct.pack(">II", 0, len(text)) + text
    return bytes(128) + struct.pack(">I", 1) + b"desc" + struct.pack(">II", 144, len(tag)) + tag


def jpeg(block: bytes, parts: int = 1) -> bytes:
    data = cv2.imencode(".jpg", flat((96, 80), 1))[1].tobytes()
    size = -(-len(block) // parts)
    segments = b""
    for i in reversed(range(parts)):  # in any order: they are numbered
        body = b"ICC_PROFILE\0" + bytes([i + 1, parts]) + block[i * size : (i + 1) * size]
        segments += b"\xff\xe2" + struct.pack(">H", len(body) + 2) + body
    return data[:2] + segments + data[2:]


def png(block: bytes) -> bytes:
    data = cv2.imencode(".png", flat((96, 80), 1))[1].tobytes()
    body = b"iCCPname\0\0" + zlib.compress(block)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:33] + chunk + data[33:]


def tiff(block: bytes, big: bool = False) -> bytes:
    data = io.BytesIO()
    Image.fromarray(flat((96, 80), 1)).save(data, "TIFF", icc_profile=block, big_tiff=big)
    return data.getvalue()


@pytest.mark.parametrize("new", [False, True])
@pytest.mark.parametrize("wrap", [jpeg, lambda b: jpeg(b, 3), png, tiff, lambda b: tiff(b, True)])
def test_names(new: bool, wrap) -> None:
    assert profile_name(wrap(profile("Display P3", new))) == "Display P3"
    assert not is_srgb("Display P3") and is_srgb("sRGB IEC61966-2.1") and is_srgb(None)


def test_none_and_damaged() -> None:
    plain = cv2.imencode(".jpg", flat((96, 80), 1))[1].tobytes()
    assert profile_name(plain) is None and profile_name(b"") is None
    whole = profile("Display P3", True)
    for end in range(0, len(whole), 7):
        profile_name(jpeg(whole[:end]))  # no exception
        profile_name(png(whole[:end])[: 60 + end])
        profile_name(tiff(whole[: max(end, 1)]))


def test_foreign_colours_are_told(tmp_path: Path, gather) -> None:
    folder = tmp_path / "c"
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.jpg"), flat((96, 80), i + 5))
    (folder / "3.jpg").write_bytes(jpeg(profile("Adobe RGB (1998)", False)))
    (folder / "4.png").write_bytes(png(profile("sRGB built-in", True)))
    warnings = gather(folder, drop_blurred=False).artifact.warnings
    assert len(warnings) == 1 and "Adobe RGB (1998)" in warnings[0] and "3.jpg" in warnings[0]


def written_space(order: str, space: int, index: bytes = b"") -> bytes:
    """EXIF with ColorSpace, and a directory of interoperability with its index behind the others."""
    short = struct.pack(order + "H", space)
    link = [(0xA005, 4, 1, struct.pack(order + "I", 0))] if index else []
    end = len(tiff_block(order, [], [(0xA001, 3, 1, short), *link]))
    link = [(0xA005, 4, 1, struct.pack(order + "I", end))] if index else []
    own = struct.pack(order + "HHHI", 1, 1, 2, len(index)) + index + bytes(4) if index else b""
    return tiff_block(order, [], [(0xA001, 3, 1, short), *link]) + own


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("space", "index", "expected"), [
    (1, b"", None), (1, b"R98\0", None), (2, b"", ADOBE_RGB), (0xFFFF, b"", UNCALIBRATED),
    (0xFFFF, b"R03\0", ADOBE_RGB), (0xFFFF, b"R98\0", None), (0, b"", None),
])  # fmt: skip
def test_the_colour_space_in_exif(order: str, space: int, index: bytes, expected: str | None) -> None:
    assert read_exif(exif_jpeg(written_space(order, space, index))).colours == expected


def test_photos_whose_exif_is_not_srgb_are_told(tmp_path: Path, gather) -> None:
    """A profile counts more than EXIF: phones write "uncalibrated" beside theirs."""
    folder = tmp_path / "c"
    folder.mkdir()
    blocks = [written_space("<", *a) for a in ((1,), (0xFFFF,), (2,), (0xFFFF, b"R03\0"), (0xFFFF,))]
    for i, block in enumerate(blocks):
        (folder / f"{i}.jpg").write_bytes(exif_jpeg(block, flat((96, 80), i + 5)))
    own, other = (folder / "4.jpg").read_bytes(), jpeg(profile("sRGB IEC61966-2.1", True))
    segment = other[2 : 4 + int.from_bytes(other[4:6], "big")]
    (folder / "4.jpg").write_bytes(own[:2] + segment + own[2:])
    (folder / "5.tif").write_bytes(tiff(profile("ProPhoto RGB", True)))
    told = gather(folder, drop_blurred=False).artifact.warnings
    assert len(told) == 3, told
    assert "2 photos have the colour profile 'Adobe RGB, by EXIF', such as 2.jpg" in told[0]
    assert "1 photos have the colour profile 'ProPhoto RGB', such as 5.tif" in told[1]
    assert "1 photos are not sRGB by their EXIF, such as 1.jpg; their colours are read as sRGB" in told[2]


def test_primaries_of_an_exr(tmp_path: Path, gather) -> None:
    folder, picture = tmp_path / "c", flat((96, 80), 0).astype(np.float32) / 255
    folder.mkdir()
    rounded = tuple(round(v, 2) for v in REC709)
    for name, primaries in (("a", REC709), ("b", None), ("c", rounded), ("d", ACESCG)):
        write_exr(folder / f"{name}.exr", np.roll(picture, ord(name), 1), primaries=primaries)
        expected = OTHER_PRIMARIES if name == "d" else None
        assert profile_name((folder / f"{name}.exr").read_bytes()) == expected
    told = gather(folder, drop_blurred=False).artifact.warnings
    assert len(told) == 1 and "1 photos have other primaries than Rec.709 in their header, such as d.exr" in told[0]
    assert "read as Rec.709; export them as linear Rec.709" in told[0]
    data = (folder / "d.exr").read_bytes()
    for end in range(0, 700):
        assert exr_attribute(data[:end], b"chromaticities") in (None, struct.pack("<8f", *ACESCG))
        profile_name(data[:end])  # no exception
