"""The result of structure from motion: cameras in asset coordinates, and messages about photos without a camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from pipeline.artifacts import CameraSet, Located
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.faces.landmarks3d import head_frame
from stages.poses.config import Config
from stages.poses.held_out import register_all
from stages.poses.judge import groups, mirrored
from stages.poses.mirrored import find_mirrored
from stages.poses.normalise import normalise
from stages.poses.photos import StoredPhoto, photos_of
from stages.poses.progress import progress_of
from stages.poses.register import Registered
from stages.poses.scale import eyes_of
from stages.poses.scale_source import find_faces, known_scale, landmarks_of, size_of_head
from stages.poses.sfm import Solution, solve
from stages.poses.write_cameras import camera_of, camera_set

MIN_FITTED = 3
NOT_REGISTERED = "held out: too few of its features match points of the finished model"


def solved_cameras(capture: Located[Capture], config: Config, context: Context) -> CameraSet:
    """Cameras from the photos alone: those of fitted photos, and the scale and axes by these; then those of held-out
    photos, by registration against the finished model.

    Raises:
        StageError: fewer than MIN_FITTED photos that are not held out have a camera. With few more, the finding
            `photos_placed` is unusable.
    """
    views, photos = capture.artifact.views, photos_of(capture)
    own = [i for i, v in enumerate(views) if not v.holdout]
    in_order = capture.artifact.kind == "video"  # frames of a video are in order
    solution = solve([photos[i] for i in own], config, in_order, context.scratch, progress_of(context))
    model = solution.model
    why = {views[own[i]].name: reason for i, reason in solution.left_out.items()}
    if model is None or len(model.poses) < MIN_FITTED:
        raise _not_placed(len(own), 0 if model is None else len(model.poses), why)
    cameras = [camera_of(views[own[i]], p.K, p.world_from_cam, p.distortion) for i, p in model.poses.items()]
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
    registered = _held_out(photos, own, solution, config, context)
    why |= {views[i].name: NOT_REGISTERED for i, r in registered.items() if r is None}
    cameras += [camera_of(views[i], r.pose.K, r.pose.world_from_cam, r.pose.distortion)
                for i, r in registered.items() if r is not None]  # fmt: skip
    cameras.sort(key=lambda c: c.index)
    others = [[views[own[i]].name for i in group] for group in solution.groups[1:]]
    warnings += _messages(why, others, len(views))
    missing = tuple(v.name for v in views if v.name in why)
    result = camera_set("colmap", cameras, found, model, [views[i].name for i in own], missing, warnings, context)
    placed = {own[i] for i in model.poses}
    lost = [i for i, v in enumerate(views) if v.name in why]
    flipped = find_mirrored(photos, lost, sorted(placed), config.seed)
    findings = groups(len(placed), others), mirrored([views[i].name for i in flipped], len(views))
    sizes = tuple(len(g) for g in solution.groups)
    errors = {views[i].name: round(r.error_px, 4) for i, r in registered.items() if r is not None}
    return result.model_copy(update={"findings": findings, "left_out": why, "groups": sizes,
                                     "view_errors_px": {**result.view_errors_px, **errors}})  # fmt: skip


def _held_out(
    photos: Sequence[StoredPhoto], own: Sequence[int], solution: Solution, config: Config, context: Context
) -> dict[int, Registered | None]:
    """Each photo that is not in `own`, by index, registered against the finished model."""
    assert solution.model is not None
    held = [i for i in range(len(photos)) if i not in set(own)]
    found = register_all(
        [photos[i] for i in own], [photos[i] for i in held], solution.model, solution.sets, config,
        progress_of(context),
    )  # fmt: skip
    return dict(zip(held, found, strict=True))


def _messages(why: Mapping[str, str], others: Sequence[Sequence[str]], total: int) -> Iterator[str]:
    """Warnings of photos without a camera. why: reasons by name; others: names of each group that fits together, but
    not with the placed photos; total: number of photos."""
    if why:
        listed = "; ".join(f"{', '.join(names)} ({kind})" for kind, names in _by_kind(why).items())
        yield (f"{len(why)} of {total} photos have no camera and are left out: {listed}. Take sharp photos between "
               "them and the others, in steps of 15 degrees; photos of something else and mirror images never "
               "fit")  # fmt: skip
    for group in others:
        yield ("these photos fit together, but not with the rest: " + ", ".join(group)
               + "; if they show another subject, put them into a separate capture")  # fmt: skip


def _by_kind(why: Mapping[str, str]) -> dict[str, list[str]]:
    """Names of photos by kind of reason: no match, other group, blurred, few features, weak match."""
    out: dict[str, list[str]] = {}
    for name, reason in why.items():
        out.setdefault(reason.split(":")[0], []).append(name)
    return out


def _not_placed(total: int, placed: int, why: Mapping[str, str]) -> StageError:
    """total: number of photos that are not held out; placed: of those that have a camera."""
    missing = list(why)
    named = ", ".join(missing[:12]) + (f" and {len(missing) - 12} more" if len(missing) > 12 else "")
    return StageError(
        "the photos do not fit together" if placed else "the photos have no matches",
        where="poses",
        value=f"{placed} of {total} have a camera; without a camera: {named}",
        limit=f"at least {MIN_FITTED} that are not held out",
        remedy="take sharp photos around one still subject, each overlapping the next by two thirds (15 degrees or "
        "less apart), with the lens at one zoom; remove the listed photos if they show something else; or give the "
        "cameras in params.json",
    )
