"""The bake stage through its contract."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline import meshes
from pipeline.artifacts import FileRef, Located, MaskSet, Surface, UvMesh, ViewMask
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.colour import srgb_from_linear
from pipeline.contract import Context
from pipeline.errors import Cancelled
from pipeline.fields.faired import Faired
from pipeline.images import read_encoded, read_exr, write_png
from pipeline.meshes import Charts, Mesh
from pipeline.visibility import seen_by
from stages.bake.stage import Config, Inputs, run
from stages.surface.build import build as surface_build
from stages.uv.config import Config as UvConfig
from stages.uv.decimate import decimated
from stages.uv.unwrap import unwrap
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.ball_head import no_field, no_head
from tests.support.field_artifacts import fitted, poses

PNG = {
    "albedo",
    "neuface_albedo",
    "irradiance_ratio",
    "specular_intensity",
    "roughness",
    "f0",
    "normal",
    "confidence",
    "coverage",
    "ambient_occlusion",
    "curvature",
    "cavity",
    "thickness",
    "measured",
}
ALL = PNG | {"specular_coefficients", "shininess", "inv_kappa", "displacement", "basis_lut"}


@cache
def mesh_and_charts() -> tuple[Mesh, Charts]:
    field = AnalyticField(sphere(0.08))
    mesh = decimated(surface_build(field, 32, lambda done, total: None).mesh, 800)
    return mesh, unwrap(mesh, UvConfig(texture_size=256, padding=2))


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Inputs:
    field = AnalyticField(sphere(0.08))
    mesh, charts = mesh_and_charts()
    meshes.save(tmp_path / "uv.npz", mesh, charts)
    uv = UvMesh(
        mesh=FileRef.of(tmp_path, "uv.npz"), vertices=len(mesh.vertices), faces=len(mesh.faces), charts=1,
        utilisation=0.5, stretch=1.0, overlap=0.0, deviation_mm=0.1,
    )  # fmt: skip
    write_png(tmp_path / "mask.png", np.ones((64, 64)))
    mask = ViewMask(index=1, mask=FileRef.of(tmp_path, "mask.png"), source="given", coverage=1.0)
    meshes.save(tmp_path / "surface.npz", mesh)
    surface = Surface(
        mesh=FileRef.of(tmp_path, "surface.npz"), vertices=len(mesh.vertices), faces=len(mesh.faces), watertight=True,
        components=1, removed_components=0, cell=0.005,
    )  # fmt: skip
    return Inputs(
        Located(surface, tmp_path),
        Located(uv, tmp_path),
        fitted(tmp_path, field, monkeypatch, views=3),
        poses(tmp_path),
        Located(MaskSet(masks=(mask,)), tmp_path),
        photographed(tmp_path),
        no_head(tmp_path),
        no_field(tmp_path),
    )


def photographed(folder: Path) -> Located[Capture]:
    """Photos of the four cameras in plain grey; the fourth is held out, and its file is missing."""
    for i in range(4):
        write_png(folder / f"{i}.png", np.full((64, 64, 3), 0.5))
    views = tuple(
        CaptureView(index=i, name=f"{i}.png", image=FileRef.of(folder, f"{i}.png"), width=64, height=64, holdout=i == 3)
        for i in range(4)
    )
    (folder / "3.png").unlink()
    return Located(Capture(kind="facescape", views=views), folder)


def test_the_maps_are_of_the_fair_surface_where_there_is_one(inputs: Inputs, tmp_path: Path) -> None:
    """Distances that put the zero set 4 mm further out, behind the mesh that is 0.2 mm beside the field's own."""
    lower, n, cell = np.full(3, -0.13), 27, 0.01
    at = lower + cell * np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1)
    phi = (np.linalg.norm(at, axis=-1) - 0.084).astype(np.float32)
    field = AnalyticField(sphere(0.08))
    Faired(field, lower, cell, phi, (at[..., 2] < 0).astype(np.float32)).save(tmp_path / "fairing.npz")
    fair = inputs.surface.artifact.model_copy(update={"fairing": FileRef.of(tmp_path, "fairing.npz")})
    textures = run(
        dataclasses.replace(inputs, surface=Located(fair, tmp_path)), Config(size=256), Context(tmp_path, tmp_path)
    )
    assert textures.lod_rms_mm["render"] == pytest.approx(4 * 0.5**0.5, abs=0.3)


