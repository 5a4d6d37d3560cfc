"""From the fitted model to files: the light, the held-out views, and the facts that the report shows."""

from __future__ import annotations

import json

from pipeline.artifacts import CameraSet, Capture, HeldOutView
from pipeline.contract import Context
from pipeline.fields.face import FaceModel
from pipeline.images import write_exr, write_png_from_linear
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.footprint import Footprint
from stages.inverse_rendering.gather import camera_only
from stages.inverse_rendering.predict import predict_view
from stages.inverse_rendering.views import factor_for


def write_light(model: FaceModel, context: Context) -> None:
    """light.json: raw coefficients and the conventions that they need."""
    rows = model.light().detach().cpu().double().numpy().round(7).tolist()
    (context.workdir / "light.json").write_text(
        json.dumps(
            {
                "order": model.spec.light_order,
                "basis": "real orthonormal SH, no Condon-Shortley phase, index l(l+1)+m",
                "frame": "asset coordinates, +Y up, direction towards the light",
                "colour": "linear Rec.709 radiance",
                "coefficients": rows,
            },
            indent=1,
        )
    )


def predict_held_out(
    model: FaceModel, capture: Capture, poses: CameraSet, side: int, samples: int, context: Context
) -> tuple[HeldOutView, ...]:
    """EXR and PNG of every held-out view, in the photo's pixels or an integer factor smaller."""
    held = {v.index: v for v in capture.views if v.holdout}
    known = [c for c in poses.cameras if c.index in held]
    exposure = {v.index: v.exposure for v in capture.views}
    out = []
    for n, c in enumerate(known):
        context.check()
        context.progress(n, len(known), "held-out views")
        factor = factor_for((c.width, c.height), side, exact=True)
        view = camera_only(c)
        rgba = predict_view(model, view, factor, samples, context.device)
        rgba[..., :3] *= exposure[c.index]
        exr, png = f"views/{c.index}.exr", f"views/{c.index}.png"
        write_exr(context.workdir / exr, rgba)
        write_png_from_linear(context.workdir / png, rgba[..., :3])
        out.append(HeldOutView(index=c.index, exr=context.file(exr), png=context.file(png), scale=factor))
    return tuple(out)


def model_facts(trainer: Trainer, looked: Footprint | None) -> dict[str, dict[str, str | float | bool]]:
    """What was modelled, what was left out, and the evidence for it, for the report."""
    settings, model, guard, choices = trainer.settings, trainer.model, trainer.guard, trainer.choices
    decided: dict[str, dict[str, str | float | bool]] = dict(choices.facts) if choices else {}
    return {
        **decided,
        "geometry": {
            "prior": {"hull": "visual hull", "sphere": "sphere", "imface": "ImFace"}[settings.prior],
            "cell_mm": round(model.geometry.cell * 1e3, 4),
            "why": "no licensed prior" if settings.prior == "hull" else "setting",
        },
        "resolution": looked.facts(settings, model) if looked else {"why": "setting"},
        "schedule": _schedule(trainer),
        "density": {"kind": settings.density, "why": "setting"},
        "system": {
            "method": settings.method,
            "shading": settings.shading,
            "light": settings.light,
            "integral": settings.integral,
            "attenuation": settings.attenuation,
            "why": "setting",
        },
        "faults": {"dropped_steps": guard.dropped, "why": guard.causes[-1] if guard.causes else "none"},
    }


def _schedule(trainer: Trainer) -> dict[str, str | float | bool]:
    """How long the fit was, and what set its length. Seconds are left out where they do not repeat."""
    if not trainer.settings.by_clock:
        return {"steps": trainer.step, "why": "setting"}
    return {"steps": trainer.step, "seconds_of_the_stage": trainer.settings.seconds, "why": "ended by the clock"}
