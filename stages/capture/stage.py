"""capture: reads the user's folder and writes checked photos with their given cameras and masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, field_validator

from pipeline.artifacts import FileRef, Located
from pipeline.capture_artifacts import Capture, CaptureSource
from pipeline.contract import Context, Stage, StageConfig
from pipeline.errors import StageError
from pipeline.units import Unit, Views
from stages.capture.holdout import check_rule, held_out


@dataclass(frozen=True, slots=True)
class Inputs:
    """The result of `stages.capture.scan.scan_capture`."""

    source: Located[CaptureSource]


class Config(StageConfig):
    """Settings of the capture stage."""

    holdout: str = Field("none", description="held-out views, never fitted: none | every:N:K | names:a.jpg,b.jpg")
    min_views: Views = Field(3, ge=3, description="fewest views for the fit; with fewer the stage fails")
    frames: Annotated[int, Unit("frames")] = Field(
        60, ge=8, le=500, description="frames to take from a video, spread over the camera's path"
    )
    drop_blurred: bool = Field(True, description="leave out photos with far less detail than the others")
    colour_checker: Literal["auto", "on", "off"] = Field(
        "auto",
        description="colour correction by a colour checker of 24 patches that some photos show; its white becomes the "
        "photos' white and unit. auto: if it is found; on: an error if it is not found; off: no search",
    )

    brackets: Literal["auto", "off"] = Field(
        "auto",
        description="photos of one view at several exposures. auto: they are merged to one linear photo; off: one "
        "exposure of each view is used",
    )
    polarised: Literal["auto", "off"] = Field(
        "auto",
        description="pairs of cross- and parallel-polarised photos. auto: shape and albedo come from the "
        "cross-polarised ones, F0 and roughness from the difference; off: the cross-polarised ones are fitted as any "
        "photos",
    )

    @field_validator("holdout")
    @classmethod
    def _grammar(cls, rule: str) -> str:
        return check_rule(rule)


def run(inputs: Inputs, config: Config, context: Context) -> Capture:
    """Check every photo, mask and given camera, and copy the ones that are used into the artifact.

    Photos that can't be used (blank, far more blurred than the others, duplicates) and unusable masks are left out with
    a warning.

    Raises:
        StageError: an incomplete file or one of the wrong size, a bad camera, too few views, a colour checker that is
            required and not found, exposures or polarised pairs that do not belong together.
    """
    from stages.capture import views as made
    from stages.capture.brackets import merged_photos
    from stages.capture.candidates import candidates_of, useful, without_duplicates
    from stages.capture.judge import Photo, given_masks, judge
    from stages.capture.polarised import with_pairs

    source = _photos_of_video(inputs.source, config, context)
    selection = candidates_of(source)
    described = set(selection.absent)
    candidates = without_duplicates(selection, given=source.artifact.cameras != ())
    look = config.colour_checker != "off"
    held = held_out(config.holdout, [(c.index, c.name) for c in candidates], selection.absent)
    merged = None
    if config.brackets == "auto":
        merged = merged_photos(source, candidates, held, selection.warnings, context)
    photos = [made.photo_of(source, c, (n, len(candidates)), look, context, merged) for n, c in enumerate(candidates)]
    candidates, photos = useful(candidates, photos, selection, config.drop_blurred, held)
    held = held_out(config.holdout, [(c.index, c.name) for c in candidates], selection.absent)
    if config.holdout != "none" and not held:
        selection.warnings.append(f"the hold-out rule {config.holdout} matches no view that is used")
    _enough(len(candidates) - len(held), len(held), selection.left_out, config.min_views)
    views = [made.view_of(source, c, p, c.index in held, selection.warnings, context)
             for c, p in zip(candidates, photos, strict=True)]  # fmt: skip
    if merged is not None:
        views = [v.model_copy(update={"merged": merged.count(v.index)}) for v in views]
    if config.polarised == "auto":
        views = with_pairs(source, candidates, views, photos, selection.warnings, context)
    views = made.with_exposures(made.with_places(views, photos), photos, selection.warnings)
    views, chart = made.with_chart(views, photos, selection.warnings, config.colour_checker == "on", context)
    drift = made.colours_drift(views, photos)
    seen = [Photo(v.name, v.camera_group, v.width, v.height, v.exposure, v.holdout, p.look)
            for v, p in zip(views, photos, strict=True) if p.look is not None]  # fmt: skip
    useless = [c.name for c, v in zip(candidates, views, strict=True) if c.mask is not None and v.mask is None]
    masked = sum(v.mask is not None for v in views)
    stage = None
    if source.artifact.kind == "olat":
        from stages.capture.light_stage import import_stage

        found = import_stage(source, views, context)
        stage, views = found.stage, found.views
        selection.warnings.extend(found.warnings)
    absent = [n for n in selection.absent if n not in described]
    findings = (*judge(seen, absent, source.artifact.passed_over, light_stage=stage is not None),
                *given_masks(masked, useless), *(found.findings if stage else ()))  # fmt: skip
    warnings = (
        selection.warnings + made.not_read(source.artifact.passed_over) + made.foreign_colours(candidates, photos)
    )
    warnings += made.twins(source.artifact.twins)
    warnings += made.partly_masked(views) + made.mixed_kinds(candidates) + made.contradicting_flash(views)
    return Capture(kind=source.artifact.kind, views=tuple(views), colours_drift=drift, chart=chart,
                   metres_from_world=source.artifact.metres_from_world, stage=stage,
                   left_out=tuple(selection.left_out), warnings=tuple(warnings), findings=findings)  # fmt: skip


def _photos_of_video(source: Located[CaptureSource], config: Config, context: Context) -> Located[CaptureSource]:
    """The source itself; for a video, its frames."""
    if source.artifact.kind != "video":
        return source
    from stages.capture.video import frames_of

    def tick(done: int, total: int) -> None:
        context.check()
        context.progress(done, total, "selecting frames of the video")

    frames = frames_of(source.path(source.artifact.photos[0]), context.scratch / "frames", config.frames, tick)
    photos = tuple(FileRef.of(context.scratch / "frames", f) for f in frames)
    return Located(CaptureSource(kind="video", photos=photos), context.scratch / "frames")


def _enough(fitted: int, held: int, left_out: list[str], limit: int) -> None:
    if fitted < limit:
        raise StageError("too few views remain for the fit", where="capture",
                         value=f"{fitted} to fit, {held} held out, {len(left_out)} left out",
                         limit=f"at least {limit} views", remedy="hold out fewer views, or add photos")  # fmt: skip


STAGE = Stage(name="capture", version=18, inputs=Inputs, config=Config, output=Capture, run=run, any_threads=True)
