"""poses: a camera in asset coordinates for each photo. Given cameras are used; otherwise they are solved."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.artifacts import CameraSet, Located
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage
from pipeline.errors import UsageError
from stages.poses.config import Config as Config


@dataclass(frozen=True, slots=True)
class Inputs:
    """The checked photos."""

    capture: Located[Capture]


def run(inputs: Inputs, config: Config, context: Context) -> CameraSet:
    """Cameras around the subject.

    Raises:
        UsageError: poses.method=given, but the capture has no cameras.
        StageError: the given cameras look at no common point, or the photos can't be registered.
    """
    from stages.poses.given_cameras import given_cameras
    from stages.poses.judge import judge
    from stages.poses.sfm_result import solved_cameras
    from stages.poses.write_cameras import sparse_points

    views = inputs.capture.artifact.views
    all_given = all(v.camera is not None for v in views)
    if config.method == "given" and not all_given:
        raise UsageError(
            "the capture has no cameras",
            where="poses.method",
            value="given",
            limit="a camera for every view (params.json)",
            remedy="use poses.method=auto or poses.method=colmap",
        )
    given = all_given and config.method != "colmap"
    found = (given_cameras if given else solved_cameras)(inputs.capture, config, context)
    seen, findings = judge(found, inputs.capture.artifact, sparse_points(found, context.workdir))
    return found.model_copy(update={"seen_directions": seen, "findings": found.findings + findings})


STAGE = Stage(name="poses", version=11, inputs=Inputs, config=Config, output=CameraSet, run=run, any_threads=True)
