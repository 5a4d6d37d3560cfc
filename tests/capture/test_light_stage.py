"""A light stage's capture: what passes, and every way in which it can be bad."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.colour import srgb_from_linear
from pipeline.errors import StageError
from pipeline.images import read_linear, write_exr, write_png
from stages.capture.light_stage_checks import Sequences, Single, additive, brightness, drift, exchanged, gap
from stages.capture.scan import scan_capture
from tests.support.light_stage import DISTANCE, SIZE, Stage, make_stage, photograph, write_lights


def level(found, check: str) -> str:
    return next(f.level for f in found.findings if f.check == check)


def exchange(folder: Path, a: int, b: int) -> None:
    for camera in sorted((folder / "olat").iterdir()):
        first, second = (camera / f"{n:03d}.exr" for n in (a, b))
        first.rename(camera / "x")
        second.rename(first)
        (camera / "x").rename(second)


def test_a_light_stage_is_read_with_cameras_lights_and_levels(capture, gather) -> None:
    folder, stage = capture
    found = gather(folder)
    read = found.artifact
    assert read.kind == "olat" and [v.index for v in read.views] == [0, 1, 2]
    assert len(read.stage.lights) == 40 and len(read.stage.frames) == 120 and len(read.stage.tracking) == 3
    light = read.stage.lights[7]
    np.testing.assert_allclose(light.position, stage.positions[7])
    np.testing.assert_allclose(light.axis, -stage.positions[7] / DISTANCE, atol=1e-12)
    np.testing.assert_allclose(light.intensity, stage.intensities[7])
    frame = next(f for f in read.stage.frames if (f.camera, f.number) == (1, 7))
    np.testing.assert_allclose(read_linear(found.path(frame.image)), photograph(stage, 1, 7), atol=2e-3)
    view = read_linear(found.path(read.views[0].image))
    np.testing.assert_allclose(view, read.stage.gain * read_linear(folder / "full_on" / "0.exr"), atol=1e-3)
    assert 0.8 < np.quantile(view[view > 0.05], 0.995) < 1.2  # in a photo's range
    stages = [f for f in read.findings if f.check.startswith("stage_")]
    assert len(stages) == 6 and all(f.level == "good" for f in stages)


def test_a_stage_is_judged_by_its_lights_and_not_by_the_number_of_photos(capture, gather) -> None:
    """Three cameras are few, but as many as the fit needs; a rig of photos alone needs eight."""
    folder, stage = capture
    found = next(f for f in gather(folder).artifact.findings if f.check == "photos")
    assert found.level == "usable" and "each under all lights" in found.said
    assert level(gather(folder, holdout="none").artifact, "stage_directions") == "good"
    few = [n for n, p in enumerate(stage.positions) if p[2] > 0.5 * DISTANCE]  # all in front
    for path in folder.glob("olat/*/*.exr"):
        if int(path.stem) not in few:
            path.unlink()
    assert level(gather(folder).artifact, "stage_directions") == "unusable"
    plain = folder.parent / "plain"
    shutil.copytree(folder / "full_on", plain)
    shutil.copy(folder / "params.json", plain)
    assert level(gather(plain).artifact, "photos") == "unusable"


@pytest.mark.parametrize(
    ("directions", "expected"),
    [
        ([[0, 0, 1]], np.degrees(np.arccos(-0.8))),  # a cap of nine tenths of the sphere: 1 - cos = 1.8
        ([[0, 1, 0], [0, -1, 0]], np.degrees(np.arccos(0.1))),
        ([[1, 0, 0], [-1, 0, 0]], np.degrees(np.arccos(0.1))),
        ([], 180.0),
    ],
)
def test_the_gap_between_lights(directions: list, expected: float) -> None:
    """Oracle: caps around the lights, by hand."""
    assert gap(np.array(directions, float).reshape(-1, 3)) == pytest.approx(expected, abs=1.5)


def test_every_file_counts_for_the_key(capture) -> None:
    folder, _ = capture
    before = scan_capture(folder).artifact.digest()
    picture = folder / "olat" / "2" / "031.exr"
    write_exr(picture, read_linear(picture) * np.float32(1.01), half=True)
    assert scan_capture(folder).artifact.digest() != before


def test_missing_and_doubled_pictures_and_lights_without_calibration_are_told(capture, gather) -> None:
    folder, stage = capture
    (folder / "olat" / "0" / "004.exr").unlink()
    shutil.copy(folder / "olat" / "1" / "005.exr", folder / "olat" / "1" / "5.exr")
    for camera in range(3):
        shutil.copy(folder / "olat" / str(camera) / "006.exr", folder / "olat" / str(camera) / "077.exr")
    content = json.loads((folder / "lights.json").read_text())
    del content["lights"][9]["intensity_rgb"]
    (folder / "lights.json").write_text(json.dumps(content))
    read = gather(folder).artifact
    have = {(f.camera, f.number) for f in read.stage.frames}
    assert (0, 4) not in have and (1, 4) in have and (1, 5) not in have
    assert not {n for _, n in have} & {9, 77}
    told = "\n".join(read.warnings)
    assert "1/005.exr and 1/5.exr: two files for one picture" in told
    assert "light 77: it has pictures but no calibration" in told and "light 9 has no intensity_rgb" in told


def test_a_light_that_failed_and_a_saturated_picture_are_left_out(capture, gather) -> None:
    folder, stage = capture
    for camera in range(3):
        write_exr(folder / "olat" / str(camera) / "012.exr", np.zeros((SIZE, SIZE, 3), np.float32), half=True)
    bright = folder / "olat" / "1" / "016.exr"
    write_exr(bright, np.minimum(read_linear(bright) * 9, 0.3), half=True)
    read = gather(folder).artifact
    have = {(f.camera, f.number) for f in read.stage.frames}
    assert 12 not in {n for _, n in have} and (1, 16) not in have and (0, 16) in have
    assert "light 12: it shows less than 10%" in "\n".join(read.warnings)
    assert level(read, "stage_lights") == "usable" and level(read, "stage_saturated") == "usable"


def test_two_exchanged_lights_are_found(capture, gather) -> None:
    folder, _ = capture
    exchange(folder, 3, 24)
    read = gather(folder).artifact
    assert "light 3: its pictures seem to be those of light 24" in "\n".join(read.warnings)
    assert not {3, 24} & {f.number for f in read.stage.frames}


def test_one_file_for_two_lights_leaves_both_out(capture, gather) -> None:
    folder, _ = capture
    shutil.copy(folder / "olat" / "1" / "018.exr", folder / "olat" / "1" / "021.exr")
    read = gather(folder).artifact
    assert not {18, 21} & {f.number for f in read.stage.frames}
    assert "camera 1 has the same file for it as for light 18" in "\n".join(read.warnings)


def test_pictures_encoded_as_srgb_are_found_by_their_sum(capture, gather) -> None:
    folder, _ = capture
    for path in [*folder.glob("olat/*/*.exr"), *folder.glob("full_on/*.exr")]:
        write_exr(path, srgb_from_linear(read_linear(path).astype(np.float64)).astype(np.float32), half=True)
    assert level(gather(folder).artifact, "stage_linear") == "unusable"


def test_integer_pictures_need_to_be_declared_linear(capture, gather) -> None:
    folder, stage = capture
    for path in folder.glob("olat/*/*.exr"):
        write_png(path.with_suffix(".png"), np.minimum(read_linear(path), 1), bits=16)
        path.unlink()
    with pytest.raises(StageError, match="is not linear"):
        gather(folder)
    write_lights(folder, stage, encoding="linear")
    frame = gather(folder)
    image = next(f.image for f in frame.artifact.stage.frames if (f.camera, f.number) == (1, 7))
    np.testing.assert_allclose(read_linear(frame.path(image)), photograph(stage, 1, 7), atol=2e-3)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"lights": "none"}, "no list of lights"),
        ({"lights": []}, "too few lights are calibrated"),
        ({"lights": [{"index": i, "position": [0, 1], "intensity_rgb": [1, 1, 1]} for i in range(9)]}, "wrong length"),
        ({"lights": [{"index": 0, "position": [0, 0, 1], "direction": [0, 0, 2], "intensity_rgb": [1, 1, 1]}]}, "unit"),
        ({"lights": [{"index": 0, "position": [0, 0, float("nan")]}]}, "not finite"),
        ({"encoding": "sRGB"}, "encoding of a light stage's pictures"),
        ({"encoding": True}, "encoding of a light stage's pictures"),
        (
            {
                "lights": [
                    {
                        "index": 0,
                        "position": [0, 0, 1],
                        "direction": [0, 0, 1],
                        "intensity_rgb": [1, 1, 1],
                        "frame": 2.5,
                    }
                ]
            },
            "not a whole number",
        ),
    ],
)
def test_bad_calibration_is_named(capture, gather, change, what) -> None:
    folder, stage = capture
    write_lights(folder, stage, **change)
    with pytest.raises(StageError, match=what):
        gather(folder)


def test_a_picture_of_another_size_is_named(capture, gather) -> None:
    folder, _ = capture
    write_exr(folder / "olat" / "0" / "000.exr", np.ones((SIZE, SIZE + 1, 3), np.float32))
    with pytest.raises(StageError, match="not of its camera's size"):
        gather(folder)


def test_a_view_without_its_picture_is_left_out(capture, gather) -> None:
    folder, _ = capture
    (folder / "full_on" / "0.exr").unlink()
    with pytest.raises(StageError, match="too few"):
        gather(folder)


def _sequences(stage: Stage, gains: np.ndarray) -> Sequences:
    from pipeline.capture_artifacts import StageLight
    from stages.capture.light_stage_checks import thumbnail

    lights, singles, full = {}, {}, {}
    for n, (p, i) in enumerate(zip(stage.positions, stage.intensities, strict=True)):
        lights[n] = StageLight(index=n, position=tuple(p), axis=tuple(-p / DISTANCE), intensity=tuple(i), frame=n)
        for c in range(3):
            picture = gains[n] * photograph(stage, c, n)
            singles[c, n] = Single(thumbnail(picture.astype(np.float32)), "", Path())
    for c in range(3):
        full[c] = np.sum([singles[c, n].thumb / max(gains[n], 1e-9) for n in lights], 0) * gains.max()
    return Sequences(lights, singles, full)


@pytest.mark.parametrize("change", [-0.3, 0.0, 0.4])
def test_drift_of_the_lights_is_measured(change) -> None:
    """Oracle: the gains that the pictures were made with. The lights' order is shuffled as in a real stage."""
    stage = make_stage(lights=60)
    order = np.random.default_rng(2).permutation(60)
    stage.positions, stage.intensities = stage.positions[order], stage.intensities[order]
    found = _sequences(stage, 1 + change * np.arange(60) / 59)
    assert drift(found) == pytest.approx(change, abs=0.1)
    if change == 0:
        assert additive(found) == pytest.approx((1, 1), abs=0.01)


def test_checks_at_the_extremes() -> None:
    """Black pictures, and a single light: nothing is claimed."""
    stage = make_stage(lights=9)
    black = _sequences(stage, np.zeros(9))
    assert np.isnan(additive(black)).all() and drift(black) == 0
    directions, seen = np.eye(3), np.zeros((3, 5))
    np.testing.assert_array_equal(brightness(directions, seen), 1)
    assert exchanged(directions, seen) == []
    huge = _sequences(stage, np.full(9, 1e6))
    assert additive(huge) == pytest.approx((1, 1), abs=0.01)
