"""Parts of the 3D view that need no browser: its modules, the direction of its lights, its colours, its photos."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.synthetic_results import SyntheticResults, write_results

from pipeline.colour import linear_from_srgb, srgb_from_linear
from pipeline.maths.latlong import latlong_directions
from pipeline.transforms import project, rows
from stages.report.pictures import scale_colours
from stages.report.viewer import CODES, MODULES, light_data
from stages.report.viewer_cameras import chosen, straightened


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> SyntheticResults:
    return write_results(tmp_path_factory.mktemp("results"))


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


def test_photos_are_straightened_as_the_cameras_project(results: SyntheticResults) -> None:
    """A dot drawn where the distorted camera sees a point comes to where the plain camera sees it."""
    camera = results.poses.artifact.cameras[0].model_copy(update={"distortion": (-0.2, 0.05, 0.002, -0.001, 0.0)})
    w, h = camera.width, camera.height
    K, pose = np.array(camera.K), np.eye(4)
    point = np.array([[0.25 * w / K[0, 0], 0.3 * h / K[1, 1], 1.0]])
    seen, _ = project(K, pose, np.array(camera.distortion), point)
    plain, _ = project(K, pose, np.zeros(5), point)
    y, x = np.indices((h, w)) + 0.5
    dot = np.exp(-((x - seen[0, 0]) ** 2 + (y - seen[0, 1]) ** 2) / 18)
    found = straightened(np.repeat((255 * dot).astype(np.uint8)[..., None], 3, 2), camera)[..., 0].astype(float)
    centre = np.array([(found * x).sum(), (found * y).sum()]) / found.sum()
    assert np.abs(centre - plain[0]).max() < 0.3 < np.abs(seen - plain).max()
    untouched = camera.model_copy(update={"distortion": (0.0,) * 5, "K": rows(K)})
    assert (straightened(np.full((h, w, 3), 7, np.uint8), untouched) == 7).all()


def test_held_out_photos_come_first_and_few_others(results: SyntheticResults) -> None:
    picked = chosen(results)
    assert picked[:2] == [3, 9] and len(picked) == len(set(picked)) <= 12
