"""Parts of the 3D view that need no browser: its modules, the direction of its lights, its colours."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.colour import linear_from_srgb, srgb_from_linear
from pipeline.maths.latlong import latlong_directions
from stages.report.pictures import scale_colours
from stages.report.viewer import CODES, MODULES, light_data


def test_every_module_imports_only_modules_before_it() -> None:
    known: set[str] = set()
    for name, path in MODULES:
        source = (Path("stages/report") / path).read_text()
        wanted = set(re.findall(r"^(?:import|export)\b[^;]*? from '([^']+)'", source, re.M))
        assert wanted <= known, path
        known.add(name)


def test_three_js_is_unchanged() -> None:
    folder = Path("stages/report/three")
    notice = (folder / "NOTICE").read_text()
    for file in sorted(folder.glob("*.js")):
        assert hashlib.sha256(file.read_bytes()).hexdigest() in notice, file.name


def test_the_light_points_where_three_js_looks() -> None:
    """three.js samples at u = atan2(z, x) / 2 pi + 1/2, v = asin(y) / pi + 1/2, from the lowest row up."""
    directions = latlong_directions(64, 32)
    sent = light_data(directions.astype(np.float32) + 2)
    image = np.frombuffer(base64.b64decode(sent["rgb"]), np.float16).reshape(32, 64, 3).astype(float) - 2
    v, u = (np.indices((32, 64)) + 0.5) / np.array([32, 64])[:, None, None]
    longitude, latitude = 2 * np.pi * (u - 0.5), np.pi * (v - 0.5)
    wanted = [np.cos(latitude) * np.cos(longitude), np.sin(latitude), np.cos(latitude) * np.sin(longitude)]
    assert np.abs(image - np.stack(wanted, -1)).max() < 3e-3
    top = light_data(np.full((2, 4, 3), 1e9, np.float32))
    assert np.isfinite(np.frombuffer(base64.b64decode(top["rgb"]), np.float16)).all()


# Linear RGB as people without long, middle or short cones see it [Machado, Oliveira and Fernandes 2009], severity 1.
VISION = {
    "protanopia": ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    "deuteranopia": ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    "tritanopia": ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
}


@pytest.mark.parametrize("kind", VISION)
def test_codes_and_scales_differ_for_every_kind_of_colour_vision(kind: str) -> None:
    """By CIE76 in Lab: codes are 15 apart at least, and each tenth of a scale is lighter than the one before."""
    codes = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in CODES])
    lab = seen_as(codes, kind)
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=-1)[np.triu_indices(len(lab), 1)]
    assert apart.min() > 15
    assert (np.diff(seen_as(scale_colours()[::25], kind)[:, 0]) > 2).all()


def seen_as(rgb: np.ndarray, kind: str) -> np.ndarray:
    """CIE Lab (N, 3) of 8-bit sRGB colours (N, 3)."""
    linear = (linear_from_srgb(rgb / 255.0) @ np.array(VISION[kind]).T).clip(0, 1)
    shown = srgb_from_linear(linear).astype(np.float32)[None]
    return np.asarray(cv2.cvtColor(shown, cv2.COLOR_RGB2Lab)[0])
