"""Bake stage: the fitted field on the texels of the UV mesh, TextureSet out."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet, TextureSet, UvMesh
from pipeline.contract import Context, Stage, StageConfig


@dataclass(frozen=True, slots=True)
class Inputs:
    """The mesh, the field, and the cameras and masks that say which texels were seen."""

    uv: Located[UvMesh]
    inverse_rendering: Located[FittedFace]
    poses: Located[CameraSet]
    masks: Located[MaskSet]


class Config(StageConfig):
    """Size of the maps."""

    size: int = Field(1024, ge=256, le=8192, description="width and height of the maps in texels")


def run(inputs: Inputs, config: Config, context: Context) -> TextureSet:
    """Bake every map. Raises StageError when the mesh has no charts or the field is not finite on it."""
    from pipeline import meshes
    from pipeline.fields.face import load_face
    from stages.bake.build import build
    from stages.bake.confidence import seen_by
    from stages.bake.write import write_maps

    uv, fitted = inputs.uv, inputs.inverse_rendering
    field = load_face(fitted.path(fitted.artifact.field), context.device)
    path = uv.path(uv.artifact.mesh)
    views = seen_by(fitted.artifact, inputs.poses.artifact, inputs.masks)

    def step(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    baked = build(field, meshes.load(path), meshes.load_charts(path), views, config.size, step)
    maps = write_maps(baked, context)
    # every texel between the charts is filled, so the padding reaches across the whole picture
    return TextureSet(
        size=config.size,
        padding=config.size,
        maps=maps,
        coverage=baked.coverage,
        zero_set_rms_mm=1000 * baked.samples.deviation(),
        warnings=baked.warnings,
    )


STAGE = Stage(name="bake", version=2, inputs=Inputs, config=Config, output=TextureSet, run=run)
