"""Stage together: of two captures of one subject, where the second lies in the asset coordinates of the first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from pipeline.artifacts import CameraSet, Located, MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage, StageConfig
from pipeline.together_artifacts import Together

if TYPE_CHECKING:
    from stages.together.place import Body


@dataclass(frozen=True, slots=True)
class Inputs:
    """Photos, cameras and masks of both captures; those of the second begin with `also`."""

    capture: Located[Capture]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    also_capture: Located[Capture]
    also_poses: Located[CameraSet]
    also_masks: Located[MaskSet]


class Config(StageConfig):
    """Settings of the stage together."""

    align: Literal["auto", "world", "outlines"] = Field(
        "auto",
        description="where the second capture lies: by the world that both captures' cameras are given in (world), by "
        "the outlines of the subject (outlines), or by the first where the outlines agree there (auto)",
    )
    least_agreement: float = Field(
        0.93,
        ge=0.0,
        le=1.0,
        description="agreement of the two captures' silhouettes below which they are not fitted together",
    )


def run(inputs: Inputs, config: Config, context: Context) -> Together:
    """Place the second capture.

    Raises:
        StageError: the captures do not agree: another subject, another pose or expression, or wrong cameras.
    """
    from pipeline.transforms import rows, scale_of
    from stages.together.judge import findings, refuse
    from stages.together.place import place

    context.progress(0, 2, "outlines of both captures")
    first = _body(inputs.capture, inputs.poses, inputs.masks)
    context.check()
    second = _body(inputs.also_capture, inputs.also_poses, inputs.also_masks)
    context.progress(1, 2, "placing the second capture")
    found = place(first, second, wanted=config.align, check=context.check)
    refuse(found, config.least_agreement)
    figures = {"scale": round(scale_of(found.matrix), 6)}
    if found.of_world is not None:
        figures["agreement_of_world"] = round(found.of_world, 5)
    if found.landmarks is not None:
        figures["landmarks"] = round(found.landmarks, 5)
    return Together(
        first_from_second=rows(found.matrix),
        source=found.source,
        agreement=round(found.agreement, 5),
        figures=figures,
        findings=findings(found),
    )


def _body(capture: Located[Capture], poses: Located[CameraSet], masks: Located[MaskSet]) -> Body:
    """What a capture knows of the subject's shape: its fitted views, without masks that contradict the others."""
    from pipeline.faces.landmarks3d import load_landmarks
    from pipeline.images import read_alpha
    from pipeline.transforms import matrix
    from stages.together.place import body_of

    left_out = {v.index for v in capture.artifact.views if v.holdout} | set(masks.artifact.dropped)
    files = {m.index: m.mask for m in masks.artifact.masks}
    cameras = [c for c in poses.artifact.cameras if c.index in files and c.index not in left_out]
    alphas = [read_alpha(masks.path(files[c.index])) for c in cameras]
    world = matrix(poses.artifact.capture_from_asset) if poses.artifact.source == "given" else None
    face = masks.artifact.landmarks
    landmarks = None if face is None else load_landmarks(masks.path(face))
    return body_of(cameras, alphas, poses.artifact.roi_radius, masks.artifact.extent, world, landmarks)


STAGE = Stage(name="together", version=1, inputs=Inputs, config=Config, output=Together, run=run)
