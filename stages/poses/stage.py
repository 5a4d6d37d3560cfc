"""poses: checked photos in, cameras in asset coordinates out. Given cameras are used as they are, else solved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pydantic import Field, field_validator

from pipeline.artifacts import Camera, CameraSet, Capture, Located
from pipeline.contract import Context, Stage, StageConfig
from pipeline.errors import StageError, UsageError

if TYPE_CHECKING:
    from stages.poses.normalise import Normalisation
    from stages.poses.photogrammetry import Settings
    from stages.poses.solve import Model


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
    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="place photos one after the other, or all at once; auto: all at once from 200 photos on"
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
    given: Literal["keep", "triangulate", "refine"] = Field(
        "keep",
        description="given cameras: keep them; triangulate: find points on the subject too; refine: and move the "
        "cameras to where the photos say, their centres held near the given ones",
    )
    given_deviation: float = Field(
        0.005, gt=0, le=0.2, description="how far given centres may be off, of their distance from the subject (refine)"
    )
    unit: Literal["auto", "metres", "centimetres", "millimetres", "unknown"] = Field(
        "auto",
        description="unit of the given cameras; auto: FaceScape's from the subject's size, other formats' unknown",
    )
    scale: Literal["auto", "none", "distance", "markers", "pupils", "gps"] = Field(
        "auto", description="where metres are from; auto: the first of these that the settings and photos give"
    )
    distance: str = Field(
        "", description='a known distance: "1.jpg to 5.jpg = 0.42" (metres; cameras, or points as PHOTO@X,Y+PHOTO@X,Y)'
    )
    marker_mm: float = Field(0.0, ge=0, le=10000, description="edge of the black squares of markers; 0: there are none")
    marker_kind: Literal["aruco_4x4", "aruco_5x5", "aruco_6x6", "apriltag_16h5", "apriltag_25h9", "apriltag_36h11"] = (
        Field("aruco_4x4", description="family of the markers")
    )
    pupils_mm: float = Field(
        0.0, ge=0, le=100, description="distance between the subject's pupils, if you know it; 0: it is not used"
    )
    min_registered: float = Field(0.6, gt=0, le=1, description="least share of the photos that must find their place")

    @field_validator("distance")
    @classmethod
    def _grammar(cls, spec: str) -> str:
        from stages.poses.scale import check_distance

        return check_distance(spec)


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
    from stages.poses.measure import find_eyes, known_scale
    from stages.poses.normalise import Unit, normalise
    from stages.poses.place import camera_of, in_asset, save_points
    from stages.poses.scale import by_world

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
    right = [i for i in range(len(cameras)) if i not in wrong]
    cameras = [cameras[i] for i in right]
    told = [f"{n} is left out: its photo and its camera do not belong together; check its file name and its pose"
            for n in names]  # fmt: skip
    model = None
    if config.given != "keep":
        model, cameras, doubtful = _held_against_photos(capture, right, cameras, config, context)
        if doubtful:
            told.append(
                "the photos say too little to mend the cameras of " + ", ".join(doubtful) + "; they stay as given"
            )
    eyes = find_eyes(capture, cameras, context.check) if config.pupils_mm else None
    known = known_scale(capture, cameras, config, eyes, told)
    world, axes = capture.artifact.metres_from_world, None
    if world is not None and config.unit == "auto":
        published, axes = by_world(matrix(world))
        known = published if known is None and config.scale == "auto" else known
    found = normalise(cameras, given=True, unit=unit, known=known, axes=axes)
    if model is not None:
        save_points(context.workdir / "points.npz", model, found.capture_from_asset)
    return CameraSet(
        source="given",
        metric=found.metric,
        scale=found.scale,
        capture_from_asset=_rows(found),
        roi_radius=found.roi_radius,
        cameras=in_asset(cameras, found.capture_from_asset),
        unregistered=names,
        reprojection_error_px=None if model is None else model.reprojection_error_px,
        view_errors_px={} if model is None else _view_errors(model, [c.name for c in cameras]),
        points=None if model is None else context.file("points.npz"),
        warnings=(*told, *found.warnings),
    )


def _held_against_photos(
    capture: Located[Capture], right: list[int], cameras: list[Camera], config: Config, context: Context
) -> tuple[Model, list[Camera], list[str]]:
    """Points triangulated from the given cameras `right` of the capture; the cameras, moved if asked for; names of
    those that should have been and were not.

    Raises:
        StageError: the photos share no point under these cameras.
    """
    from stages.poses.normalise import nearest_point, viewing_rays
    from stages.poses.photogrammetry import triangulate_given
    from stages.poses.photos import photos_of
    from stages.poses.place import camera_of

    photos = photos_of(capture, config.use_masks)
    centres, axes = viewing_rays(cameras)
    distance = float(((centres - nearest_point(centres, axes)) ** 2).sum(1).mean() ** 0.5)
    found = triangulate_given(
        [photos[i] for i in right], cameras, _settings(capture, config), context.scratch, _progress(context),
        refine=config.given == "refine", deviation=config.given_deviation * distance,
    )  # fmt: skip
    if found is None:
        raise StageError("no point is seen by two photos", where="poses", value="0 points",
                         limit="features that neighbouring photos share",
                         remedy="set poses.given=keep to use the cameras as they are")  # fmt: skip
    model, doubtful = found
    names = [cameras[n].name for n in doubtful]
    if config.given == "refine":
        views, poses = [capture.artifact.views[i] for i in right], model.poses
        cameras = [camera_of(v, poses[n].K, poses[n].world_from_cam, c.distortion)
                   for n, (v, c) in enumerate(zip(views, cameras, strict=True))]  # fmt: skip
    return model, cameras, names


def _progress(context: Context) -> Callable[[int, int, str], None]:
    def progress(done: int, total: int, message: str) -> None:
        context.check()
        context.progress(done, total, message)

    return progress


def _settings(capture: Located[Capture], config: Config) -> Settings:
    from stages.poses.adjust import Refine
    from stages.poses.photogrammetry import Settings

    refine = Refine(config.refine_focal, config.refine_distortion, config.refine_principal_point)
    return Settings(
        config.seed, config.max_image_size, config.max_features, config.neighbours, config.shared_intrinsics,
        config.camera_model, refine, config.patience, config.mapper, capture.artifact.kind == "video",
    )  # fmt: skip


def _view_errors(model: Model, names: Sequence[str]) -> dict[str, float]:
    return {names[i]: round(e, 4) for i, e in sorted(model.view_error_px.items()) if e == e}


def _contradicted(
    capture: Located[Capture], cameras: list[Camera], config: Config, context: Context
) -> list[int]:  # fmt: skip
    """Places of the views whose photos contradict their cameras.

    Raises:
        StageError: most of them do.
    """
    from stages.poses.check import FAR, IMPERFECT, check_cameras, features_of
    from stages.poses.photos import photos_of

    progress = _progress(context)
    photos = photos_of(capture, config.use_masks)
    features = features_of(photos, lambda n, m: progress(n, m, "looking for features"))
    far = IMPERFECT if config.given == "refine" else FAR
    verdict = check_cameras(cameras, features, config.seed, lambda n, m: progress(n, m, "checking the cameras"), far)
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
    from stages.poses.measure import find_eyes, known_scale
    from stages.poses.normalise import normalise
    from stages.poses.photogrammetry import solve
    from stages.poses.photos import photos_of
    from stages.poses.place import camera_of, in_asset, save_points

    views = capture.artifact.views
    model = solve(photos_of(capture, config.use_masks), _settings(capture, config), context.scratch, _progress(context))
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
    save_points(context.workdir / "points.npz", model, found.capture_from_asset)
    warnings += found.warnings
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
        scale=found.scale,
        capture_from_asset=_rows(found),
        roi_radius=found.roi_radius,
        cameras=in_asset(cameras, found.capture_from_asset),
        unregistered=missing,
        reprojection_error_px=model.reprojection_error_px,
        view_errors_px=_view_errors(model, [v.name for v in views]),
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


STAGE = Stage(name="poses", version=3, inputs=Inputs, config=Config, output=CameraSet, run=run)
