"""Maps of a light stage take the place of what was fitted to photos: values between texels, and the whole stage."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import FileRef, Located
from pipeline.contract import Context
from pipeline.eyes.mirror import Cornea, stored
from pipeline.images import read_exr, write_exr
from pipeline.meshes import unit
from pipeline.reflectance_artifacts import ReflectanceField
from stages.bake.lit import Measured, measured_of, with_corneas
from stages.bake.stage import Config, Inputs, run
from tests.bake.test_bake_stage import inputs  # noqa: F401  (a fixture)
from tests.support.ball_head import no_field

SIDE = 16


def field_of(folder: Path) -> Located[ReflectanceField]:
    """Base colours that rise along the row, F0 .02, roughness .3, normals of a ball, left half seen."""
    x = np.broadcast_to((np.arange(SIDE) + 0.5) / SIDE, (SIDE, SIDE))
    five = np.stack([0.2 + 0.5 * x, 0.2 + 0 * x, 0.1 + 0 * x, 0.02 + 0 * x, 0.3 + 0 * x], 2)
    up = np.broadcast_to([0.0, 0, 1], (SIDE, SIDE, 3))
    write_exr(folder / "reflectance/openpbr.exr", five.astype(np.float32), tuple(f"c{i}" for i in range(5)), half=True)
    write_exr(folder / "reflectance/normal.exr", up.astype(np.float32), ("c0", "c1", "c2"), half=True)
    write_exr(folder / "reflectance/coverage.exr", (x < 0.5).astype(np.float32)[..., None], half=True)
    files = tuple(FileRef.of(folder, f"reflectance/{n}.exr") for n in ("openpbr", "normal", "coverage"))
    return Located(ReflectanceField(present=True, files=files, size=SIDE), folder)


def test_values_between_texels_are_bilinear(tmp_path: Path) -> None:
    """Oracle: a linear ramp stays one between the texels' centres, and is cut at the outermost ones."""
    found = measured_of(field_of(tmp_path), 64)
    assert found is not None
    texel = np.arange(64) + 64 * 20
    place = ((np.arange(64) + 0.5) / 64).clip(0.5 / SIDE, 1 - 0.5 / SIDE)
    np.testing.assert_allclose(found.at(texel)[:, 0], 0.2 + 0.5 * place, atol=1e-3)
    rows = Measured(np.arange(SIDE, dtype=np.float32)[:, None, None] * np.ones((1, SIDE, 9), np.float32), SIDE)
    np.testing.assert_allclose(rows.at(np.array([0, 5 * SIDE, SIDE * SIDE - 1]))[:, 0], [0, 5, SIDE - 1])


def test_corneas_reflect_as_spheres(tmp_path: Path) -> None:
    """Oracle: on a sphere's front half the normals are those of the sphere; elsewhere nothing changes."""
    side, centre, radius = 64, np.array([0.03, 0, 0.08]), 0.0078
    x, y = np.meshgrid(*[(np.arange(side) + 0.5) / side * 0.03 - 0.015] * 2)
    flat = np.stack([x + 0.03, -y, np.full_like(x, 0.08 + 0.007)], 2)  # a plane that cuts through the cornea's front
    surface = np.concatenate([flat, np.broadcast_to([0.0, 0, 1], flat.shape)], 2).astype(np.float32)
    values = np.concatenate([np.full((side, side, 3), 0.4), np.full((side, side, 1), 0.02),
                             np.full((side, side, 1), 0.5), surface[..., 3:], np.ones((side, side, 1))], 2)  # fmt: skip
    rng = np.random.default_rng(0)
    normals = unit(rng.normal(size=(20_000, 3)) * 0.4 + [0, 0, 1])
    cornea = Cornea(centre, radius, 0.035, normals, (normals[:, 2] > 0.8).astype(float))
    found = with_corneas(values.astype(np.float32), surface, [cornea])
    away = flat - centre
    n = away / np.linalg.norm(away, axis=2, keepdims=True)
    wet, dry = n[..., 2] > 0.92, n[..., 2] < 0.65
    assert wet.sum() > 100 and dry.sum() > 100
    np.testing.assert_allclose(found[wet][:, 5:8], n[wet], atol=2e-3)
    np.testing.assert_allclose(found[wet][:, 3:5], np.broadcast_to([0.035, 0.1], (wet.sum(), 2)), rtol=1e-3)
    np.testing.assert_allclose(found[dry], values[dry], atol=1e-6)
    np.testing.assert_array_equal(found[..., :3], values[..., :3].astype(np.float32))
    behind = surface * np.array([1, 1, 1, -1, -1, -1], np.float32)  # the back of a thin sheet is none
    np.testing.assert_allclose(with_corneas(values.astype(np.float32), behind, [cornea]), values, atol=1e-6)
    far = surface + np.array([0, 0, 0.02, 0, 0, 0], np.float32)
    np.testing.assert_allclose(with_corneas(values.astype(np.float32), far, [cornea]), values, atol=1e-6)
    np.testing.assert_allclose(with_corneas(values.astype(np.float32), surface, []), values, atol=1e-6)


def test_corneas_are_read_with_the_maps(tmp_path: Path) -> None:
    field = field_of(tmp_path)
    surface = np.zeros((SIDE, SIDE, 6), np.float32)
    surface[..., 2], surface[..., 5] = 0.0078, 1
    write_exr(tmp_path / "reflectance/surface.exr", surface, tuple(f"c{i}" for i in range(6)))
    cornea = Cornea(np.zeros(3), 0.0078, 0.035, np.array([[0.0, 0, 1]]), np.ones(1))
    (tmp_path / "reflectance/basis.json").write_text(json.dumps({"corneas": stored([cornea])}))
    more = tuple(FileRef.of(tmp_path, f"reflectance/{n}") for n in ("surface.exr", "basis.json"))
    both = field.artifact.model_copy(update={"files": field.artifact.files + more})
    found = measured_of(Located(both, tmp_path), 64)
    assert found is not None and found.values[..., 3].min() == pytest.approx(0.035, rel=1e-3)


def test_other_captures_have_none(tmp_path: Path) -> None:
    assert measured_of(no_field(tmp_path), 64) is None
    older = Located(ReflectanceField(present=True), tmp_path)  # of a version without this map
    assert measured_of(older, 64) is None


def test_the_maps_are_those_of_the_light_stage(inputs: Inputs, tmp_path: Path) -> None:  # noqa: F811
    for name in ("work", "scratch"):
        (tmp_path / name).mkdir()
    given = replace(inputs, reflectance=field_of(tmp_path))
    made = run(given, Config(size=256, fit_standard=False), Context(tmp_path / "work", tmp_path / "scratch"))
    read = {n: read_exr(tmp_path / "work" / made.maps[n].files["exr"].path)[0] for n in ("f0", "roughness", "coverage")}
    inside = read["coverage"][..., 0] > 0
    assert read["f0"][inside].max() == pytest.approx(0.02, abs=1e-4)
    assert read["roughness"][inside].min() == pytest.approx(0.3, abs=1e-3)
    right = np.broadcast_to(np.arange(256) > 256 * 0.53, inside.shape)
    left = np.broadcast_to(np.arange(256) < 256 * 0.47, inside.shape)
    assert (read["coverage"][inside & left] == 1).all() and (read["coverage"][inside & right] == 0.5).all()
    assert made.standard_fitted and made.maps["albedo"].mean != pytest.approx(made.maps["neuface_albedo"].mean)
