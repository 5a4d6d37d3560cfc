"""Choice between our own fit and the systems that the paper compares, by the preset. Only this module imports
stages.inverse_rendering.paper, and only when it is used. It does not import torch itself, so that settings are checked
quickly."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from pipeline.artifacts import Camera, Extent
    from pipeline.fields.face import FaceModel
    from stages.inverse_rendering.config import Config
    from stages.inverse_rendering.given_light import GivenLight
    from stages.inverse_rendering.initial_geometry import F32, Start
    from stages.inverse_rendering.moving_light import LightFrame
    from stages.inverse_rendering.paper.config import PaperConfig
    from stages.inverse_rendering.ray_sampling import PhotoView, Rays
    from stages.inverse_rendering.second_capture import Second
    from stages.inverse_rendering.training_loop import TrainingLoop

COMPARED = ("paper", "comparison")  # presets with the settings of paper/config.py


def paper_config() -> type[PaperConfig]:
    """The settings of the paper's model and of the systems that it compares."""
    from stages.inverse_rendering.paper.config import PaperConfig

    return PaperConfig


def first_surface(
    settings: Config, cameras: list[Camera], alphas: list[F32], radius: float, extent: Extent | None
) -> Start:
    """The initial geometry of these settings. radius: of the region of interest, asset units."""
    if settings.preset not in COMPARED:
        from stages.inverse_rendering.initial_geometry import hull_start

        return hull_start(cameras, alphas, radius, settings.grid_cells, settings.levels, extent)
    from stages.inverse_rendering.paper import comparison

    return comparison.first_surface(of_the_paper(settings), cameras, alphas, radius, extent)


def of_the_paper(settings: Config) -> PaperConfig:
    """The settings by their own class."""
    assert isinstance(settings, paper_config())
    return settings


def trainer_for(
    views: list[PhotoView],
    start: Start,
    settings: Config,
    calibrated: bool,
    device: str,
    prior: Start,
    light: GivenLight | None = None,
    lit: LightFrame | None = None,
    second: Second | None = None,
) -> TrainingLoop:
    """A new trainer for these settings. prior: the surface with which refined geometry is compared. light: if it is
    known; lit: where the light stands still, None for a still light; second: photos under another light. These three
    are of our own fit only."""
    if settings.preset not in COMPARED:
        from stages.inverse_rendering.initialise import new_trainer

        return new_trainer(views, start, settings, calibrated, device, prior, light, lit, second)
    paper = of_the_paper(settings)
    if paper.method == "fast":
        from stages.inverse_rendering.paper.comparison import new_compared_trainer

        return new_compared_trainer(views, start, paper, calibrated, device, prior)
    from stages.inverse_rendering.paper.trainer import new_paper_trainer

    return new_paper_trainer(views, start, paper, calibrated, device)


def render_any(model: FaceModel, rays: Rays, samples: int) -> tuple[Tensor, Tensor]:
    """Premultiplied linear colour (N, 3) and opacity (N,) of rays, rendered as the model was fitted."""
    if model.spec.geometry == "grid":
        from stages.inverse_rendering.render import render_rays

        return render_rays(model, rays, samples)
    from stages.inverse_rendering.paper.render import render_all

    return render_all(model, rays, samples)
