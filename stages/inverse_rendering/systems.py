"""Whose method: ours, or the paper's own. The one door to stages.inverse_rendering.paper, which is loaded only where
it is asked for. Importing this is light: settings are checked without torch."""

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
    """A fit that has not begun, by the settings' method. prior: the surface that any relief is judged against."""
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
