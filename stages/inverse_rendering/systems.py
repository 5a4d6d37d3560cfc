"""Choice between method fast and method paper. Only this module imports stages.inverse_rendering.paper, and only when
it is used. It does not import torch itself, so that settings are checked quickly."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from pipeline.fields.face import FaceModel
    from stages.inverse_rendering.config import Config
    from stages.inverse_rendering.fit import Trainer
    from stages.inverse_rendering.initial_geometry import Start
    from stages.inverse_rendering.ray_sampling import PhotoView, Rays


def trainer_for(
    views: list[PhotoView], start: Start, settings: Config, calibrated: bool, device: str, prior: Start
) -> Trainer:
    """A new trainer of the settings' method. prior: the surface with which refined geometry is compared."""
    if settings.method == "fast":
        from stages.inverse_rendering.initialise import new_trainer

        return new_trainer(views, start, settings, calibrated, device, prior)
    from stages.inverse_rendering.paper.trainer import new_paper_trainer

    return new_paper_trainer(views, start, settings, calibrated, device)


def render_any(model: FaceModel, rays: Rays, samples: int) -> tuple[Tensor, Tensor]:
    """Premultiplied linear colour (N, 3) and opacity (N,) of rays, rendered as the model was fitted."""
    if model.spec.geometry == "grid":
        from stages.inverse_rendering.render import render_rays

        return render_rays(model, rays, samples)
    from stages.inverse_rendering.paper.render import render_all

    return render_all(model, rays, samples)
