"""Made-up captures of many large photos have right cameras, and growth laws are those of their points."""

from __future__ import annotations

import dataclasses
import json
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks import many_photos, scaling
from benchmarks.scaling import AXES, Point
from stages.registry import REGISTRY, SOURCE

SIZE, FRAME = 64, (384, 256)
POINTS = np.array([[0.05, -0.03, 1.0], [-0.08, 0.02, 1.1]])


def small_capture(folder: Path, valid: bool = True) -> Path:
    """Two photos, each with one bright spot where its camera sees a point."""
    folder.mkdir()
    params: dict[str, Any] = {}
    for n, point in enumerate(POINTS):
        K = np.array([[120.0, 0, 31.5 + n], [0, 118.0, 30.5], [0, 0, 1]])
        uv = (K @ point / point[2])[:2]  # FaceScape: pixel centres at integers
        y, x = np.mgrid[:SIZE, :SIZE]
        spot = 250 * np.exp(-((x - uv[0]) ** 2 + (y - uv[1]) ** 2) / 8)
        cv2.imwrite(str(folder / f"{n}.png"), np.repeat(spot[..., None], 3, 2).round().astype(np.uint8))
        params |= {f"{n}_K": K.tolist(), f"{n}_Rt": np.eye(4)[:3].tolist(), f"{n}_distortion": [0.0] * 5}
        params |= {f"{n}_width": SIZE, f"{n}_height": SIZE, f"{n}_valid": valid}
    (folder / "params.json").write_text(json.dumps(params))
    return folder


# ------------------------------------------------------------------ many photos
def test_enlarged_photos_show_points_where_their_cameras_say(tmp_path: Path) -> None:
    many_photos.enlarge(small_capture(tmp_path / "in"), tmp_path / "out", 6, *FRAME)
    params = json.loads((tmp_path / "out/params.json").read_text())
    pictures = []
    for n in range(6):
        picture = cv2.imread(str(tmp_path / f"out/{n}.jpg"), cv2.IMREAD_GRAYSCALE)
        assert picture is not None and picture.shape == FRAME[::-1]
        point = POINTS[n % 2]
        expected = (np.array(params[f"{n}_K"]) @ point / point[2])[:2]
        weight = np.where(picture > 40, picture, 0).astype(float)
        y, x = np.mgrid[: FRAME[1], : FRAME[0]]
        assert [(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()] == pytest.approx(
            expected, abs=0.1
        )
        pictures.append(picture.astype(int))
    for a, b in combinations(range(6), 2):
        assert np.abs(pictures[a] - pictures[b]).max() > 50, "two photos are the same picture"


def test_the_pixel_s_middle_is_half_a_pixel_from_its_corner() -> None:
    place = many_photos.placed((64, 64), FRAME, 1)
    assert np.allclose((place @ [32, 32, 1])[:2], [FRAME[0] / 2 + many_photos.MOVED * FRAME[1], FRAME[1] / 2])
    corner = np.append(many_photos.pixels(place) @ [0, 0, 1], 1) + [0.5, 0.5, 0]
    assert np.allclose(corner, place @ [0.5, 0.5, 1])


def test_no_round_is_like_another() -> None:
    moved = [tuple(many_photos.placed((64, 64), FRAME, t)[:2, 2]) for t in range(20)]
    assert len(set(moved)) == len(moved)


def test_a_folder_without_photos_is_refused(tmp_path: Path) -> None:
    source = small_capture(tmp_path / "in", valid=False)
    with pytest.raises(SystemExit, match="no photos beside"):
        many_photos.enlarge(source, tmp_path / "out", 2, *FRAME)
    assert not (tmp_path / "out").exists()
    (tmp_path / "there").mkdir()
    with pytest.raises(SystemExit, match="exists"):
        many_photos.main([str(source), str(tmp_path / "there")])


# ------------------------------------------------------------------ stages side by side
def test_the_stages_are_a_chain() -> None:
    """Each stage needs what the one before it made, so that no two stages of one run can overlap (docs/benchmarks.md).
    Without a light stage `reflectance` is over at once: bake waits for it nevertheless, in no time."""
    ready = {SOURCE: 0}
    for number, stage in enumerate(REGISTRY, 1):
        ready[stage.name] = 1 + max(ready[f.name] for f in dataclasses.fields(stage.inputs))
        assert ready[stage.name] == number, stage.name


# ------------------------------------------------------------------ laws
def test_axes_grow_by_a_factor_of_eight() -> None:
    names = {s.name for s in REGISTRY}
    for axis, (values, stages) in AXES.items():
        factor = values[-1] / values[0]
        assert (factor if axis == "photos" else factor**2) == pytest.approx(8, rel=0.02) and set(stages) <= names


def test_a_law_has_its_exponent_and_error() -> None:
    rng = np.random.default_rng(0)
    points = [
        Point("photos", n, float(n), {s: 0.2 * n**0.9 * float(np.exp(rng.normal(0, 0.05))) for s in AXES["photos"][1]},
              dict.fromkeys(AXES["photos"][1], 400.0), 300.0)
        for n in AXES["photos"][0]
    ]  # fmt: skip
    rows = scaling.laws(points[::-1])
    assert [r[:3] for r in rows] == [["photos", s, "4 to 32"] for s in AXES["photos"][1]]
    for row in rows:
        b, error = map(float, row[4].split(" +- "))
        assert abs(b - 0.9) < 4 * error + 0.01 and 0 < error < 0.1 and row[6] == "0.00 +- 0.00"
    assert scaling.laws(points[:1]) == [] and scaling.short(2_096_704) == "2.1 million"


def test_processor_seconds_count() -> None:
    before = scaling.processor_seconds()
    sum(i * i for i in range(300_000))
    assert scaling.processor_seconds() > before


@pytest.mark.slow
def test_a_point_is_measured(tmp_path: Path) -> None:
    """Two photos are too few: the capture stage says so, and the made-up capture was read."""
    from pipeline.errors import StageError

    with pytest.raises(StageError, match="too few views"):
        scaling.measure("photos", 2, tmp_path / "work", small_capture(tmp_path / "in"), tmp_path)
