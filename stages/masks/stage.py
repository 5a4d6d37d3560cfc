"""masks: one soft alpha mask for each registered view; the masks are checked against each other by the visual hull."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.artifacts import CameraSet, Located, MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage
from stages.masks.config import Config as Config


@dataclass(frozen=True, slots=True)
class Inputs:
    """The checked photos and their cameras."""

    capture: Located[Capture]
    poses: Located[CameraSet]


def run(inputs: Inputs, config: Config, context: Context) -> MaskSet:
    """Masks of all registered views.

    Raises:
        StageError: a mask is missing or of the wrong size; no uniform background for masks.method=key; too few views
            with consistent masks.
    """
    from stages.masks.segment import segment

    return segment(inputs.capture, inputs.poses, config, context)


STAGE = Stage(name="masks", version=27, inputs=Inputs, config=Config, output=MaskSet, run=run, any_threads=True)
