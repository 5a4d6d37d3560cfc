"""Cameras from the photos alone: who has a place, what is told of those that have none, and the asset's coordinates."""

from __future__ import annotations

from pipeline.artifacts import CameraSet, Capture, Located
from pipeline.contract import Context
from pipeline.errors import StageError
from stages.poses.adjust import Refine
from stages.poses.judge import groups, mirrored
from stages.poses.measure import find_eyes, known_scale
from stages.poses.mirrored import find_mirrored
from stages.poses.normalise import normalise
from stages.poses.photogrammetry import Settings, solve
from stages.poses.photos import photos_of
from stages.poses.place import camera_of, camera_set
from stages.poses.settings import Config
from stages.poses.ticks import progress_of

MIN_FITTED = 3


def solved_cameras(capture: Located[Capture], config: Config, context: Context) -> CameraSet:
    """Cameras from the photos alone.

    Raises:
        StageError: fewer photos than `min_registered` of those that show the subject have a place.
    """
    views = capture.artifact.views
    model = solve(
        photos_of(capture, config.use_masks), settings_of(capture, config), context.scratch, progress_of(context)
    )
    placed = sorted(model.poses) if model is not None else []
    missing = tuple(v.name for i, v in enumerate(views) if i not in placed)
    strangers = {i for group in (model.others if model is not None else ()) for i in group} - set(placed)
    fitted = sum(not views[i].holdout for i in placed)
    if model is None or len(placed) < config.min_registered * (len(views) - len(strangers)) or fitted < MIN_FITTED:
        raise _not_placed(len(views), len(placed), fitted, missing, config.min_registered)
    cameras = [camera_of(views[i], p.K, p.world_from_cam, p.distortion) for i, p in model.poses.items()]
    warnings: list[str] = []
    eyes = find_eyes(capture, cameras, context.check)
    known = known_scale(capture, cameras, config, eyes, warnings)
    found = normalise(cameras, model.points, given=False, known=known, eyes=eyes)
    warnings += found.warnings
    if missing:
        warnings.append(f"{len(missing)} of {len(views)} photos found no place and are left out: {', '.join(missing)}; "
                        "they show something else, are mirrored or blurred, or stand too far from the others: "
                        "photograph the way between")  # fmt: skip
    for group in model.others if strangers else ():
        warnings.append("these photos fit together, but not with the rest: " + ", ".join(views[i].name for i in group)
                        + "; if they show another subject, make a capture of their own")  # fmt: skip
    made = camera_set("colmap", cameras, found, model, [v.name for v in views], missing, warnings, context)
    lost = [i for i in range(len(views)) if i not in placed]
    flipped = find_mirrored(photos_of(capture, config.use_masks), lost, placed, config.seed)
    findings = (groups(len(placed), [[views[i].name for i in group] for group in model.others] if strangers else []),
                mirrored([views[i].name for i in flipped], len(views)))  # fmt: skip
    return made.model_copy(update={"findings": findings})


def settings_of(capture: Located[Capture], config: Config) -> Settings:
    """What the solver is to do. A film's frames follow each other."""
    refine = Refine(config.refine_focal, config.refine_distortion, config.refine_principal_point)
    return Settings(
        config.seed, config.max_image_size, config.max_features, config.neighbours, config.shared_intrinsics,
        config.camera_model, refine, config.patience, config.mapper, capture.artifact.kind == "video",
    )  # fmt: skip


def _not_placed(total: int, placed: int, fitted: int, missing: tuple[str, ...], share: float) -> StageError:
    named = ", ".join(missing[:12]) + (f" and {len(missing) - 12} more" if len(missing) > 12 else "")
    if placed < share * total:
        value, limit = f"{placed} of {total} placed; without a place: {named}", f"at least {share:.0%}"
    else:
        value, limit = f"{fitted} placed views that are not held out", f"at least {MIN_FITTED}"
    return StageError(
        "the photos do not fit together" if placed else "the photos show nothing in common",
        where="poses",
        value=value,
        limit=limit,
        remedy="take the photos around one still subject, sharp, each overlapping the next by two thirds (15 degrees "
        "or less apart), with the lens at one zoom; remove those named if they show something else; or give the "
        "cameras in params.json",
    )
