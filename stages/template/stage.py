"""Template stage: Surface and landmarks in, RegisteredHead out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, Surface
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage
from pipeline.errors import StageError
from pipeline.head_artifacts import RegisteredHead
from stages.template.config import Config as Config

if TYPE_CHECKING:
    from pipeline.registration.scan import Scan
    from pipeline.template.model import Template
    from stages.template.hair import ToldHair
    from stages.template.register import Registration

HEAD, RIG, HAIR = "head.npz", "rig.npz", "hair.npz"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The dense mesh, the face's landmarks, and the cameras, masks and photos that show what was seen."""

    surface: Located[Surface]
    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    capture: Located[Capture]


def run(inputs: Inputs, config: Config, context: Context) -> RegisteredHead:
    """Register the template. StageError only if it is required and does not hold, or if its folder is damaged."""
    if not (config.enabled or config.require):
        return RegisteredHead(registered=False, reason="not asked for (template.enabled)")
    from pipeline import meshes
    from pipeline.faces.landmarks3d import load_landmarks, photos_of_face
    from pipeline.fields.face import load_face
    from pipeline.registration.identity_fit import placed_on_landmarks
    from pipeline.template.load import load_template
    from pipeline.visibility import seen_by
    from stages.template.hair import told_hair, under_hair
    from stages.template.judge import refused_faces, refused_irises, refused_object, refused_placing
    from stages.template.register import iris_pixels, register, scan_of

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    ref = inputs.masks.artifact.landmarks
    if ref is None:
        return _refused(config, "no face was found in three photos or more")
    if config.faultless and inputs.capture.artifact.stage is not None:
        return _refused(config, "a light stage: the scan predicts its lights better")
    why = refused_object([m.source for m in inputs.masks.artifact.masks]) if config.faultless else ""
    if why:
        return _refused(config, why)
    why = refused_faces(len(photos_of_face(inputs.masks.path(ref))), len(inputs.masks.artifact.masks))
    if why:
        return _refused(config, why)
    template = load_template(Path(config.folder) if config.folder else None)
    landmarks = load_landmarks(inputs.masks.path(ref))
    placed = placed_on_landmarks(template, landmarks)
    if placed is None:
        return _refused(config, "too few landmarks of the face are known")
    why = refused_placing(1000 * float(np.median(placed.residual)), placed.scale, metric=inputs.poses.artifact.metric)
    if why:
        return _refused(config, why)
    step(0, 5, "visibility")
    views = seen_by(inputs.inverse_rendering.artifact, inputs.poses.artifact, inputs.masks, inputs.capture)
    why = refused_irises(iris_pixels([v.camera for v in views], placed)) if config.faultless else ""
    if why:
        return _refused(config, why)
    dense = meshes.load(inputs.surface.path(inputs.surface.artifact.mesh))
    scan, rows = scan_of(dense, placed, views)
    hair = None
    if config.hair:
        step(0, 5, "hair")
        fitted = inputs.inverse_rendering
        hair = told_hair(
            template, landmarks, placed, scan, load_face(fitted.path(fitted.artifact.field), context.device)
        )
        scan = under_hair(scan, hair)
    found = register(template, landmarks, placed, scan, config.levels, step, views, inputs.poses.artifact.metric)
    made = _registered(found, template, scan, config, context)
    return _with_hair(made, hair, rows, len(dense.vertices), context) if made.registered and hair else made


def _with_hair(
    made: RegisteredHead, hair: ToldHair, rows: NDArray[np.int64], count: int, context: Context
) -> RegisteredHead:
    """The artifact with the hair that was told. rows (V,): the scan's vertices among the `count` of the surface."""
    figures, file = made.figures | hair.figures, None
    if hair.inside.any():
        told = np.zeros(count, np.bool_)
        told[rows] = hair.inside
        np.savez(context.workdir / HAIR, hair=told)
        file = context.file(HAIR)
    return made.model_copy(update={"figures": figures, "hair": file, "hair_reason": hair.reason})


def _registered(
    found: Registration, template: Template, scan: Scan, config: Config, context: Context
) -> RegisteredHead:
    from pipeline.registration.neck import covered_neck
    from pipeline.registration.rig import rig_of
    from stages.template.figures import figures_of, fitted_eye, region_figures
    from stages.template.judge import faults, judge, refused_fit

    regions = tuple(template.regions)
    by_region = region_figures(found, regions, scan)
    if "skin" not in by_region:
        return _refused(config, "the fitted surface shows none of the head's skin")
    figures = figures_of(found, regions, by_region["skin"])
    why = refused_fit(figures)
    if why:
        return _refused(config, why)
    quality = judge(figures)
    unfitted = "; ".join(f"{part}: {ball.reason}" for part, ball in found.eyes.items() if ball.reason)
    why = faults(quality, "" if found.closed else unfitted) if config.faultless else ""
    if why:
        return _refused(config, why).model_copy(update={"faulty": True})
    found.head.save(context.workdir / HEAD)
    covered = covered_neck(template, found.head.vertices, scan, found.placed.scale)
    rig = rig_of(template, found.head.vertices, found.placed.world_from_template, covered)
    if rig is not None:
        rig.save(context.workdir / RIG)
    context.log.info("template: %.3f mm from the surface, %d repairs", figures["distance_mm"], found.fitted.repairs)
    return RegisteredHead(
        registered=True,
        head=context.file(HEAD),
        rig=None if rig is None else context.file(RIG),
        template=template.name,
        licence=template.licence,
        regions=regions,
        parts=tuple(template.parts),
        levels=config.levels,
        quads=len(template.quads),
        world_from_template=tuple(tuple(float(x) for x in row) for row in found.placed.world_from_template),
        identity=tuple(round(float(w), 6) for w in found.placed.weights),
        figures=figures,
        eyes=tuple(fitted_eye(part, ball) for part, ball in found.eyes.items() if not ball.reason),
        eyes_reason=unfitted,
        distances_mm={n: (d.median, d.most, d.displaced_median, d.displaced_most) for n, d in by_region.items()},
        quality=quality,
    )


def _refused(config: Config, why: str) -> RegisteredHead:
    if config.require:
        raise StageError(
            "the head template could not be registered",
            where="template",
            value=why,
            limit="template.require is on",
            remedy="take sharper photos of the face from the front and both sides, or set template.require=false",
        )
    return RegisteredHead(registered=False, reason=why)


STAGE = Stage(name="template", version=23, inputs=Inputs, config=Config, output=RegisteredHead, run=run)
