"""A light stage whose pictures lie elsewhere, and lights as other calibrations have them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import StageError
from stages.capture.readers.olat import FULL_ON, SINGLE, TRACKING, patterns, pictures_of, read_lights
from stages.capture.scan import scan_capture
from tests.support.light_stage import DISTANCE


def put(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    source.rename(target)


def told(folder: Path, **changes: object) -> None:
    """lights.json with other entries."""
    path = folder / "lights.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_one_folder_for_each_light_gives_the_same_capture(capture, gather, tmp_path: Path) -> None:
    folder, _ = capture
    before = gather(folder)
    for path in sorted(folder.glob("olat/*/*.exr")):
        put(path, folder / f"light_{int(path.stem)}" / f"cam {path.parent.name}.exr")
    for path in sorted(folder.glob("full_on/*.exr")):
        put(path, folder / "all[on]" / f"cam {path.stem}.exr")
    for path in sorted(folder.glob("tracking/*/*.exr")):
        put(path, folder / "track" / f"{path.stem}_{path.parent.name}.exr")
    shutil.rmtree(folder / "olat")
    places = {"single": "light_{light}/cam {camera}.exr", "full_on": "all[on]/cam {camera}.exr",
              "tracking": "track/{frame}_{camera}.exr"}  # fmt: skip
    told(folder, pictures=places)
    after = gather(folder)
    assert after.artifact.stage == before.artifact.stage
    assert [v.image for v in after.artifact.views] == [v.image for v in before.artifact.views]
    assert len(scan_capture(folder).artifact.stage) == 123  # every file counts for the key


def test_frames_of_a_stage_as_faceolat_numbers_them(capture, gather) -> None:
    """Made-up copy of FaceOLAT's layout: a folder for each camera, frames of one sequence, positions in millimetres."""
    folder, stage = capture
    before = gather(folder).artifact.stage
    entries = json.loads((folder / "lights.json").read_text())["lights"]
    for path in sorted(folder.glob("olat/*/*.exr")):
        frame = entries[int(path.stem)]["frame"] + 1
        put(path, folder / f"Cam{int(path.parent.name) + 6:02d}" / "ID20003" / f"ID20003.{frame:06d}.exr")
    for path in sorted(folder.glob("full_on/*.exr")):
        put(path, folder / f"Cam{int(path.stem) + 6:02d}" / "ID20003" / "ID20003.000001.exr")
    lights = [{"index": n, "position": (1000 * p).tolist(), "intensity_rgb": i.tolist(), "frame": n + 2}
              for n, (p, i) in enumerate(zip(stage.positions, stage.intensities, strict=True))]  # fmt: skip
    places = {"single": "Cam{camera}/ID20003/ID20003.{frame}.exr", "full_on": "Cam{camera}/ID20003/ID20003.000001.exr",
              "cameras": {"06": 0, "07": 1, "08": 2}}  # fmt: skip
    (folder / "lights.json").write_text(
        json.dumps({"lights": lights, "scale": 0.001, "stage_centre": [0, 0, 0], "pictures": places})
    )
    found = gather(folder).artifact.stage
    assert [(f.camera, f.number) for f in found.frames] == [(f.camera, f.number) for f in before.frames]
    for a, b in zip(found.lights, before.lights, strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1e-9)
        np.testing.assert_allclose(a.axis, b.axis, atol=1e-9)


def test_lights_by_azimuth_and_elevation_as_in_extended_yale_b(tmp_path: Path) -> None:
    """Oracle: four directions by hand."""
    angles = [(0, 0), (90, 0), (-90, 0), (0, 90), (30, 45), (10, 10), (20, 20), (40, -30)]
    lights = [{"index": n, "azimuth": a, "elevation": e} for n, (a, e) in enumerate(angles)]
    (tmp_path / "lights.json").write_text(json.dumps({"lights": lights, "distance": 2, "intensity_rgb": [4, 4, 4]}))
    found = read_lights(tmp_path / "lights.json").lights
    places = np.array([found[n].position for n in range(4)])
    np.testing.assert_allclose(places, [[0, 0, 2], [2, 0, 0], [-2, 0, 0], [0, 2, 0]], atol=1e-12)
    np.testing.assert_allclose(found[1].axis, [-1, 0, 0], atol=1e-12)
    assert found[4].intensity == (4, 4, 4) and found[4].position[1] == pytest.approx(2 * np.sqrt(0.5))
    told(tmp_path, distance=None)
    with pytest.raises(StageError, match="distance"):
        read_lights(tmp_path / "lights.json")


def test_one_camera_alone_is_refused_by_its_number_of_views(capture, gather) -> None:
    """A single camera, as in Extended Yale B, has no geometry."""
    folder, _ = capture
    params = json.loads((folder / "params.json").read_text())
    (folder / "params.json").write_text(json.dumps({k: v for k, v in params.items() if k[0] == "0"}))
    with pytest.raises(StageError, match="too few views"):
        gather(folder)


@pytest.mark.parametrize(
    "given",
    [
        [],
        {"single": "a{light}{camera}.exr"},
        {"single": "a{camera}.exr", "full_on": "{camera}.exr"},
        {"single": "{light}/{camera}{frame}.exr", "full_on": "{camera}.exr"},
        {"single": "/x/{light}/{camera}.exr", "full_on": "{camera}.exr"},
        {"single": "../{light}/{camera}.exr", "full_on": "{camera}.exr"},
        {"single": "{light}/{camera}{who}.exr", "full_on": "{camera}.exr"},
        {"single": "{light}/{camera}.exr", "full_on": "{camera}.exr", "cameras": {"a": 0, "b": 0}},
        {"single": "{light}/{camera}.exr", "full_on": "{camera}.exr", "cameras": {"a": "0"}},
        {"single": "{light}/{camera}.exr", "full_on": "{camera}.exr", "tracking": 3},
    ],
)
def test_patterns_that_say_nothing_are_refused(tmp_path: Path, given: object) -> None:
    (tmp_path / "lights.json").write_text(json.dumps({"lights": [], "pictures": given}))
    with pytest.raises(StageError, match="light stage's"):
        patterns(tmp_path)


def test_two_files_for_one_picture_are_told_and_other_files_are_no_pictures(tmp_path: Path) -> None:
    (tmp_path / "l").mkdir()
    for name in ("3_0.exr", "03_0.exr", "4_1.exr", "4_1.txt", "x_1.exr", "4_1_2.exr"):
        (tmp_path / "l" / name).touch()
    places = {"single": "l/{light}_{camera}.exr", "full_on": "{camera}.exr", "tracking": "t/{camera}/{frame}.exr"}
    (tmp_path / "lights.json").write_text(json.dumps({"lights": [], "pictures": places}))
    found = pictures_of(tmp_path)
    assert list(found.single) == [(1, 4)] and found.doubled == ["l/03_0.exr and l/3_0.exr"] and not found.tracking
    assert set(patterns(tmp_path)) == {SINGLE, FULL_ON, TRACKING}


def test_a_unit_that_is_not_positive_is_refused(capture) -> None:
    folder, _ = capture
    told(folder, scale=0)
    with pytest.raises(StageError, match="unit"):
        read_lights(folder / "lights.json")
    told(folder, scale=2)
    assert np.linalg.norm(read_lights(folder / "lights.json").lights[0].position) == pytest.approx(2 * DISTANCE)
