"""The result of structure from motion: cameras in asset coordinates, and messages about photos without a camera."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.artifacts import CameraSet, Located
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.faces.landmarks3d import head_frame
from stages.poses.config import Config
from stages.poses.judge import groups, mirrored
from stages.poses.mirrored import find_mirrored
from stages.poses.normalise import normalise
from stages.poses.photos import photos_of
from stages.poses.progress import progress_of
from stages.poses.scale import eyes_of
from stages.poses.scale_source import find_faces, known_scale, landmarks_of, size_of_head
from stages.poses.sfm import solve
from stages.poses.write_cameras import camera_of, camera_set

MIN_FITTED = 3


def solved_cameras(capture: Located[Capture], config: Config, context: Context) -> CameraSet:
    """Cameras from the photos alone.

    Raises:
        StageError: fewer than MIN_FITTED photos that are not held out have a camera. With few more, the finding
            `photos_placed` is unusable.
    """
    views = capture.artifact.views
    in_order = capture.artifact.kind == "video"  # frames of a video are in order
    solution = solve(photos_of(capture), config, in_order, context.scratch, progress_of(context))
    model = solution.model
    placed = sorted(model.poses) if model is not None else []
    missing = tuple(v.name for i, v in enumerate(views) if i not in placed)
    others = solution.groups[1:]
    why = {views[i].name: reason for i, reason in solution.left_out.items()}
    fitted = sum(not views[i].holdout for i in placed)
    if model is None or fitted < MIN_FITTED:
        raise _not_placed(len(views), len(placed), fitted, why)
    cameras = [camera_of(views[i], p.K, p.world_from_cam, p.distortion) for i, p in model.poses.items()]
    warnings: list[str] = []
    faces = find_faces(capture, cameras, context.check)
    eyes = eyes_of([(c, face.pupils) for c, face in faces])
    known = known_scale(capture, cameras, config, eyes, warnings)
    face = landmarks_of(faces)
    head = None if face is None else head_frame(face)
    found = normalise(
        cameras, model.points, given=False, known=known, eyes=eyes, head=head, guess=lambda: size_of_head(face)
    )
    warnings += found.warnings
    if missing:
        listed = "; ".join(f"{', '.join(names)} ({kind})" for kind, names in _by_kind(why).items())
        warnings.append(f"{len(missing)} of {len(views)} photos have no camera and are left out: "
                        f"{listed}. Take sharp photos between them and the others, in steps of 15 degrees; photos of "
                        "something else and mirror images never fit")  # fmt: skip
    for group in others:
        warnings.append("these photos fit together, but not with the rest: " + ", ".join(views[i].name for i in group)
                        + "; if they show another subject, put them into a separate capture")  # fmt: skip
    result = camera_set("colmap", cameras, found, model, [v.name for v in views], missing, warnings, context)
    lost = [i for i in range(len(views)) if i not in placed]
    flipped = find_mirrored(photos_of(capture), lost, placed, config.seed)
    findings = (groups(len(placed), [[views[i].name for i in group] for group in others]),
                mirrored([views[i].name for i in flipped], len(views)))  # fmt: skip
    sizes = tuple(len(g) for g in solution.groups)
    return result.model_copy(update={"findings": findings, "left_out": why, "groups": sizes})


def _by_kind(why: Mapping[str, str]) -> dict[str, list[str]]:
    """Names of photos by kind of reason: no match, other group, blurred, few features, weak match."""
    out: dict[str, list[str]] = {}
    for name, reason in why.items():
        out.setdefault(reason.split(":")[0], []).append(name)
    return out


def _not_placed(total: int, placed: int, fitted: int, why: Mapping[str, str]) -> StageError:
    missing = list(why)
    named = ", ".join(missing[:12]) + (f" and {len(missing) - 12} more" if len(missing) > 12 else "")
    return StageError(
        "the photos do not fit together" if placed else "the photos have no matches",
        where="poses",
        value=f"{placed} of {total} have a camera, {fitted} of them are not held out; without a camera: {named}",
        limit=f"at least {MIN_FITTED} that are not held out",
        remedy="take sharp photos around one still subject, each overlapping the next by two thirds (15 degrees or "
        "less apart), with the lens at one zoom; remove the listed photos if they show something else; or give the "
        "cameras in params.json",
    )
