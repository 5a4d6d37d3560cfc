"""Photos of one textured, glossy ball under any light of low order: two captures of it differ in their light alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from pipeline.fields.appearance import TYPICAL_INV_KAPPA
from pipeline.maths import sh
from pipeline.maths.vmf import ATTENUATIONS
from pipeline.transforms import F64
from stages.inverse_rendering.light_estimate import reflectance
from stages.inverse_rendering.ray_sampling import PhotoView
from tests.support.balls import ball_photo, texture

ORDER = 3


def lamp(toward: tuple[float, float, float], colour: tuple[float, float, float], ambient: float = 0.6) -> F64:
    """((ORDER + 1)^2, 3) coefficients of a soft lamp in a direction, over an even light."""
    d = np.array(toward) / np.linalg.norm(toward)
    soft = np.exp(-np.repeat(np.arange(ORDER + 1), 2 * np.arange(ORDER + 1) + 1) * 0.5)
    basis = sh.sh_basis(torch.from_numpy(d[None]), ORDER).numpy()[0] * soft
    out = np.asarray(2.5 * basis[:, None] * np.array(colour), np.float64)
    out[0] += ambient * math.sqrt(4 * math.pi)
    return out


FIRST = lamp((0.6, 0.5, 0.7), (1.0, 1.0, 1.0))
SECOND = lamp((-0.9, 0.1, 0.3), (1.2, 1.0, 0.7))


def radiance(n: F64, wo: F64, light: F64) -> F64:
    """(N, 3) at unit normals n, towards wo (N, 3)."""
    c = torch.from_numpy(light)
    cosine = (n * wo).sum(1)
    mirror = 2 * cosine[:, None] * n - wo
    falls = ATTENUATIONS["exponential"](torch.full((1,), TYPICAL_INV_KAPPA, dtype=torch.float64), ORDER).numpy()
    spread = np.repeat(falls[0], 2 * np.arange(ORDER + 1) + 1)
    arrives = sh.irradiance(c, torch.from_numpy(n)).numpy()
    shiny = sh.sh_basis(torch.from_numpy(mirror), ORDER).numpy() * spread @ light
    return np.asarray(texture(n) / np.pi * arrives + reflectance(cosine.clip(0, 1))[:, None] * shiny, np.float64)


def photos(light: F64, views: int, *, second: bool = False, turn: float = 0.0) -> list[PhotoView]:
    """Views evenly around the ball. second: marked as of the second capture. turn: of the cameras, rad."""
    out = []
    for index in range(views):
        view = ball_photo(index, views, lambda n, wo: radiance(n, wo, light), turn)
        out.append(replace(view, index=index + 100, second=True) if second else view)
    return out
