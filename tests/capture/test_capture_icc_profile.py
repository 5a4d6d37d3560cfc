"""Colour profiles: names out of profiles written byte by byte, in JPEG and PNG."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import pytest

from stages.capture.icc_profile import is_srgb, profile_name
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


@pytest.mark.parametrize("new", [False, True])
@pytest.mark.parametrize("wrap", [jpeg, lambda b: jpeg(b, 3), png])
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


def test_foreign_colours_are_told(tmp_path: Path, gather) -> None:
    folder = tmp_path / "c"
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.jpg"), flat((96, 80), i + 5))
    (folder / "3.jpg").write_bytes(jpeg(profile("Adobe RGB (1998)", False)))
    (folder / "4.png").write_bytes(png(profile("sRGB built-in", True)))
    warnings = gather(folder, drop_blurred=False).artifact.warnings
    assert len(warnings) == 1 and "Adobe RGB (1998)" in warnings[0] and "3.jpg" in warnings[0]
