"""Given cameras: checked against the photos, refined if configured, transformed to asset coordinates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.artifacts import Camera, CameraSet, Located
from pipeline.capture_artifacts import Capture, CaptureKind
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.faces.landmarks3d import head_frame
from pipeline.transforms import inverse_rigid, matrix
from pipeline.verdict import Finding
from stages.poses.config import Config
from stages.poses.epipolar_check import AGREE, FAR, IMPERFECT, check_cameras, features_of
from stages.poses.judge import CONTRADICTED, contradicted, mirrored
from stages.poses.mirrored import find_mirrored
from stages.poses.normalise import Unit, nearest_point, normalise, viewing_rays
from stages.poses.photos import photos_of
from stages.poses.progress import progress_of
from stages.poses.scale import by_world, eyes_of
from stages.poses.scale_source import find_faces, known_scale, landmarks_of, size_of_head, some_of
from stages.poses.write_cameras import camera_of, camera_set

if TYPE_CHECKING:
    from stages.poses.mapper import Model

# FaceScape: metres or millimetres; a light stage: metres; the other formats have arbitrary units
UNITS: dict[CaptureKind, Unit] = {"facescape": "guess", "olat": "metres"}


def given_cameras(capture: Located[Capture], config: Config, context: Context) -> CameraSet:
    """The capture's cameras in asset coordinates, without views whose photos contradict them. If most views are
    contradicted, it is unknown which are right: all are kept, and the finding is unusable. Held-out photos have no part
    in points or refinement; they keep their given cameras.

    Raises:
        StageError: the photos share no point under these cameras.
    """
    cameras = [
        camera_of(v, matrix(c.K), inverse_rigid(matrix(c.cam_from_world)), c.distortion)
        for v, c in ((v, v.camera) for v in capture.artifact.views)
        if c is not None
    ]
    auto: Unit = UNITS.get(capture.artifact.kind, "unknown")
    unit: Unit = auto if config.unit == "auto" else config.unit
    wrong, findings = _contradicted(capture, cameras, config, context) if config.check else ([], ())
    names = tuple(cameras[i].name for i in wrong)
    right = [i for i in range(len(cameras)) if i not in wrong]
    cameras = [cameras[i] for i in right]
    warnings = [f"{n} is left out: its photo contradicts its camera; check its file name and its pose"
                for n in names]  # fmt: skip
    model, own = None, [n for n, i in enumerate(right) if not capture.artifact.views[i].holdout]
    if config.given != "keep":
        some = [cameras[n] for n in own]
        model, some, doubtful = _triangulated(capture, [right[n] for n in own], some, config, context)
        for n, camera in zip(own, some, strict=True):
            cameras[n] = camera
        if doubtful:
            warnings.append(
                "too few points to refine the cameras of " + ", ".join(doubtful) + "; they are used as given"
            )
    faces = find_faces(capture, some_of(capture, cameras), context.check)
    eyes = eyes_of([(c, face.pupils) for c, face in faces]) if config.pupils_mm else None
    known = known_scale(capture, cameras, config, eyes, warnings)
    world, axes = capture.artifact.metres_from_world, None
    if world is not None and config.unit == "auto":
        published, axes = by_world(matrix(world))
        known = published if known is None and config.scale == "auto" else known
    face = landmarks_of(faces)
    head = None if face is None else head_frame(face)
    found = normalise(
        cameras, given=True, unit=unit, known=known, axes=axes, head=head, guess=lambda: size_of_head(face)
    )
    all_warnings = (*warnings, *found.warnings)
    result = camera_set("given", cameras, found, model, [cameras[n].name for n in own], names, all_warnings, context)
    return result.model_copy(update={"findings": findings})


def _triangulated(
    capture: Located[Capture], right: list[int], cameras: list[Camera], config: Config, context: Context
) -> tuple[Model, list[Camera], list[str]]:
    """Points triangulated from the given cameras `right` of the capture; these cameras, refined if configured; names of
    cameras that could not be refined.

    Raises:
        StageError: the photos share no point under these cameras.
    """
    from stages.poses.sfm import (
        triangulate_given,
    )  # imports COLMAP, which is not needed for poses.given=keep

    photos = photos_of(capture)
    centres, axes = viewing_rays(cameras)
    distance = float(((centres - nearest_point(centres, axes)) ** 2).sum(1).mean() ** 0.5)
    in_order = capture.artifact.kind == "video"
    found = triangulate_given(
        [photos[i] for i in right], cameras, config, in_order, context.scratch, progress_of(context),
        refine=config.given == "refine", deviation=config.given_deviation * distance,
    )  # fmt: skip
    if found is None:
        raise StageError("no point is visible in two photos", where="poses", value="0 points",
                         limit="features that neighbouring photos share",
                         remedy="set poses.given=keep to use the cameras as they are")  # fmt: skip
    model, doubtful = found
    names = [cameras[n].name for n in doubtful]
    if config.given == "refine":
        views, poses = [capture.artifact.views[i] for i in right], model.poses
        cameras = [camera_of(v, poses[n].K, poses[n].world_from_cam, c.distortion)
                   for n, (v, c) in enumerate(zip(views, cameras, strict=True))]  # fmt: skip
    return model, cameras, names


def _contradicted(
    capture: Located[Capture], cameras: list[Camera], config: Config, context: Context
) -> tuple[list[int], tuple[Finding, ...]]:  # fmt: skip
    """Indices of the views whose photos contradict their cameras (empty if most do), and the findings."""
    progress = progress_of(context)
    photos = photos_of(capture)
    features = features_of(photos, lambda n, m: progress(n, m, "detecting features"))
    far = IMPERFECT if config.given == "refine" else FAR
    held = {i for i, v in enumerate(capture.artifact.views) if v.holdout}
    verdict = check_cameras(
        cameras, features, config.seed, lambda n, m: progress(n, m, "checking the cameras"), far, held
    )
    right = [i for i in range(len(cameras)) if verdict.share[i] >= AGREE]
    silent = [i for i in range(len(cameras)) if not np.isfinite(verdict.share[i])]  # a mirror image has no matches
    flipped = find_mirrored(photos, [*verdict.wrong, *silent], right, config.seed)
    findings = (contradicted([cameras[i].name for i in verdict.wrong], verdict.known, len(cameras)),
                mirrored([cameras[i].name for i in flipped], len(cameras)))  # fmt: skip
    most = len(verdict.wrong) > CONTRADICTED.usable * verdict.known
    return ([] if most else verdict.wrong), findings
