"""The report's section on a reflectance field: figures, plot, pictures; none for other captures."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.synthetic_results import write_results

from pipeline.artifacts import (
    FileRef,
    Located,
)
from pipeline.contract import Context
from pipeline.images import write_png
from pipeline.reflectance_artifacts import LeftOutPicture, ReflectanceField
from stages.report.field_figures import by_angle, field_figures, together
from stages.report.light_stage import plot, shown_field
from stages.report.stage import STAGE, Config, Inputs

SCORES = tuple(
    LeftOutPicture(camera=c, light=light, angle=angle, psnr=30 - angle, blend_psnr=24 - angle + c)
    for light, angle in ((3, 6.0), (10, 9.0), (17, 12.0), (24, 14.0), (31, 18.0))
    for c in (0, 2)
)


def field_in(folder: Path, **changes: object) -> Located[ReflectanceField]:
    """A field of which one picture is stored: the truth is grey, the field is darker in its right half."""
    truth = np.full((20, 30, 3), 0.5, np.float32)
    made = truth.copy()
    made[:, 15:] -= 0.1
    write_png(folder / "shown" / "worst_2_31.png", np.hstack([truth, made]))
    figures = {"left_out_psnr": 21.5, "blend_psnr": 17.25, "left_out_angle": 11.8, "display_gain": 2.0,
               "quick_psnr": 33.3, "quick_lamps": 64, "full_lamps": 384}  # fmt: skip
    field = ReflectanceField(present=True, size=64, lights=72, left_out=(3, 10, 17, 24, 31), figures=figures,
                             predicted=SCORES, shown=(FileRef.of(folder, "shown/worst_2_31.png"),))  # fmt: skip
    return Located(field.model_copy(update=changes), folder)


def report(folder: Path, field: Located[ReflectanceField] | None) -> tuple[dict, str]:
    made = write_results(folder / "in")
    made = made if field is None else replace(made, reflectance=field)
    work = folder / "work"
    work.mkdir()
    STAGE.run(Inputs(**{n: getattr(made, n) for n in Inputs.__slots__}), Config(viewer=False), Context(work, work))
    return json.loads((work / "metrics.json").read_text()), (work / "index.html").read_text()


def test_pictures_together_are_those_of_their_mean_error() -> None:
    """Oracle: errors by hand."""
    assert together([20, 20]) == 20 and together([20.0, 30.0]) == pytest.approx(-10 * np.log10(0.0055), abs=0.005)
    assert together([99.0]) == 99


def test_bands_hold_every_picture_once_and_a_light_in_one() -> None:
    bands = by_angle(SCORES)
    assert len(bands) == 4 and sum(b["pictures"] for b in bands) == len(SCORES)
    assert [b["from"] for b in bands] == [6, 12, 14, 18] and bands[0]["to"] == 9
    both = [24.0, 21.0]  # field at 6 and 9 degrees
    assert bands[0]["psnr"] == together([both[0], both[0], both[1], both[1]])
    assert all(b["psnr"] > b["blend_psnr"] for b in bands)
    assert by_angle(()) == [] and len(by_angle(SCORES[:2])) == 1


def test_the_page_has_a_section_and_metrics_have_the_figures(tmp_path: Path) -> None:
    metrics, page = report(tmp_path, field_in(tmp_path))
    found = metrics["reflectance"]
    assert found["present"] and found["left_out_psnr"] == 21.5 and len(found["pictures"]) == 10
    assert found["by_angle"] == by_angle(SCORES) and found["quick_psnr"] == 33.3
    assert "<h2>Reflectance field</h2>" in page and "21.5 dB" in page and "17.2 dB" in page
    section = page[page.index("Reflectance field</h2>") : page.index("<h2>Cameras and masks")]
    assert section.count("<circle") == 20 and "Worst: light 31" in section and "by 64 lamps (--quick)" in section
    assert "seen by camera 2, 18 degrees from the nearest light" in section and "0.17 of the time" in section
    pictures = [
        cv2.imdecode(np.frombuffer(base64.b64decode(m), np.uint8), 1) for m in re.findall(r"base64,([^\"]+)\"", section)
    ]
    assert [p.shape for p in pictures] == [(20, 30, 3)] * 3
    truth, field, off = (p.astype(float) for p in pictures)
    assert abs(truth.mean() - 128) < 2 and abs(field[:, :13].mean() - 128) < 3 and abs(field[:, 17:].mean() - 102) < 3
    assert off[:, :13].mean() < 6 and off[:, 17:].mean() > 60


def test_other_captures_have_no_section(tmp_path: Path) -> None:
    metrics, page = report(tmp_path, None)
    assert metrics["reflectance"] == {"present": False} and "Reflectance field" not in page


def test_a_field_without_left_out_lights_says_so(tmp_path: Path) -> None:
    _, page = report(tmp_path, field_in(tmp_path, left_out=(), predicted=(), shown=(), figures={"seen": 0.7}))
    assert "No light was left out of the fit" in page and "degrees to the nearest light" not in page


def test_a_left_out_camera_and_single_angles(tmp_path: Path) -> None:
    figures = {"left_out_psnr": 21.0, "blend_psnr": 17.0, "left_out_angle": 0.0, "left_out_camera_psnr": 19.0}
    found = field_in(tmp_path, figures=figures, cameras=(2,), predicted=SCORES[:1], shown=())
    shown = shown_field(found, 100)
    assert shown is not None and shown.headline[-1][0] == "19.0 dB" and not shown.quick and not shown.rows
    assert field_figures(found.artifact)["cameras_left_out"] == [2]
    standard = shown_field(field_in(tmp_path, figures=figures | {"openpbr_psnr": 20.04}, shown=()), 100)
    assert standard is not None and ("20.0 dB", "PSNR, OpenPBR") in [h[:2] for h in standard.headline]
    alone = plot((LeftOutPicture(camera=0, light=0, angle=0, psnr=20, blend_psnr=20),))
    assert "nan" not in alone and alone.count("<circle") == 2
