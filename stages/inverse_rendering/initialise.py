"""The initial model and its trainer, from settings, photos and initial geometry."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import numpy.typing as npt
import torch

from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import GridSdf, grid_of
from pipeline.fields.spec import FaceSpec
from pipeline.maths.light_frame import WORLD
from pipeline.maths.sh import count
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.given_light import GivenLight
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.model_selection import own_parts, pretrain_basis
from stages.inverse_rendering.moving_light import LightFrame, first_light
from stages.inverse_rendering.ray_sampling import PhotoView, PixelTable
from stages.inverse_rendering.second_capture import Second

# Fields of FaceSpec that are computed from settings, or that only the paper's model has with that meaning.
DERIVED = {"rank", "light_order", "specular", "hash_fine", "prior", "light_frame", "second_views", "second_calibrated"}
ALBEDO_START = 0.4  # mean over the channels; their ratios are those of the photos


def new_trainer(
    views: list[PhotoView],
    start: Start,
    settings: Config,
    calibrated: bool,
    device: str,
    prior: Start | None = None,
    light: GivenLight | None = None,
    lit: LightFrame | None = None,
    second: Second | None = None,
) -> Trainer:
    """A new trainer: geometry from `start`, a uniform white light, the given one or the moving one of `lit`, a uniform
    albedo. prior: the surface with which refined geometry is compared, if stereo has already moved `start`. second:
    photos of the subject under another light, which are fitted as well."""
    torch.manual_seed(settings.seed)
    model = grid_model(views, start, settings, calibrated, device, light, lit, second)
    if lit is not None and lit.flux is not None:
        part = own_parts(model)[2]
        with torch.no_grad():
            first = torch.from_numpy(first_light(lit.flux, model.spec.light_order)).to(part.coefficients)
            part.coefficients.copy_(model.spec.light_start * first[:, None].expand_as(part.coefficients))
    pretrain_basis(own_parts(model)[1])
    found = trainer_of(model, views + (second.views if second else []), start, settings, device, prior)
    found.light_given = light.source if light else ""
    return found


def grid_model(
    views: list[PhotoView],
    start: Start,
    settings: Config,
    calibrated: bool,
    device: str,
    light: GivenLight | None = None,
    lit: LightFrame | None = None,
    second: Second | None = None,
) -> FaceModel:
    """A new model on a grid of `start`, on the CPU. device: where the photos are read."""
    spec = spec_for(views, start, settings, calibrated, device)
    if second is not None:  # the same albedo: where its photos are brighter, so is its light
        own = PixelTable(second.views, 256, device).mean_colour() / torch.tensor(spec.albedo_start, device=device)
        start_of_second = _triple(own.cpu().numpy())
        spec = replace(
            spec,
            second_views=len(second.views),
            second_calibrated=second.calibrated,
            second_light_start=start_of_second,
        )
    if lit is not None and lit.frame != WORLD:  # what shades the subject from one side moves as well
        spec = replace(spec, light_frame=lit.frame, light_distance=lit.distance, shadows=False)
    values = torch.from_numpy(start.values.copy())  # a copy, because the start may also be the prior
    grid = GridSdf(values, torch.from_numpy(start.lo.astype(np.float32)), start.cell)
    if light is None:
        return FaceModel(spec, grid)
    coefficients, albedo = put(light, spec)
    model = FaceModel(replace(spec, albedo_start=albedo), grid)
    with torch.no_grad():
        own_parts(model)[2].coefficients.copy_(torch.from_numpy(coefficients))
    return model


def put(light: GivenLight, spec: FaceSpec) -> tuple[npt.NDArray[np.float64], tuple[float, float, float]]:
    """Coefficients (K, 3) of a given light in the photos' unit, and the albedo at which the subject has the photos'
    mean colour under its mean radiance. Without a scale it is as bright as the uniform light of other fits."""
    c = light.coefficients[: count(spec.light_order)]
    mean = c[0] / np.sqrt(4 * np.pi)  # of the radiance over the sphere
    if not light.scaled:
        factor = spec.light_start / max(float(mean.mean()), 1e-12)
        c, mean = c * factor, mean * factor
    colour = np.array(spec.albedo_start) * spec.light_start
    return c, _triple(np.clip(colour / np.maximum(mean, 1e-12), 0.02, 0.95))


def trainer_of(
    model: FaceModel, views: list[PhotoView], start: Start, settings: Config, device: str, prior: Start | None
) -> Trainer:
    """A trainer of a model on a grid, which is moved to the device."""
    model.to(device)
    grid_of(model.geometry).to_device(device)
    return Trainer(views, settings, device, model, prior=prior or start)


def spec_for(views: list[PhotoView], start: Start, config: Config, calibrated: bool, device: str) -> FaceSpec:
    """The specification of the model for these settings, photos and initial geometry."""
    colour = PixelTable(views, 256, device).mean_colour()
    grey = float(colour.mean().clamp(min=1e-4))
    lo, hi = start.lo, start.lo + (np.array(start.values.shape) - 1) * start.cell
    coarse = float((hi - lo).max()) / 16
    same = {f.name: getattr(config, f.name) for f in fields(FaceSpec) if f.name in type(config).model_fields}
    return FaceSpec(
        **{name: value for name, value in same.items() if name not in DERIVED},
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
