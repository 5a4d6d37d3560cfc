"""A fit that has not begun: the model that settings, photos and a start ask for, and its trainer."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import numpy.typing as npt
import torch

from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import GridSdf
from pipeline.fields.spec import FaceSpec
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.model_selection import own_parts, pretrain_basis
from stages.inverse_rendering.ray_sampling import PhotoView, PixelTable

DERIVED = {"rank", "light_order", "specular", "hash_fine"}  # of a FaceSpec: what the settings say in part
SAME = ({f.name for f in fields(FaceSpec)} & Config.model_fields.keys()) - DERIVED  # what they say by the same name
ALBEDO_START = 0.4  # mean over the channels, whose ratios are the photos'


def new_trainer(
    views: list[PhotoView],
    start: Start,
    settings: Config,
    calibrated: bool,
    device: str,
    prior: Start | None = None,
) -> Trainer:
    """A fit that has not begun: geometry from the start, a uniform white light, grey skin. prior: the surface that any
    relief is judged against, where the photos have already moved the start away from it."""
    torch.manual_seed(settings.seed)
    spec = spec_for(views, start, settings, calibrated, device)
    values = torch.from_numpy(start.values.copy())  # a start that is the prior stays what it was
    grid = GridSdf(values, torch.from_numpy(start.lo.astype(np.float32)), start.cell)
    model = FaceModel(spec, grid)
    if settings.judges and settings.basis_inputs == "cosine":
        pretrain_basis(own_parts(model)[1])
    model.to(device)
    grid.to_device(device)
    return Trainer(views, settings, device, model, prior or start)


def spec_for(views: list[PhotoView], start: Start, config: Config, calibrated: bool, device: str) -> FaceSpec:
    """What the settings make of these photos and this start."""
    colour = PixelTable(views, 256, device).mean_colour()
    grey = float(colour.mean().clamp(min=1e-4))
    lo, hi = start.lo, start.lo + (np.array(start.values.shape) - 1) * start.cell
    coarse = float((hi - lo).max()) / 16
    same = {name: getattr(config, name) for name in SAME}
    return FaceSpec(
        **same,
        lo=_triple(lo),
        hi=_triple(hi),
        views=len(views),
        rank=config.first_rank,
        light_order=config.first_order,
        light_start=grey / ALBEDO_START,
        albedo_start=_triple((colour / grey * ALBEDO_START).clamp(0.02, 0.95).cpu().numpy()),
        specular=config.specular != "off",
        calibrated=calibrated,
        coarse=coarse,
        hash_fine=config.hash_fine if coarse / 1024 < config.hash_fine < coarse / 2 else coarse / 20,
    )


def _triple(v: npt.NDArray[np.floating]) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
