"""poses: checked photos in, cameras in asset coordinates out. Given cameras are used as they are, else solved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from pipeline.artifacts import Camera, CameraSet, Capture, Located
from pipeline.contract import Context, Stage, StageConfig
from pipeline.errors import StageError, UsageError

if TYPE_CHECKING:
    from stages.poses.normalise import Normalisation


@dataclass(frozen=True, slots=True)
class Inputs:
    """The checked photos."""

    capture: Located[Capture]


class Config(StageConfig):
    """Settings of the poses stage."""

    method: Literal["auto", "given", "colmap"] = Field(
        "auto",
        description="given: cameras of the capture; colmap: solved from the photos; auto: given if there are any",
    )
    seed: int = Field(0, ge=0, lt=2**31, description="seed of every random choice")
    max_image_size: int = Field(1000, ge=200, description="longest edge, in pixels, at which features are looked for")
    max_features: int = Field(1500, ge=200, le=20000, description="most features per photo")
    neighbours: int = Field(14, ge=2, description="partners that a photo is matched with; up to 20 photos, all")
    patience: int = Field(
        3, ge=1, le=3, description="tries while photos lack a place: 1 plain, 2 without noise, 3 also as if seen askew"
    )
    shared_intrinsics: Literal["auto", "yes", "no"] = Field(
        "auto", description="one lens for all photos of equal size and EXIF; auto: unless far more photos fit without"
    )
    camera_model: Literal["SIMPLE_RADIAL", "OPENCV"] = Field(
        "SIMPLE_RADIAL", description="lens model: one radial term, or two radial and two tangential ones"
    )
    refine_focal: bool = Field(True, description="let the solver move focal lengths")
    refine_distortion: bool = Field(True, description="let the solver move the lens distortion")
    refine_principal_point: Literal["auto", "yes", "no"] = Field(
        "auto", description="let the solver move the principal point; auto: at the end, if the photos tell where it is"
    )
    use_masks: bool = Field(True, description="look for features on the subject only, where the capture has masks")
    check: bool = Field(True, description="hold given cameras against the photos; leave out views that contradict")
    unit: Literal["auto", "metres", "centimetres", "millimetres", "unknown"] = Field(
        "auto",
        description="unit of the given cameras; auto: FaceScape's from the subject's size, other formats' unknown",
    )
    min_registered: float = Field(0.6, gt=0, le=1, description="least share of the photos that must find their place")


MIN_FITTED = 3


def run(inputs: Inputs, config: Config, context: Context) -> CameraSet:
    """Cameras around the subject.

    Raises:
        UsageError: given cameras are asked for and there are none.
        StageError: the given cameras share no view or contradict the photos, or the photos can't be placed.
    """
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
    if all_given and config.method != "colmap":
        return _given(inputs.capture, config, context)
    return _solved(inputs.capture, config, context)


def _given(capture: Located[Capture], config: Config, context: Context) -> CameraSet:
    """The capture's own cameras, moved to asset coordinates; without views that their photos contradict."""
    from pipeline.transforms import inverse_rigid, matrix
    from stages.poses.normalise import Unit, normalise
    from stages.poses.place import camera_of, in_asset

    cameras = [
        camera_of(v, matrix(c.K), inverse_rigid(matrix(c.cam_from_world)), c.distortion)
        for v, c in ((v, v.camera) for v in capture.artifact.views)
        if c is not None
    ]
    # only FaceScape says what its numbers are: metres or millimetres; the others' worlds have any size
    auto: Unit = "guess" if capture.artifact.kind == "facescape" else "unknown"
    unit: Unit = auto if config.unit == "auto" else config.unit
    wrong = _contradicted(capture, cameras, config, context) if config.check else []
    names = tuple(cameras[i].name for i in wrong)
    cameras = [c for i, c in enumerate(cameras) if i not in wrong]
    found = normalise(cameras, given=True, unit=unit)
    told = [f"{n} is left out: its photo and its camera do not belong together; check its file name and its pose"
            for n in names]  # fmt: skip
    return CameraSet(
        source="given",
        metric=found.metric,
        capture_from_asset=_rows(found),
        roi_radius=found.roi_radius,
        cameras=in_asset(cameras, found.capture_from_asset),
        unregistered=names,
        warnings=(*told, *found.warnings),
    )


