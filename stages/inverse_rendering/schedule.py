"""The schedule of the fit: the shares of its steps at which something is due, and the learning rates of each step."""

from __future__ import annotations

from typing import Protocol

import torch

from pipeline.fields.appearance import SpatialField
from pipeline.fields.face import FaceModel
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.model_selection import Choices

LEVEL_STARTS = {1: (0.0,), 2: (0.0, 0.3), 3: (0.0, 0.12, 0.35), 4: (0.0, 0.1, 0.25, 0.5)}
UNIFORM_FROM = 0.3  # share of the fit at which the light-only phase with uniform albedo begins
OPEN_FROM = 0.4  # share of the encoding's levels, coarse first, that are active at the start
OPEN_UNTIL = 0.5  # share of the fit after which all levels are active
UNIFORM_LIGHT_ORDER = 3  # diffuse skin determines hardly more of a light
UNIFORM_LIGHT_RATE = 10.0  # factor of the light's rate in the light-only phase
KNOWN_LIGHT_RATE = 0.1  # factor of the light's rate if the light is known from the lobe
DRIFT_STEPS = 1300  # of a draft: in a longer fit, a light that nothing tells moves no farther than there
SETTLING = 0.03  # share of the fit after the light-only phase in which the surface is frozen
SHADOWS_AT = (0.3, 0.5, 0.7)  # shares of the fit at which shadows are solved again
SKIN_AT = 0.8  # share of the fit at which the light is corrected by the skin: the albedo is that of the light before


class Scheduled(Protocol):
    """The parts of a running fit that are read here."""

    settings: Config
    model: FaceModel
    optimiser: torch.optim.Optimizer
    choices: Choices | None
    step: int
    level: int
    light_given: str

    def share(self) -> float:
        """Finished share of the fit."""
        ...

    @property
    def light_moves(self) -> bool:
        """Whether the light moves relative to the subject."""
        ...

    @property
    def light_told(self) -> bool:
        """Whether skin, or a second capture, told the light's low bands."""
        ...

    @property
    def geometry_frozen(self) -> bool:
        """Whether the surface is frozen at the prior."""
        ...


def make_optimiser(model: FaceModel, settings: Config) -> torch.optim.Optimizer:
    """Adam over everything except the SDF, which has its own optimiser in the narrow band. eps is small, because most
    entries of the hash table rarely have a gradient."""
    spatial = hashed(model)
    groups = [
        {"params": [spatial.encoding.table], "start": settings.lr_appearance},
        {"params": [*spatial.net.parameters(), *model.basis.parameters()], "start": 0.3 * settings.lr_appearance},
        {"params": list(model.light.parameters()), "start": settings.lr_light},
        {"params": list(model.calibration.parameters()), "start": 0.1 * settings.lr_appearance},
    ]
    if model.ambient is not None:
        groups.append({"params": list(model.ambient.parameters()), "start": settings.lr_light})
    if model.second is not None:
        groups.append({"params": list(model.second.light.parameters()), "start": settings.lr_light})
    return torch.optim.Adam(groups, lr=1e-3, betas=(0.9, 0.99), eps=1e-15, fused=True)


def hashed(model: FaceModel) -> SpatialField:
    """The Spatial MLP with its hash encoding."""
    assert isinstance(model.spatial, SpatialField)
    return model.spatial


def set_rates(fit: Scheduled) -> float:
    """Set learning rates, beta and active encoding levels of this step; returns the SDF's rate in asset units.

    Differs: beta follows a geometric schedule down to `beta_end` cells of the finest grid and is not learnt: a
    learnt one stays near a millimetre and blurs silhouettes (docs/benchmarks.md).

    Between UNIFORM_FROM and `uniform_albedo_until`, a light that is known from the lobe (light_estimate.py) is
    frozen together with the surface, and the reflectance adapts to it; later it has a low rate. A given light is
    frozen throughout. If the lobe does not determine the light, everything except the light is frozen, and the
    albedo is uniform: the light, which was uniform at the start, explains the shading that was in the albedo
    before. Earlier, the surface is still wrong. From there on its rate falls with the steps of the fit: photos hardly
    tell such a light from the albedo, so that it would go the farther the longer the fit lasts.
    """
    s, p = fit.settings, fit.share()
    decay: float = 0.1 ** max((p - 0.3) / 0.7, 0.0)
    warm = min((fit.step + 1) / 50, 1.0)
    interlude = UNIFORM_FROM <= p < s.uniform_albedo_until and not fit.light_moves
    light_known = fit.light_given != "" or (fit.choices is not None and fit.choices.light_known)
    fit.model.uniform_albedo = interlude and not light_known
    drift = min(DRIFT_STEPS / s.steps, 1.0)
    second = None if fit.model.second is None else next(fit.model.second.light.parameters())
    for group in fit.optimiser.param_groups:
        other = group["params"][0] is second
        light = other or group["params"][0] is next(fit.model.light.parameters())
        group["lr"] = group["start"] * decay * warm
        if interlude and not light_known:
            group["lr"] *= UNIFORM_LIGHT_RATE * drift if light else 0.0
        elif light and (light_known or fit.light_told):
            frozen = interlude or (fit.light_given and not other)
            group["lr"] *= 0.0 if frozen else KNOWN_LIGHT_RATE
        elif light and p >= UNIFORM_FROM and not fit.light_moves:
            group["lr"] *= drift
    finest = fit.model.geometry.cell / 2 ** (len(LEVEL_STARTS[s.levels]) - 1 - fit.level)
    start, end = 0.5 * finest * 2 ** (len(LEVEL_STARTS[s.levels]) - 1), s.beta_end * finest
    fit.model.beta.fill_(start * (end / start) ** min(p / 0.8, 1.0))
    opened = OPEN_FROM + (1 - OPEN_FROM) * min(p / OPEN_UNTIL, 1.0)
    hashed(fit.model).encoding.open_levels(opened)
    # the reflectance adapts to the new light, not the surface
    settles = not fit.light_given and not fit.light_moves
    still = settles and UNIFORM_FROM <= p < s.uniform_albedo_until + SETTLING
    still |= fit.light_told and p < SKIN_AT + SETTLING
    return 0.0 if still or fit.geometry_frozen else s.lr_sdf * fit.model.geometry.cell * decay * warm
