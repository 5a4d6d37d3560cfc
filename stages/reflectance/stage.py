"""Reflectance stage: how each texel answers light, from pictures under one light at a time; a ReflectanceField."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.artifacts import (
    CameraSet,
    Located,
    MaskSet,
    UvMesh,
)
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage
from pipeline.reflectance_artifacts import ReflectanceField
from stages.reflectance.config import Config


@dataclass(frozen=True, slots=True)
class Inputs:
    """The pictures and lights, the cameras, where eyes are, and the mesh with its charts."""

    capture: Located[Capture]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    uv: Located[UvMesh]


def run(inputs: Inputs, config: Config, context: Context) -> ReflectanceField:
    """Measure the motion, mend the surface, split the pictures, fill what no camera saw, find the corneas, score all.

    Raises:
        StageError: too few lights or cameras are left for the fit, or the head moved too far.
    """
    if inputs.capture.artifact.stage is None:
        return ReflectanceField(present=False)
    from stages.reflectance.build import build

    return build(inputs.capture, inputs.poses, inputs.masks, inputs.uv, config, context)


STAGE = Stage(name="reflectance", version=11, inputs=Inputs, config=Config, output=ReflectanceField, run=run)
