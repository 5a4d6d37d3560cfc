"""Choice of the initial geometry: the visual hull, the hull cut by the head template, or a sphere; then stereo."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from pipeline.directions import from_around
from pipeline.errors import StageError
from pipeline.meshes import F64
from pipeline.registration.head_regions import Near, near_head, plain_face
from pipeline.registration.identity_fit import placed_on_face
from pipeline.template.load import load_template
from stages.inverse_rendering.config import AUTO, PRIORS, Config
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.keep_silhouettes import start_with_silhouettes
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.stereo import SWEEPS, Sweep
from stages.inverse_rendering.stereo_choice import Facts, stereo_start
from stages.inverse_rendering.template_start import (
    BEYOND_STEREO,
    FAR,
    carved_by_template,
    landmarks_off,
    without_cover,
    without_far_parts,
)


@dataclass(frozen=True, slots=True)
class ChosenStart:
    """start: after stereo; prior: before it, with which refined geometry is compared. facts: for the report, of the
    geometry and of stereo. near_head: of the template that was placed on the face, if it was; plain_face: of the same,
    where it cut the hull."""

    start: Start
    prior: Start
    facts: dict[str, Facts]
    near_head: Near | None = None
    plain_face: Near | None = None

    @property
    def cut_by_template(self) -> bool:
        """Whether the hull was cut by the head template, so that the start's depth is a guess."""
        return self.facts["geometry"]["prior"] == PRIORS["template"]


def choose_start(
    hull: Start,
    views: list[PhotoView],
    landmarks: F64 | None,
    settings: Config,
    device: str,
    check: Callable[[], None] = lambda: None,
    showing: Collection[int] = (),
) -> ChosenStart:
    """The hull after stereo, or the hull cut by the template placed on landmarks (468, 3). showing: indices of the
    photos that show the face.

    `prior` auto takes the template where the landmarks are far from the hull's surface after stereo. Where cameras from
    around leave a hull that hides the face, what lies before the face is cut away first.

    Raises:
        StageError: `prior` is template, and the photos show no face that the template fits.
    """
    if settings.prior not in (AUTO, "hull", "template"):  # a preset of the paper's
        return ChosenStart(hull, hull, _facts(settings.prior, "setting"))
    template = None if settings.prior == "hull" or landmarks is None else load_template()
    head = None if template is None or landmarks is None else placed_on_face(template, landmarks)
    if head is None or template is None or landmarks is None:
        if settings.prior == "template":
            raise _no_face(landmarks is not None)
        why = (
            "setting" if settings.prior == "hull"
            else "the photos agree on no face" if landmarks is None
            else "the face landmarks fit no head"
        )  # fmt: skip
        start, stereo = _after_stereo(hull, views, settings, device, check)
        return ChosenStart(start, hull, _facts("hull", why, stereo=stereo))
    before = landmarks_off(hull, landmarks, head.scale)
    known: Facts = {
        "template_residual_mm": round(1e3 * float(np.median(head.residual)), 3),
        "template_scale": round(head.scale, 4),
        "landmarks_off_hull_mm": round(1e3 * before, 3),
    }
    open_hull = hull
    centres = np.stack([v.world_from_cam[:3, 3] for v in views])
    if settings.prior == AUTO and before > FAR and from_around(centres):
        open_hull = without_cover(hull, template, head, views, showing)
        before = landmarks_off(open_hull, landmarks, head.scale)
        known["landmarks_off_opened_mm"] = round(1e3 * before, 3)
    if settings.prior == AUTO and before <= BEYOND_STEREO:
        near = without_far_parts(open_hull, template, head, views, check)
        start, stereo = _after_stereo(near, views, settings, device, check)
        off = landmarks_off(start, landmarks, head.scale)
        known["landmarks_off_mm"] = round(1e3 * off, 3)
        if off <= FAR:
            why = "the face landmarks lie on the hull's surface after stereo"
            return ChosenStart(start, near, _facts("hull", why, known, stereo), near_head(template, head))
    cut = carved_by_template(hull, template, head, views, check)
    # on smooth skin, longer sweeps find depths at random, and remove hair
    start, stereo = _after_stereo(cut, views, settings, device, check, SWEEPS[-1:])
    known["landmarks_off_mm"] = round(1e3 * landmarks_off(start, landmarks, head.scale), 3)
    why = "setting" if settings.prior == "template" else "the hull's surface does not have the face"
    facts = _facts("template", why, known, stereo)
    return ChosenStart(start, cut, facts, near_head(template, head), plain_face(template, head))


def _after_stereo(
    hull: Start,
    views: list[PhotoView],
    settings: Config,
    device: str,
    check: Callable[[], None],
    sweeps: tuple[Sweep, ...] = SWEEPS,
) -> tuple[Start, Facts]:
    if settings.stereo == "off":
        return hull, {"start": "visual hull", "why": "setting"}
    start, facts = stereo_start(hull, views, settings.stereo, device, check, sweeps)
    return start_with_silhouettes(hull, start, views, check), facts


def _facts(prior: str, why: str, more: Facts | None = None, stereo: Facts | None = None) -> dict[str, Facts]:
    geometry: Facts = {"prior": PRIORS[prior], "why": why, **(more or {})}
    return {"geometry": geometry} | ({} if stereo is None else {"stereo": stereo})


def _no_face(found: bool) -> StageError:
    return StageError(
        "the head template can't be placed",
        where="inverse_rendering.prior = template",
        value="landmarks that fit no head" if found else "no face that three photos agree on",
        limit="a face in three photos or more",
        remedy="set inverse_rendering.prior=auto, or add sharp photos of the face",
    )
