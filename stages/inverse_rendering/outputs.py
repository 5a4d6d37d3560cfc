"""Outputs of the fit: the light, the held-out views, and the facts for the report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import CameraSet, FittedPhoto, HeldOutView, Matrix
from pipeline.colour import as_photographed
from pipeline.contract import Context
from pipeline.fields.face import FaceModel, FittedField
from pipeline.images import write_exr, write_png_from_linear
from pipeline.lighting.surroundings import Backdrop, Surroundings, surroundings
from stages.inverse_rendering.footprint import Footprint
from stages.inverse_rendering.load_views import camera_only
from stages.inverse_rendering.ray_sampling import PhotoView, evenly_spaced, factor_for, image_rays
from stages.inverse_rendering.refine_poses import response_of
from stages.inverse_rendering.residuals import ViewError
from stages.inverse_rendering.systems import render_any
from stages.inverse_rendering.training_loop import TrainingLoop

F32 = npt.NDArray[np.float32]

SURROUNDINGS, SURROUNDED = "surroundings.npz", 96  # the file, and the most photos that are asked


def write_light(model: FaceModel, context: Context) -> None:
    """Write light.json: SH coefficients and their conventions. Of a light that moves, those of its still stand-in, and
    the light itself as `moving`."""
    field = FittedField(model)
    moving = field.moving_light
    content: dict[str, Any] = {
        "order": model.spec.light_order,
        "basis": "real orthonormal SH, no Condon-Shortley phase, index l(l+1)+m",
        "frame": "asset coordinates, +Y up, direction towards the light",
        "colour": "linear Rec.709 radiance",
        "coefficients": field.light.astype(np.float64).round(7).tolist(),
    }
    if moving is not None:
        content["moving"] = moving.stored()
    (context.workdir / "light.json").write_text(json.dumps(content, indent=1))


def write_surroundings(model: FaceModel, views: Sequence[PhotoView], context: Context) -> Surroundings | None:
    """Write surroundings.npz of the first capture's photos `views`, in the model's order; None, and no file, where they
    tell nothing."""
    own = [(n, v) for n, v in enumerate(views) if not v.second]
    found = surroundings(
        Backdrop(v.rgb, v.alpha, v.clipped, v.K, v.world_from_cam, v.distortion, response_of(model, n))
        for n, v in (own[i] for i in evenly_spaced(len(own), min(len(own), SURROUNDED)))
    )
    if found is not None:
        found.save(context.workdir / SURROUNDINGS)
    return found


def predict_held_out(
    model: FaceModel,
    poses: CameraSet,
    responses: Mapping[int, Matrix],
    side: int,
    samples: int,
    context: Context,
) -> tuple[HeldOutView, ...]:
    """Write EXR and PNG of every held-out view, at the photo's size or an integer factor smaller. responses: of the
    held-out photos, by index (held_out_colour.py)."""
    known = [c for c in poses.cameras if c.index in responses]
    out = []
    for n, c in enumerate(known):
        context.check()
        context.progress(n, len(known), "held-out views")
        factor = factor_for((c.width, c.height), side, exact=True)
        view = camera_only(c)
        response = responses[c.index]
        rgba = as_photographed(predict_view(model, view, factor, samples, context.device), response)
        exr, png = f"views/{c.index}.exr", f"views/{c.index}.png"
        write_exr(context.workdir / exr, rgba, half=True)
        write_png_from_linear(context.workdir / png, rgba[..., :3])
        files = {"exr": context.file(exr), "png": context.file(png)}
        out.append(HeldOutView(index=c.index, **files, scale=factor, response=response))
    return tuple(out)


def predict_view(model: FaceModel, view: PhotoView, factor: int, samples: int, device: str) -> F32:
    """(H / factor, W / factor, 4) linear RGBA, premultiplied, with the lens's distortion.

    No calibration is applied: the colours are those of the mean response, A = I.
    """
    w, h = view.size[0] // factor, view.size[1] // factor
    colour, opacity = render_any(model, image_rays(view, factor, device), samples)
    rgba = np.concatenate([colour.cpu().numpy(), opacity.cpu().numpy()[:, None]], 1)
    return rgba.reshape(h, w, 4).astype(np.float32)


def fitted_photos(
    errors: Sequence[ViewError], usable: Sequence[int], weights: Sequence[tuple[float, float]]
) -> tuple[FittedPhoto, ...]:
    """The fitted photos with their errors and weights. usable: indices of the photos, in the order of weights (mean
    weight, share of low weights), which may be empty."""
    of = dict(zip(usable, weights, strict=True)) if weights else {}
    out = []
    for e in errors:
        weight, low = of.get(e.index, (1.0, 0.0))
        out.append(FittedPhoto(index=e.index, psnr=round(e.psnr, 3), weight=weight, low_share=low))
    return tuple(out)


def model_facts(
    trainer: TrainingLoop, looked: Footprint | None, start: dict[str, dict[str, str | float | bool]]
) -> dict[str, dict[str, str | float | bool]]:
    """The selected model and the figures of each decision, for the report. start: those of the initial geometry."""
    settings, model, guard, choices = trainer.settings, trainer.model, trainer.guard, trainer.choices
    spec = model.spec
    decided: dict[str, dict[str, str | float | bool]] = dict(choices.facts) if choices else {}
    tried = trainer.trial_facts()
    if tried:
        decided["trials"] = tried
    return {
        **decided,
        **start,
        "geometry": {**start["geometry"], **trainer.surface_facts(), "cell_mm": round(model.geometry.cell * 1e3, 4)},
        "resolution": looked.facts(settings, model) if looked else {"why": "setting"},
        "schedule": _schedule(trainer),
        "cameras": trainer.pose_facts(),
        "photos": trainer.photo_facts(),
        "density": {"kind": spec.density, "why": "setting"},
        "system": {
            "method": {"grid": "fast", "displaced": "paper"}[spec.geometry],
            "shading": spec.shading,
            "light": spec.light,
            "integral": spec.integral,
            "attenuation": spec.attenuation,
            "why": "setting",
        },
        "faults": {"dropped_steps": guard.dropped, "why": guard.causes[-1] if guard.causes else "none"},
    }


def _schedule(trainer: TrainingLoop) -> dict[str, str | float | bool]:
    """Length of the fit, and what determined it. No measured seconds, because they are not repeatable."""
    if not trainer.settings.by_clock:
        return {"steps": trainer.step, "why": "setting"}
    return {"steps": trainer.step, "seconds_of_the_stage": trainer.settings.seconds, "why": "ended by the time limit"}
