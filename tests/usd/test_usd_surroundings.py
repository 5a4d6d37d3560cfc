"""The exported dome has what the photos show behind the subject."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from support.synthetic_asset import run_stage, write_inputs

from pipeline.artifacts import FileRef, Located
from pipeline.images import read_exr
from pipeline.lighting.captured import captured_environment
from pipeline.lighting.dome import read_light
from pipeline.lighting.surroundings import Surroundings
from pipeline.maths.latlong import latlong_directions


def test_the_dome_shows_the_surroundings_where_they_are_known(tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path / "in")
    d, folder = latlong_directions(64, 32), inputs.inverse_rendering.folder
    away = np.arccos(-d[..., 2].clip(-1, 1)).astype(np.float32) / 2
    radiance = np.broadcast_to(np.array([0.1, 0.3, 0.5], np.float32), (32, 64, 3))
    around = Surroundings(radiance, away, np.zeros_like(away), np.maximum(d[..., 2], 0).astype(np.float32))
    around.save(folder / "surroundings.npz")
    face = inputs.inverse_rendering.artifact.model_copy(update={"surroundings": FileRef.of(folder, "surroundings.npz")})
    asset = run_stage(replace(inputs, inverse_rendering=Located(face, folder)), tmp_path / "out")
    plain = run_stage(inputs, tmp_path / "plain")
    shown, before = (read_exr(tmp_path / n / "asset/environment.exr")[0][..., :3] for n in ("out", "plain"))
    known = around.share > 0.999
    np.testing.assert_allclose(shown[known], radiance[known], rtol=2e-3)
    assert np.abs(before[known] - radiance[known]).max() > 0.1
    expected = captured_environment(read_light(folder / inputs.inverse_rendering.artifact.light.path), 64, around)
    np.testing.assert_allclose(shown, expected, rtol=2e-3, atol=1e-3)
    assert "light_irradiance_error_seen" in asset.figures and "light_irradiance_error_seen" not in plain.figures
