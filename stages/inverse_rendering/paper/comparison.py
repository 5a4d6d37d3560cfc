"""Our fit with single parts of the systems that the paper compares, and its initial geometry without a prior."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from pipeline.artifacts import Camera, Extent
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initial_geometry import MARGIN_CELLS, Start, hull_start
from stages.inverse_rendering.initialise import grid_model, trainer_of
from stages.inverse_rendering.model_selection import own_parts, pretrain_basis
from stages.inverse_rendering.paper.config import PaperConfig
from stages.inverse_rendering.ray_sampling import PhotoView

F32 = npt.NDArray[np.float32]
SPHERE = 0.6  # share of the region of interest's radius


def new_compared_trainer(
    views: list[PhotoView],
    start: Start,
    settings: PaperConfig,
    calibrated: bool,
    device: str,
    prior: Start | None = None,
) -> Trainer:
    """A new trainer of method fast. Only bases that depend on wo . n alone are trained in advance, as ours are."""
    torch.manual_seed(settings.seed)
    model = grid_model(views, start, settings, calibrated, device)
    if settings.has_own_parts and settings.basis_inputs == "cosine":
        pretrain_basis(own_parts(model)[1])
    return trainer_of(model, views, start, settings, device, prior)


def first_surface(
    settings: PaperConfig, cameras: list[Camera], alphas: list[F32], radius: float, extent: Extent | None
) -> Start:
    """The initial geometry of the settings' prior; the codes of ImFace are fitted to a head in the hull's box."""
    if settings.prior == "sphere":
        return sphere_start(radius, settings.grid_cells, settings.levels)
    return hull_start(cameras, alphas, radius, settings.grid_cells, settings.levels, extent)


def sphere_start(radius: float, cells: int, levels: int) -> Start:
    """A sphere of SPHERE times `radius`, the region of interest's (asset units): an initial geometry without a
    prior."""
    cell = 2 * radius / cells * 2 ** (levels - 1)
    n = int(np.ceil(radius / cell)) + MARGIN_CELLS
    axis = (np.arange(-n, n + 1) * cell).astype(np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    values = np.sqrt(x * x + y * y + z * z) - SPHERE * radius
    return Start(values.astype(np.float32), np.full(3, axis[0], np.float32), cell)
