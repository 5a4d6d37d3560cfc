"""Choice of the initial geometry: the visual hull, the hull cut by the head template, or a sphere; then stereo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.errors import StageError
from pipeline.meshes import F64, Mask
from stages.inverse_rendering.config import AUTO, Config
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView

FACE = 0.008  # metres from the placed template within which long sweeps do not move the start: on smooth skin they
# find depths at random

NAMES = {
    "hull": "visual hull",
    "template": "visual hull cut by the head template",
    "sphere": "sphere",
    "imface": "ImFace",
}


@dataclass(frozen=True, slots=True)
class ChosenStart:
    """start: after stereo; prior: before it, with which refined geometry is compared. facts: for the report."""

    start: Start
    prior: Start
    facts: dict[str, str | float | bool]


def choose_start(
    hull: Start,
    views: list[PhotoView],
    landmarks: F64 | None,
    settings: Config,
    device: str,
    check: Callable[[], None] = lambda: None,
) -> ChosenStart:
    """The hull after stereo, or the hull cut by the template placed on landmarks (468, 3).

    `prior` auto takes the template where the landmarks are far from the hull's surface after stereo.

    Raises:
        StageError: `prior` is template, and the photos show no face that the template fits.
    """
    from stages.inverse_rendering.stereo import start_from_photos

    def refined(start: Start, known: Callable[[F64], Mask] | None = None) -> Start:
        return start_from_photos(start, views, device, check, known) if settings.stereo else start

    if settings.prior not in (AUTO, "hull", "template"):  # a preset of the paper's
        return ChosenStart(hull, hull, {"prior": NAMES[settings.prior], "why": "setting"})
    if settings.prior == "hull" or (settings.prior == AUTO and landmarks is None):
        why = "setting" if settings.prior == "hull" else "the photos agree on no face"
        return ChosenStart(refined(hull), hull, {"prior": NAMES["hull"], "why": why})
    return _with_face(hull, views, landmarks, settings, refined)


def _with_face(
    hull: Start,
    views: list[PhotoView],
    landmarks: F64 | None,
    settings: Config,
    refined: Callable[..., Start],
) -> ChosenStart:
    from pipeline.registration.carve import on_face, placed_on_face
    from pipeline.template.load import load_template
    from stages.inverse_rendering import template_start as template

    forced, model = settings.prior == "template", load_template()
    head = placed_on_face(model, landmarks) if landmarks is not None else None
    if head is None or landmarks is None:
        if forced:
            raise _no_face(landmarks is not None)
        return ChosenStart(refined(hull), hull, {"prior": NAMES["hull"], "why": "the face landmarks fit no template"})
    facts: dict[str, str | float | bool] = {
        "template_residual_mm": round(1e3 * float(np.median(head.residual)), 3),
        "template_scale": round(head.scale, 4),
    }
    if not forced:
        start = refined(hull)
        off = template.landmarks_off(start, landmarks, head.scale)
        facts["landmarks_off_hull_mm"] = round(1e3 * off, 3)
        if off <= template.FAR:
            why = "the face landmarks lie on the hull's surface after stereo"
            return ChosenStart(start, hull, {"prior": NAMES["hull"], "why": why, **facts})
    centres = np.stack([v.world_from_cam[:3, 3] for v in views])
    cut = template.carved_by_template(hull, model, head, centres)
    start = refined(cut, lambda points: on_face(model, head, points, FACE))
    facts["landmarks_off_mm"] = round(1e3 * template.landmarks_off(start, landmarks, head.scale), 3)
    why = "setting" if forced else "the hull's surface does not have the face"
    return ChosenStart(start, cut, {"prior": NAMES["template"], "why": why, **facts})


def _no_face(found: bool) -> StageError:
    return StageError(
        "the head template can't be placed",
        where="inverse_rendering.prior = template",
        value="landmarks that fit no head" if found else "no face that three photos agree on",
        limit="a face in three photos or more",
        remedy="set inverse_rendering.prior=auto, or add sharp photos of the face",
    )
