"""One point of `neuface bench tradeoff`: run it up to the surface, and score it."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from stages.presets import DEFAULT_PRESET

if TYPE_CHECKING:
    from pipeline.fields.face import FaceModel

ALBEDO_VIEWS = 3
SCALED = ("steps", "batch")


@dataclass(frozen=True, slots=True)
class Knob:
    """A point: its name, and either the settings of inverse_rendering that differ from the middle, or a preset."""

    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    preset: str = ""


@dataclass(frozen=True, slots=True)
class Measured:
    """Seconds of the fit's stage, peak memory (MB); dB, -, - over held-out views; mm and dB against the truth if it is
    there (else NaN). Of the demo's capture also the split into diffuse and specular (workflows/evaluation/
    demo_material.py): correlation and median error of F0 and of roughness, correlation of the light."""

    seconds: float
    memory_mb: float
    psnr: float
    ssim: float
    flip: float
    chamfer: float
    albedo: float
    f0: float | None = None
    f0_error: float | None = None
    roughness: float | None = None
    roughness_error: float | None = None
    light: float | None = None


def settings_of(knob: Knob, given: argparse.Namespace) -> tuple[str, ...]:
    """Settings as for `--set`: the budget, the whole model, and the knob; none for a preset."""
    if knob.preset:
        return ()
    values: dict[str, Any] = {
        "steps": given.steps,
        "image_side": given.side,
        "batch": given.batch,
        "grid_cells": given.cells,
        "rank": 3,
        "light_order": 10,
        "specular": "on",
        "refine_geometry": "on",
        "resolution": "given",
        "calibration": "off",
    }
    for k, v in knob.settings.items():
        values[k] = round(v * values[k]) if k in SCALED else v
    return (*(f"inverse_rendering.{k}={v}" for k, v in values.items()), "surface.resolution=160")


def measure(knob: Knob, given: argparse.Namespace) -> Measured:
    """Run a point up to the surface, or take it from the store, and score it."""
    import pipeline.threads  # noqa: F401  (before torch, as in the command line)
    from pipeline.fields.face import load_model
    from workflows.bench.ablations import chamfer
    from workflows.bench.rows import plan_of
    from workflows.run.runner import run_stages

    plan = plan_of(given, settings_of(knob, given), knob.preset or DEFAULT_PRESET)
    done = {d.stage: d for d in run_stages(plan)}
    found: dict[str, Any] = {name: d.located for name, d in done.items()}
    fit = done["inverse_rendering"].run
    model = load_model(found["inverse_rendering"].path(found["inverse_rendering"].artifact.field))
    mean = looks(found, model, given.side, plan.configs["inverse_rendering"].model_dump()["samples"])
    folder = Path(given.capture)
    return Measured(
        float(fit["seconds"]),
        float(fit["peak_memory_mb"]),
        float(mean[0]),
        float(mean[2]),
        float(mean[3]),
        chamfer(found, folder),
        albedo_error(found, model, folder),
        **split_of(found, folder),
    )


def split_of(found: dict[str, Any], folder: Path) -> dict[str, float | None]:
    """The last fields of `Measured`, None for a correlation with a constant; nothing if the capture is not the
    demo's."""
    import tempfile

    from pipeline.demo.capture import MARKER
    from pipeline.transforms import matrix
    from workflows.evaluation.demo_material import compare

    if not (folder / MARKER).is_file():
        return {}
    fitted, place = found["inverse_rendering"], matrix(found["poses"].artifact.capture_from_asset)
    with tempfile.TemporaryDirectory() as scratch:
        field = fitted.path(fitted.artifact.field)
        truth = compare(field, folder, found["capture"].artifact, place, Path(scratch))
    figures = {
        "f0": truth.f0.correlation,
        "f0_error": truth.f0.error,
        "roughness": truth.roughness.correlation,
        "roughness_error": truth.roughness.error,
        "light": truth.light_correlation,
    }
    return {k: v if math.isfinite(v) else None for k, v in figures.items()}


def looks(found: dict[str, Any], model: FaceModel, side: int, samples: int) -> npt.NDArray[np.float64]:
    """Mean PSNR, aligned PSNR, SSIM and FLIP over the held-out views, rendered at `side` pixels whatever the fit's own
    resolution was: a smaller picture is easier to match."""
    from pipeline.colour import as_photographed
    from stages.inverse_rendering.load_views import camera_only
    from stages.inverse_rendering.outputs import predict_view
    from stages.inverse_rendering.ray_sampling import factor_for
    from workflows.bench.ablations import compared

    fitted = found["inverse_rendering"]
    cameras = {c.index: c for c in found["poses"].artifact.cameras}
    response = {h.index: h.response for h in fitted.artifact.held_out}
    out = []
    for view in found["capture"].artifact.views:
        if view.holdout and view.index in cameras:
            camera = cameras[view.index]
            factor = factor_for((camera.width, camera.height), side, exact=True)
            rgba = predict_view(model, camera_only(camera), factor, samples, "cpu")
            out.append(compared(as_photographed(rgba, response[view.index]), factor, view, found))
    return np.asarray(np.nanmean(np.array(out, np.float64), axis=0) if out else np.full(4, np.nan))


def albedo_error(found: dict[str, Any], model: FaceModel, folder: Path) -> float:
    """PSNR (dB, sRGB) of the fitted albedo against truth/albedo in some held-out views, after one gain for all
    channels, over pixels where both are; NaN without a truth."""
    import torch

    from pipeline.colour import srgb_from_linear
    from pipeline.images import read_exr
    from stages.inverse_rendering.load_views import camera_only
    from stages.inverse_rendering.observations import surface_points
    from stages.inverse_rendering.ray_sampling import Rays, image_rays

    fitted = found["inverse_rendering"]
    cameras = {c.index: c for c in found["poses"].artifact.cameras}
    mine, true = [], []
    for held in fitted.artifact.held_out[:: max(len(fitted.artifact.held_out) // ALBEDO_VIEWS, 1)]:
        path = folder / "truth" / "albedo" / f"{held.index}.exr"
        if not path.is_file():
            continue
        picture = read_exr(path)[0][..., :3]
        camera = cameras[held.index]
        rays = image_rays(camera_only(camera), camera.width // picture.shape[1], "cpu")
        flat = torch.from_numpy(np.ascontiguousarray(picture.reshape(-1, 3)))
        for i in torch.nonzero(flat.sum(1) > 0.02).squeeze(-1).split(65_536):
            x, hit = _met(model, Rays(rays.o[i], rays.d[i]), surface_points)
            with torch.no_grad():
                mine.append(model.spatial(x)[0])
            true.append(flat[i][hit])
    if not mine:
        return float("nan")
    a, b = torch.cat(mine), torch.cat(true)
    a = a * ((a * b).sum() / (a * a).sum())
    error = float(((srgb_from_linear(a.clamp(0, 1)) - srgb_from_linear(b.clamp(0, 1))) ** 2).mean())
    return -10 * math.log10(max(error, 1e-10))


def _met(model: Any, rays: Any, points: Any) -> tuple[Any, Any]:
    """Where rays meet the surface, and which of them do."""
    from pipeline.maths.tracing import box_interval

    near, far = box_interval(rays.o, rays.d, *model.geometry.box())
    _, hit, _ = model.geometry.trace(rays.o, rays.d, near, far)
    return points(model.geometry, rays)[0], hit & (far > near)
