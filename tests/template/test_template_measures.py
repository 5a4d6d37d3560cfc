"""What benchmarks/template_figures.py measures, against shapes whose figures are known; and its page."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from benchmarks import template_figures as figures
from benchmarks.template_measures import front_of, shapes_in_glb, tilt
from pipeline.head_artifacts import FittedEye


def sheet(degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a slanted sheet, and texture coordinates that are its own turned by so much."""
    random = np.random.default_rng(0)
    flat = random.uniform(-1, 1, (50, 3, 2))
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    axes = np.array([[1.0, 0, 0], [0, np.cos(0.4), np.sin(0.4)]])
    return flat @ axes, 0.3 * flat @ np.array([[c, -s], [s, c]])  # rows: clockwise seen from above


@pytest.mark.parametrize("degrees", [0.0, 1.5, -40.0, 138.0])
def test_the_tilt_is_the_turn_of_the_texture(degrees: float) -> None:
    corners, uvs = sheet(degrees)
    assert tilt(corners, uvs, np.array([0.0, 1.0, 0.0])) == pytest.approx(degrees, abs=1e-9)


def test_morph_targets_are_read_from_the_binary(tmp_path: Path) -> None:
    document = {"meshes": [{"name": "rest"}, {"name": "head", "extras": {"targetNames": ["a", "b"]}}]}
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A)
    (tmp_path / "x.glb").write_bytes(header + text)
    assert shapes_in_glb(tmp_path / "x.glb") == ("a", "b")


def test_the_pupil_is_the_front_of_the_ball() -> None:
    axes = ((1.0, 0.0, 0.0), (0.0, 0.8, -0.6), (0.0, 0.6, 0.8))
    eye = FittedEye(part="eye_left", centre=(0.03, 0.0, 0.07), radius=0.012, iris=0.0058, axes=axes)
    np.testing.assert_allclose(front_of(eye), [0.03, 0.0072, 0.0796])


def test_limits_say_what_misses_them() -> None:
    psnr, share, cross = (figures.LIMITS[n] for n in ("psnr", "face_share", "crossings"))
    assert psnr.met({"psnr": 34.8, "scan_psnr": 35.0}, "psnr") is True
    assert psnr.met({"psnr": 34.6, "scan_psnr": 35.0}, "psnr") is False
    assert psnr.met({"psnr": 34.6}, "psnr") is None  # without the scan's there is no limit
    assert share.met({"face_share": 0.44}, "face_share") is False and cross.met({"crossings": 0.0}, "crossings") is True
    text = figures.page(
        {"b": {"figures": {"face_share": 0.44, "psnr": 34.6, "scan_psnr": 35.0}, "date": "d", "commit": "c"}}
    )
    assert "| **0.44** |" in text and "| **34.60 (35.00)** |" in text and "crossings" not in text


def test_the_page_is_made_of_its_record() -> None:
    """Made by: python -m benchmarks.template_figures RUN --capture CAPTURE --write"""
    assert figures.PAGE.read_text() == figures.page(figures.recorded())