def _contradicted(
    capture: Located[Capture], cameras: list[Camera], config: Config, context: Context
) -> list[int]:  # fmt: skip
    """Places of the views whose photos contradict their cameras.

    Raises:
        StageError: most of them do.
    """
    from stages.poses.check import check_cameras, features_of
    from stages.poses.photos import photos_of

    def progress(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    photos = photos_of(capture, config.use_masks)
    features = features_of(photos, lambda n, m: progress(n, m, "looking for features"))
    verdict = check_cameras(cameras, features, config.seed, lambda n, m: progress(n, m, "checking the cameras"))
    if verdict.known and len(verdict.wrong) > 0.5 * verdict.known:
        raise StageError(
            "the cameras do not belong to the photos",
            where="poses",
            value=f"{len(verdict.wrong)} of {verdict.known} views contradict their neighbours, such as "
            + ", ".join(cameras[i].name for i in verdict.wrong[:5]),
            limit="most views' features on each other's epipolar lines",
            remedy="check that photos and cameras are in the same order and of the same size, or set "
            "poses.method=colmap to have the cameras solved; poses.check=false uses them as they are",
        )
    return verdict.wrong


def _solved(capture: Located[Capture], config: Config, context: Context) -> CameraSet:
    """Cameras from the photos alone."""
    from stages.poses.normalise import normalise
    from stages.poses.photogrammetry import Settings, solve
    from stages.poses.photos import photos_of
    from stages.poses.place import camera_of, in_asset, save_points
    from stages.poses.solve import Refine

    def progress(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    views = capture.artifact.views
    refine = Refine(config.refine_focal, config.refine_distortion, config.refine_principal_point)
    settings = Settings(
        config.seed, config.max_image_size, config.max_features, config.neighbours, config.shared_intrinsics,
        config.camera_model, refine, config.patience,
    )  # fmt: skip
    model = solve(photos_of(capture, config.use_masks), settings, context.scratch, progress)
    placed = sorted(model.poses) if model is not None else []
    missing = tuple(v.name for i, v in enumerate(views) if i not in placed)
    strangers = {i for group in (model.others if model is not None else ()) for i in group} - set(placed)
    fitted = sum(not views[i].holdout for i in placed)
    if model is None or len(placed) < config.min_registered * (len(views) - len(strangers)) or fitted < MIN_FITTED:
        raise _not_placed(len(views), len(placed), fitted, missing, config.min_registered)
    cameras = [camera_of(views[i], p.K, p.world_from_cam, p.distortion) for i, p in model.poses.items()]
    found = normalise(cameras, model.points, given=False)
    save_points(context.workdir / "points.npz", model, found.capture_from_asset)
    warnings = [*found.warnings]
    if missing:
        warnings.append(f"{len(missing)} of {len(views)} photos found no place and are left out: {', '.join(missing)}; "
                        "they show something else, are mirrored or blurred, or stand too far from the others: "
                        "photograph the way between")  # fmt: skip
    for group in model.others if strangers else ():
        warnings.append("these photos fit together, but not with the rest: " + ", ".join(views[i].name for i in group)
                        + "; if they show another subject, make a capture of their own")  # fmt: skip
    return CameraSet(
        source="colmap",
        metric=found.metric,
        capture_from_asset=_rows(found),
        roi_radius=found.roi_radius,
        cameras=in_asset(cameras, found.capture_from_asset),
        unregistered=missing,
        reprojection_error_px=model.reprojection_error_px,
        view_errors_px={views[i].name: round(e, 4) for i, e in sorted(model.view_error_px.items()) if e == e},
        points=context.file("points.npz"),
        warnings=tuple(warnings),
    )


def _rows(found: Normalisation) -> tuple[tuple[float, ...], ...]:
    from pipeline.transforms import rows

    return rows(found.capture_from_asset)


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


STAGE = Stage(name="poses", version=2, inputs=Inputs, config=Config, output=CameraSet, run=run)
