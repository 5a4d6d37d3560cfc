"""Template stage: Surface and landmarks in, RegisteredHead out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, Surface
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage
from pipeline.errors import StageError
from pipeline.head_artifacts import RegisteredHead
from stages.template.config import Config as Config

if TYPE_CHECKING:
    from pipeline.registration.scan import Scan
    from pipeline.template.model import Template
    from stages.template.register import Registration

HEAD, RIG = "head.npz", "rig.npz"


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
    from pipeline.faces.landmarks3d import load_landmarks, photos_that_agree
    from pipeline.registration.identity_fit import placed_on_landmarks
    from pipeline.template.load import load_template
    from pipeline.visibility import seen_by
    from stages.template.judge import refused_faces, refused_placing
    from stages.template.register import register, scan_of

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    ref = inputs.masks.artifact.landmarks
    if ref is None:
        return _refused(config, "no face was found in three photos or more")
    why = refused_faces(photos_that_agree(inputs.masks.path(ref)), len(inputs.masks.artifact.masks))
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
    scan = scan_of(meshes.load(inputs.surface.path(inputs.surface.artifact.mesh)), placed, views)
    found = register(template, landmarks, placed, scan, config.levels, step, views, inputs.poses.artifact.metric)
    return _registered(found, template, scan, config, context)


def _registered(
    found: Registration, template: Template, scan: Scan, config: Config, context: Context
) -> RegisteredHead:
    from pipeline.registration.rig import rig_of
    from stages.template.figures import figures_of, fitted_eye, region_figures
    from stages.template.judge import judge, refused_fit

    regions = tuple(template.regions)
    by_region = region_figures(found, regions, scan)
    if "skin" not in by_region:
        return _refused(config, "the fitted surface shows none of the head's skin")
    figures = figures_of(found, regions, by_region["skin"])
    why = refused_fit(figures)
    if why:
        return _refused(config, why)
    found.head.save(context.workdir / HEAD)
    rig = rig_of(template, found.head.vertices, found.placed.world_from_template)
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
        eyes_reason="; ".join(f"{part}: {ball.reason}" for part, ball in found.eyes.items() if ball.reason),
        distances_mm={n: (d.median, d.most, d.displaced_median, d.displaced_most) for n, d in by_region.items()},
        quality=judge(figures),
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


STAGE = Stage(name="template", version=6, inputs=Inputs, config=Config, output=RegisteredHead, run=run)
