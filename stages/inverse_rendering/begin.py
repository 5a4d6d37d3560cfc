"""A fit that has not begun: the model that settings, photos and a start ask for, and its trainer."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import GridSdf
from pipeline.fields.spec import FaceSpec
from stages.inverse_rendering.choices import own_parts, teach
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.settings import FitSettings
from stages.inverse_rendering.start import Start
from stages.inverse_rendering.views import PhotoView, PixelTable

ALBEDO_START = 0.4  # mean over the channels, whose ratios are the photos'


def new_trainer(
    views: list[PhotoView],
    start: Start,
    settings: FitSettings,
    calibrated: bool,
    device: str,
    prior: Start | None = None,
) -> Trainer:
    """A fit that has not begun: geometry from the start, an even white light, grey skin. prior: the surface that any
    relief is judged against, where the photos have already moved the start away from it."""
    torch.manual_seed(settings.seed)
    spec = spec_for(views, start, settings, calibrated, device)
    values = torch.from_numpy(start.values.copy())  # a start that is the prior stays what it was
    grid = GridSdf(values, torch.from_numpy(start.lo.astype(np.float32)), start.cell)
    model = FaceModel(spec, grid)
    if settings.judges and settings.basis_inputs == "cosine":
        teach(own_parts(model)[1])
    model.to(device)
    grid.to_device(device)
    return Trainer(views, settings, device, model, prior or start)


def spec_for(views: list[PhotoView], start: Start, settings: FitSettings, calibrated: bool, device: str) -> FaceSpec:
    """What the settings make of these photos and this start."""
    colour = PixelTable(views, 256, device).mean_colour()
    grey = float(colour.mean().clamp(min=1e-4))
    lo, hi = start.lo, start.lo + (np.array(start.values.shape) - 1) * start.cell
    coarse = float((hi - lo).max()) / 16
    return FaceSpec(
        lo=_triple(lo),
        hi=_triple(hi),
        views=len(views),
        rank=settings.first_rank,
        light_order=settings.first_order,
        light_start=grey / ALBEDO_START,
        albedo_start=_triple((colour / grey * ALBEDO_START).clamp(0.02, 0.95).cpu().numpy()),
        attenuation=settings.attenuation,
        basis_inputs=settings.basis_inputs,
        density=settings.density,
        volumetric=settings.volumetric,
        specular=settings.specular != "off",
        shadows=settings.shadows,
        calibrated=calibrated,
        levels=settings.hash_levels,
        log2_size=settings.hash_log2_size,
        coarse=coarse,
        fine=settings.hash_fine if coarse / 1024 < settings.hash_fine < coarse / 2 else coarse / 20,
        width=settings.width,
        depth=settings.depth,
        appearance=settings.appearance,
        shading=settings.shading,
        light=settings.light,
        integral=settings.integral,
        basis_width=settings.basis_width,
        basis_depth=settings.basis_depth,
        prior=settings.prior,
        prior_scale=settings.prior_scale,
        prior_centre=settings.prior_centre,
    )


def _triple(v: npt.NDArray[np.floating]) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
