"""The whole stage on a few photos of a ball: its findings, and that judging takes no part in the fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts import Camera, CameraSet, FileRef, FittedFace, Located, MaskSet, ViewMask
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.contract import Context
from pipeline.images import write_png, write_png_from_linear
from pipeline.transforms import rows
from stages.inverse_rendering import judge
from stages.inverse_rendering.stage import Config, Inputs, run
from tests.support.small_ball import SMALL, ball_view

COUNT = 12
SETTINGS = {k: v for k, v in SMALL.model_dump().items() if k in Config.model_fields and k != "stereo"}


def inputs(folder: Path, wrong: int | None = None) -> Inputs:
    """Photos of the ball; `wrong` shows it from the other side, at its own camera's place."""
    views, cameras, masks = [], [], []
    for i in range(COUNT):
        photo = ball_view(i)
        shown = photo.rgb[::-1, ::-1] * 0.3 if i == wrong else photo.rgb
        write_png_from_linear(folder / f"{i}.png", shown)
        write_png(folder / f"m{i}.png", photo.alpha)
        image, mask = (FileRef.of(folder, f"{n}.png") for n in (f"{i}", f"m{i}"))
        views.append(CaptureView(index=i, name=f"p{i}.png", image=image, width=64, height=64, holdout=i == 5))
        masks.append(ViewMask(index=i, mask=mask, source="given", coverage=0.3))
        cameras.append(
            Camera(index=i, name=f"p{i}.png", width=64, height=64, K=rows(photo.K),
                   world_from_cam=rows(photo.world_from_cam), distortion=(0.0,) * 5)
        )  # fmt: skip
    poses = CameraSet(
        source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.14, cameras=tuple(cameras)
    )
    found = Capture(kind="photos", views=tuple(views)), poses, MaskSet(masks=tuple(masks))
    return Inputs(*(Located(a, folder) for a in found))  # type: ignore[arg-type]


def fitted(folder: Path, wrong: int | None = None) -> FittedFace:
    folder.mkdir()
    made: FittedFace = run(inputs(folder, wrong), Config(**SETTINGS, stereo=False), Context(folder, folder))
    return made


@pytest.mark.slow
def test_findings_of_a_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = {f.check: f for f in fitted(tmp_path / "a").findings}
    assert {"start_silhouette", "fit_error", "worst_views", "fit_missing", "fit_beyond", "psnr_fell"} <= set(whole)
    assert "fit_error_face" not in whole  # no labels
    assert {whole[c].level for c in ("start_silhouette", "fit_error", "worst_views", "fit_missing")} == {"good"}
    ruined = {f.check: f for f in fitted(tmp_path / "b", wrong=7).findings}
    assert ruined["worst_views"].level != "good" and ruined["worst_views"].views == ("p7.png",)

    def nothing(f: Any) -> tuple[()]:
        return ()

    monkeypatch.setattr(judge, "findings", nothing)
    monkeypatch.setattr("stages.inverse_rendering.residuals.view_errors", lambda *a, **k: ())
    plain = fitted(tmp_path / "c")
    again = [(tmp_path / f / "field.npz").read_bytes() for f in "ac"]
    assert plain.findings == () and again[0] == again[1]