def test_run_writes_every_map(inputs: Inputs, tmp_path: Path) -> None:
    textures = run(inputs, Config(size=256), Context(tmp_path, tmp_path))
    assert set(textures.maps) == ALL and textures.size == 256 and 0.3 < textures.coverage < 1
    for name, found in textures.maps.items():
        assert set(found.files) == ({"exr", "png"} if name in PNG else {"exr"})
        assert found.files["exr"].path == f"textures/{name}.exr"
        image, _ = read_exr(tmp_path / found.files["exr"].path)
        assert image.shape == ((1, 64, 3) if name == "basis_lut" else (256, 256, found.channels))
        assert np.isfinite(image).all() and found.minimum <= found.mean <= found.maximum
    assert read_encoded(tmp_path / "textures/f0.png").dtype == np.uint16
    # chords of 800 triangles on a ball of 80 mm: the sagitta of a triangle's side of 14 mm is 0.3 mm
    assert set(textures.lod_rms_mm) == {"render", "high"} and 0.05 < textures.lod_rms_mm["render"] < 0.4
    assert textures.lod_rms_mm["render"] == pytest.approx(textures.zero_set_rms_mm, rel=0.1)
    assert textures.maps["albedo"].space == "srgb_png" and textures.maps["normal"].space == "raw"
    covered = read_exr(tmp_path / "textures/coverage.exr")[0][..., 0] > 0
    rho = read_exr(tmp_path / "textures/specular_intensity.exr")[0][covered]
    assert textures.maps["specular_intensity"].mean == pytest.approx(float(rho.mean()), rel=1e-5)
    judged = {f.check: f for f in textures.findings}  # three cameras around a ball: no photo shows a face
    assert judged["unseen"].value == pytest.approx(textures.figures["unseen"], abs=1e-5)
    f0 = read_exr(tmp_path / "textures/f0.exr")[0][read_exr(tmp_path / "textures/coverage.exr")[0] == 1]
    assert judged["f0_mean"].value == pytest.approx(float(f0.mean()), rel=0.02) and "f0_none" not in judged
    png = read_encoded(tmp_path / "textures/roughness.png")[..., 0] / 255
    assert np.abs(png - read_exr(tmp_path / "textures/roughness.exr")[0][..., 0]).max() < 0.003


def test_manifest_is_the_same_twice(inputs: Inputs, tmp_path: Path) -> None:
    a, b = (run(inputs, Config(size=256), Context(tmp_path / x, tmp_path)) for x in "ab")
    assert a.canonical_json() == b.canonical_json()


def test_views_are_the_fitted_ones_with_their_masks(inputs: Inputs, tmp_path: Path) -> None:
    views = seen_by(inputs.inverse_rendering.artifact, inputs.poses.artifact, inputs.masks, inputs.capture)
    assert [v.photo for v in views] == [tmp_path / f"{i}.png" for i in range(3)]
    assert [v.camera.index for v in views] == [0, 1, 2]
    assert [v.mask for v in views] == [None, tmp_path / "mask.png", None]


def test_no_photo_that_was_held_out_is_ever_a_view(inputs: Inputs) -> None:
    """Not even if the fit should name it."""
    face = inputs.inverse_rendering.artifact.model_copy(update={"fitted_views": (0, 1, 2, 3)})
    views = seen_by(face, inputs.poses.artifact, inputs.masks, inputs.capture)
    assert [v.camera.index for v in views] == [0, 1, 2]


def test_photo_detail_can_be_left_out(inputs: Inputs, tmp_path: Path) -> None:
    made = {}
    for wanted in (True, False):
        folder = tmp_path / str(wanted)
        found = run(inputs, Config(size=256, detail=wanted), Context(folder, tmp_path))
        assert ("detail_support" in found.figures) == wanted and 0 < found.figures["unseen"] < 1
        made[wanted] = read_exr(folder / "textures/albedo.exr")[0]
        coverage = read_exr(folder / "textures/coverage.exr")[0]
        assert set(np.unique(coverage)) == {0, 0.5, 1}
    assert not np.array_equal(made[True], made[False])


def test_run_can_be_stopped(inputs: Inputs, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        run(inputs, Config(size=256), Context(tmp_path, tmp_path, cancelled=lambda: True))


@pytest.mark.parametrize("size", [0, 255, 16385])
def test_size_limits(size: int) -> None:
    with pytest.raises(ValidationError):
        Config(size=size)


def test_an_exposure_is_no_detail(inputs: Inputs, tmp_path: Path) -> None:
    """Photos half as bright, of half the exposure: the same detail, which plain photos have not."""
    pattern = np.random.default_rng(0).uniform(0.28, 0.32, (64, 64, 3))

    def albedo(exposure: float, values: np.ndarray) -> np.ndarray:
        views = []
        for v in inputs.capture.artifact.views:
            write_png(tmp_path / f"e{v.index}.png", srgb_from_linear(exposure * values), bits=16)
            image = FileRef.of(tmp_path, f"e{v.index}.png")
            views.append(v.model_copy(update={"image": image, "exposure": exposure}))
        capture = Located(Capture(kind="facescape", views=tuple(views)), tmp_path)
        out = tmp_path / f"out{exposure}{values.std():.4f}"
        out.mkdir()
        found = run(dataclasses.replace(inputs, capture=capture), Config(size=256), Context(out, out))
        return np.asarray(read_exr(out / found.maps["albedo"].files["exr"].path)[0])

    one, half, plain = albedo(1.0, pattern), albedo(0.5, pattern), albedo(1.0, np.full_like(pattern, 0.3))
    told = np.abs(one - plain).mean()
    assert told > 2e-4
    assert np.abs(one - half).mean() < 0.1 * told


def test_two_meshes_are_baked_one_after_the_other(inputs: Inputs, tmp_path: Path) -> None:
    from pipeline.store import file_refs

    uv = inputs.uv.artifact
    both = dataclasses.replace(inputs, uv=Located(uv.model_copy(update={"scan": uv}), inputs.uv.folder))
    (tmp_path / "out").mkdir()
    made = run(both, Config(size=256, detail=False), Context(tmp_path / "out", tmp_path))
    assert made.scan is not None and made.scan.scan is None and set(made.scan.maps) == set(made.maps)
    for name, one in made.maps.items():
        for kind, file in one.files.items():
            assert made.scan.maps[name].files[kind].path == f"scan/{file.path}"
            assert made.scan.maps[name].files[kind].sha256 == file.sha256
    assert all((tmp_path / "out" / f.path).is_file() for f in file_refs(made))
