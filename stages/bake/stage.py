"""Bake stage: the fitted field on the texels of the UV mesh, TextureSet out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pipeline.artifacts import CameraSet, Capture, FittedFace, Located, MaskSet, Surface, TextureSet, UvMesh
from pipeline.contract import Context, Stage, StageConfig

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Inputs:
    """The mesh, the field, the cameras and masks that say which texels were seen, and the photos with their detail."""

    surface: Located[Surface]
    uv: Located[UvMesh]
    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    capture: Located[Capture]


class Config(StageConfig):
    """Size of the maps and what goes into them."""

    size: int = Field(1024, ge=256, le=16384, description="width and height of the maps in texels")
    detail: bool = Field(True, description="add the fine detail of the fitted photos to the albedo")


def run(inputs: Inputs, config: Config, context: Context) -> TextureSet:
    """Bake every map. Raises StageError when the mesh has no charts or the field is not finite on it."""
    from pipeline import meshes
    from pipeline.fields.face import load_face
    from pipeline.visibility import seen_by
    from stages.bake.build import Photos, build
    from stages.bake.deviation import zero_set_rms
    from stages.bake.write import write_maps

    uv, fitted = inputs.uv, inputs.inverse_rendering
    field = load_face(fitted.path(fitted.artifact.field), context.device)
    path = uv.path(uv.artifact.mesh)
    views = seen_by(fitted.artifact, inputs.poses.artifact, inputs.masks, inputs.capture)
    exposure = {v.index: v.exposure for v in inputs.capture.artifact.views}
    response = responses(field, [exposure[v.camera.index] for v in views])
    photos = Photos(response, attenuation(fitted.artifact)) if config.detail else None

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    mesh, charts = meshes.load(path), meshes.load_charts(path)
    baked = build(field, mesh, charts, views, config.size, step, photos, context.scratch)
    maps = write_maps(baked, context)
    levels = {"render": mesh, "high": meshes.load(inputs.surface.path(inputs.surface.artifact.mesh))}
    if uv.artifact.proxy is not None:
        levels["proxy"] = meshes.load(uv.path(uv.artifact.proxy))
    # every texel between the charts is filled, so the padding reaches across the whole picture
    return TextureSet(
        size=config.size,
        padding=config.size,
        maps=maps,
        coverage=baked.coverage,
        zero_set_rms_mm=1000 * baked.samples.deviation(),
        lod_rms_mm={name: round(1000 * zero_set_rms(field, level), 5) for name, level in levels.items()},
        figures=baked.figures,
        warnings=baked.warnings,
    )


def responses(field: object, exposures: Sequence[float]) -> F64:
    """(views, 3, 3) e_n A_n of each photo: its exposure, by which the fit divided it, and the fitted A_n, the identity
    for fields that have none. [NeuFace eq. 19]"""
    e = np.asarray(exposures, np.float64)[:, None, None]
    model = getattr(field, "model", None)
    if model is None:
        return e * np.eye(3)
    return np.asarray(e * model.calibration().detach().cpu().numpy(), np.float64)


def attenuation(face: FittedFace) -> str:
    """How the fit attenuated the light's bands; the paper's exponential where its model does not say."""
    return next((str(v["attenuation"]) for v in face.model.values() if "attenuation" in v), "exponential")


STAGE = Stage(name="bake", version=4, inputs=Inputs, config=Config, output=TextureSet, run=run)
