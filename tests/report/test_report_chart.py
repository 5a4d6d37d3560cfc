"""The colour chart on the report: how it stood, how the fitted light would light it, and the page's table."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.synthetic_results import SyntheticResults, write_results

from pipeline.artifacts import Camera, FileRef, Located
from pipeline.capture_artifacts import ChartFound, ColourChart
from pipeline.contract import Context
from pipeline.transforms import inverse_rigid, rigid, rows
from stages.report.chart import normal_of, white_under
from stages.report.stage import STAGE, Config, Inputs

EDGES = np.array([[-3, -2, 0], [3, -2, 0], [3, 2, 0], [-3, 2, 0]]) * 0.02  # metres


def camera(distortion: tuple[float, ...]) -> Camera:
    turn = cv2.Rodrigues(np.array([0.3, -0.7, 0.2]))[0]
    return Camera(index=0, name="0.jpg", width=900, height=700, K=((1200, 0, 430), (0, 1210, 360), (0, 0, 1)),
                  world_from_cam=rows(rigid(turn, np.array([0.4, 0.1, -0.2]))), distortion=distortion)  # fmt: skip


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.12, 0.03, 0.002, -0.001, 0.0)])
def test_the_normal_is_the_charts(distortion: tuple[float, ...]) -> None:
    """Oracle: cv2.projectPoints; it has the first pixel's centre at (0, 0)."""
    c = camera(distortion)
    world_from_cam = np.array(c.world_from_cam)
    for axis in ([2.6, 0.3, 0.2], [0.2, 2.9, -0.4], [np.pi, 0, 0]):
        chart = cv2.Rodrigues(np.array(axis))[0]
        at = world_from_cam[:3, :3] @ [0.05, -0.03, 0.9] + world_from_cam[:3, 3]
        points = EDGES @ (world_from_cam[:3, :3] @ chart).T + at
        cam_from_world = inverse_rigid(world_from_cam)
        K = np.array(c.K) - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        uv = cv2.projectPoints(points, cv2.Rodrigues(cam_from_world[:3, :3])[0], cam_from_world[:3, 3], K,
                               np.array(distortion))[0].reshape(4, 2)  # fmt: skip
        normal = world_from_cam[:3, :3] @ chart[:, 2]
        normal *= np.sign(normal @ (world_from_cam[:3, 3] - at))
        assert normal_of(rows(uv + 0.5), c) @ normal > np.cos(np.radians(0.2))


def test_a_white_under_an_even_and_under_a_slanted_light() -> None:
    """Oracle: an even light of radiance 1 gives pi; 1 + d . x gives pi + 2 pi / 3 towards x (quadrature by hand)."""
    even = np.zeros((4, 3))
    even[0] = np.sqrt(4 * np.pi)
    assert white_under(even, np.array([0.0, 0.6, 0.8])) == pytest.approx([1] * 3)
    slanted = even.copy()
    slanted[3, 1] = np.sqrt(4 * np.pi / 3)
    assert white_under(slanted, np.array([1.0, 0, 0])) == pytest.approx([1, 1 + 2 / 3, 1])
    assert white_under(slanted, np.array([-1.0, 0, 0])) == pytest.approx([1, 1 - 2 / 3, 1])


def run(results: SyntheticResults, folder: Path) -> tuple[dict, str]:
    folder.mkdir(parents=True)
    STAGE.run(Inputs(**{n: getattr(results, n) for n in Inputs.__slots__}), Config(), Context(folder, folder / "s"))
    return json.loads((folder / "metrics.json").read_text()), (folder / "index.html").read_text()


def test_the_page_has_a_table_of_it(tmp_path: Path) -> None:
    results = write_results(tmp_path / "r")
    metrics, page = run(results, tmp_path / "none")
    assert metrics["colour_chart"] == {"found": 0} and "Colour checker" not in page
    fit = ChartFound(camera_group="A 1", photo="3.jpg", index=results.poses.artifact.cameras[0].index,
                     corners=((40, 30), (70, 31), (71, 50), (39, 49)), matrix=((1, 0, 0), (0, 2, 0), (0, 0, 4)),
                     way="gains", error=0.02, patches=23, white=(1.0, 0.5, 0.25))  # fmt: skip
    lost = fit.model_copy(update={"camera_group": "B", "index": 999})
    capture = results.capture.artifact.model_copy(
        update={"chart": ColourChart(photos=("3.jpg", "4.jpg"), level=0.5, fits=(fit, lost))}
    )
    light = [[np.sqrt(4 * np.pi) * 0.8] * 3] + [[0.0] * 3] * 3
    folder = results.inverse_rendering.folder
    (folder / "chart_light.json").write_text(json.dumps({"coefficients": light}))
    face = results.inverse_rendering.artifact.model_copy(update={"light": FileRef.of(folder, "chart_light.json")})
    changed = replace(results, capture=Located(capture, results.capture.folder),
                      inverse_rendering=Located(face, folder))  # fmt: skip
    metrics, page = run(changed, tmp_path / "one")
    found = metrics["colour_chart"]
    assert found["found"] == 2 and found["A 1: error of its patches"] == 0.02
    assert found["A 1: fitted light on it, of what fell on it"] == pytest.approx(1.6)
    assert not any(k.startswith("B: fitted") for k in found)  # its photo has no place
    assert "Colour checker" in page and "1.000, 0.500, 0.250" in page and "not the scale of the albedo" in page
