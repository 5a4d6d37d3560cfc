"""The stage: fits the model to the photos and predicts the held-out views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pipeline.artifacts import CameraSet, FittedFace, Located, MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage
from pipeline.errors import StageError
from pipeline.memory import give_back
from pipeline.together_artifacts import Together
from stages.inverse_rendering.config import AUTO, MAX_ORDER
from stages.inverse_rendering.config import Config as Config
from stages.inverse_rendering.systems import COMPARED, paper_config

if TYPE_CHECKING:
    from stages.inverse_rendering.second_photos import Other

MIN_VIEWS = 3


@dataclass(frozen=True, slots=True)
class Inputs:
    """Photos, cameras, masks."""

    capture: Located[Capture]
    poses: Located[CameraSet]
    masks: Located[MaskSet]


@dataclass(frozen=True, slots=True)
class BothInputs:
    """The same of two captures, and where the second lies."""

    capture: Located[Capture]
    poses: Located[CameraSet]
    masks: Located[MaskSet]
    also_capture: Located[Capture]
    also_poses: Located[CameraSet]
    also_masks: Located[MaskSet]
    together: Located[Together]


def run(inputs: Inputs, config: Config, context: Context) -> FittedFace:
    """Fit the field and predict the held-out views."""
    return fit(inputs, config, context, None)


def run_both(inputs: BothInputs, config: Config, context: Context) -> FittedFace:
    """Fit one field to the photos of two captures, each under its own light, and predict the held-out views of both."""
    from pipeline.transforms import matrix
    from stages.inverse_rendering.second_photos import Other, check_supported, moved_poses

    check_supported((inputs.capture.artifact, inputs.also_capture.artifact), config)
    placed = inputs.together.artifact
    offset = 1 + max(v.index for v in inputs.capture.artifact.views)
    poses = moved_poses(inputs.also_poses.artifact, matrix(placed.first_from_second))
    other = Other(inputs.also_capture, poses, inputs.also_masks, offset, placed)
    return fit(Inputs(inputs.capture, inputs.poses, inputs.masks), config, context, other)


def fit(inputs: Inputs, config: Config, context: Context, other: Other | None) -> FittedFace:
    """Fit the field to a capture, or to two of one subject, and predict the held-out views."""
    from pipeline.faces.landmarks3d import load_landmarks, photos_of_face
    from pipeline.maths.light_frame import WORLD
    from stages.inverse_rendering.albedo_level import set_level
    from stages.inverse_rendering.choose_start import choose_start
    from stages.inverse_rendering.exposure import DRIFT, exposures_differ
    from stages.inverse_rendering.footprint import footprint, supported
    from stages.inverse_rendering.given_light import given_light
    from stages.inverse_rendering.held_out_colour import held_out_colours
    from stages.inverse_rendering.initial_geometry import agreed
    from stages.inverse_rendering.judge import Fitted, findings
    from stages.inverse_rendering.load_views import read_labels, read_views
    from stages.inverse_rendering.moving_light import light_frame
    from stages.inverse_rendering.outline_level import set_outline_level
    from stages.inverse_rendering.outputs import (
        SURROUNDINGS,
        fitted_photos,
        model_facts,
        predict_held_out,
        write_light,
        write_surroundings,
    )
    from stages.inverse_rendering.preview import Preview
    from stages.inverse_rendering.registered_views import registered_views
    from stages.inverse_rendering.residuals import view_errors
    from stages.inverse_rendering.second_photos import read_second, refuse_moving, second_result
    from stages.inverse_rendering.systems import first_surface, trainer_for
    from stages.inverse_rendering.time_budget import MIN_TRAINING, Clock, seconds_to_predict
    from stages.inverse_rendering.training_loop import Hooks, run_fit

    clock, settings = Clock(context.waited), config
    known = None
    if settings.preset not in COMPARED:  # which estimate their light
        known = given_light(inputs.capture.artifact, inputs.poses.artifact, config)
    if known is not None and settings.light_order == AUTO:
        settings = settings.changed(light_order=MAX_ORDER)
    dropped = set(inputs.masks.artifact.dropped)
    held = {v.index for v in inputs.capture.artifact.views if v.holdout}
    usable = [c.index for c in inputs.poses.artifact.cameras if c.index not in held and c.index not in dropped]
    if len(usable) < MIN_VIEWS:
        raise StageError(
            "too few views are left to fit",
            where="inverse_rendering",
            value=len(usable),
            limit=f"at least {MIN_VIEWS}",
            remedy="add photos, or hold out fewer with --holdout",
        )
    context.progress(0, settings.steps, "reading photos")
    if inputs.capture.artifact.polarised and settings.specular == AUTO:
        settings = settings.changed(specular="off")  # cross-polarised photos show no highlights
    views = read_views(inputs.capture, inputs.poses.artifact, inputs.masks, usable, settings.image_side)
    cameras = [c for c in inputs.poses.artifact.cameras if c.index in set(usable)]
    context.progress(0, settings.steps, "visual hull")
    radius, extent = inputs.poses.artifact.roi_radius, inputs.masks.artifact.extent
    masks = agreed(cameras, [v.alpha for v in views], radius)
    views = [replace(v, doubtful=masks.doubtful.get(n)) for n, v in enumerate(views)]
    start = first_surface(settings, cameras, masks.alphas, radius, extent)
    looked = footprint(start, views, settings.image_side)
    if settings.resolution == AUTO:
        settings, cells = supported(settings, looked, start), settings.grid_cells
        if settings.grid_cells < cells:
            start = first_surface(settings, cameras, masks.alphas, radius, extent)
    context.progress(0, settings.steps, "initial geometry")
    ref = inputs.masks.artifact.landmarks
    landmarks = None if ref is None else load_landmarks(inputs.masks.path(ref))
    showing = () if ref is None else photos_of_face(inputs.masks.path(ref))
    chosen = choose_start(start, views, landmarks, settings, context.device, context.check, showing)
    start = chosen.start
    give_back()  # what stereo and depth maps took
    if settings.follow_flow == AUTO:
        settings = settings.changed(follow_flow="on" if chosen.cut_by_template else "off")
    lit = None
    if settings.preset not in COMPARED and known is None:  # a given light stands still
        fired = [v.flash is True for v in inputs.capture.artifact.views if v.index in set(usable)]
        lit = light_frame(views, start, settings.light_frame, context.device, sum(fired) / len(fired))
    moving = None if lit is None or lit.flux is None else lit.spread > DRIFT
    names = inputs.masks.artifact.label_names
    second = None
    if other is not None:
        refuse_moving("world" if lit is None else lit.frame, "first")
        own = calibrated(other.capture.artifact, other.usable, config, lambda: False)
        second = read_second(other, names, start, settings, own, context.device)
    own_colours = calibrated(
        inputs.capture.artifact,
        usable,
        config,
        lambda: exposures_differ(views, start, context.device) if moving is None else moving,
    )
    trainer = trainer_for(views, start, settings, own_colours, context.device, chosen.prior, known, lit, second)
    labels = read_labels(inputs.masks, usable) + (second.labels if second else [])
    trainer.know_labels(labels, names)
    if chosen.near_head is not None:
        trainer.know_head(chosen.near_head, chosen.plain_face)
    if settings.by_clock:
        held_cameras = [c for c in inputs.poses.artifact.cameras if c.index in held]
        reserve = seconds_to_predict(trainer.model, held_cameras, settings, context.device)
        trainer.allowance = max(settings.seconds - clock.elapsed() - reserve, MIN_TRAINING * settings.seconds)
    preview = Preview(views, context.show, context.device)
    model = run_fit(trainer, Hooks(context.progress, context.cancelled, context.scratch / "checkpoint.pt", preview))
    views = trainer.views  # with the cameras that the fit moved
    light = trainer.choices.facts.get("light", {}) if trainer.choices else {}
    wanted = "fitted" if known is not None and known.scaled and config.albedo_level == AUTO else config.albedo_level
    level = set_level(model, trainer.pixels, views, labels, names, wanted, light)
    if known is not None and wanted == "fitted":
        level["why"] = "the light's level is given"
    outline = set_outline_level(model, views)
    every = model
    if second is not None:  # the stages after this one know a single capture
        model = every.of_light(second=False)
    model.save(context.workdir / "field.npz")
    write_light(model, context)
    still = known is None and (lit is None or lit.frame == WORLD)
    around = write_surroundings(model, views, context) if config.surroundings and still else None
    widths = {c.index: c.width for c in cameras} | (other.widths if other is not None else {})
    colours = held_out_colours(model, inputs.capture.artifact, inputs.poses.artifact, usable)
    held_out = predict_held_out(
        model, inputs.poses.artifact, colours.responses, config.image_side, config.samples, context
    )
    registered = registered_views(
        model, inputs.capture, inputs.poses.artifact, inputs.masks, held_out, settings, context
    )
    facts = {**model_facts(trainer, looked, chosen.facts), "albedo": level, "outline": outline}
    if colours.facts:
        facts["held_out_colours"] = colours.facts
    if lit is not None:
        facts["light_frame"] = lit.facts()
    if around is not None:
        facts["surroundings"] = dict(around.facts())
    sizes = settings.image_side, settings.samples
    both, weights = view_errors(every, trainer.pixels, views, *sizes, labels, names), trainer.photo_weights()
    left, added = [e for e in both if other is None or e.index < other.offset], None
    if other is not None:
        theirs = fitted_photos(both[len(left) :], other.fitted, weights[len(usable) :])
        added = second_result(every.of_light(second=True), other, config, theirs, context)
        facts["second_capture"] = other.facts(added) | trainer.second_facts()
    fitted = Fitted(left, inputs.capture.artifact, inputs.masks.artifact, trainer.history, facts)
    return FittedFace(
        field=context.file("field.npz"),
        light=context.file("light.json"),
        rank=model.spec.rank,
        light_order=model.spec.light_order,
        fitted_views=tuple(usable),
        held_out=held_out,
        steps=trainer.step,
        loss=round(trainer.loss, 8),
        psnr=round(trainer.psnr, 4),
        beta=float(model.beta),
        cell=model.geometry.cell,
        model=facts,
        refined=tuple(c for c in trainer.refined_cameras(widths) if c.index in set(usable)),
        registered=registered,
        photos=fitted_photos(left, usable, weights[: len(usable)]),
        surroundings=None if around is None else context.file(SURROUNDINGS),
        second=added,
        findings=findings(fitted),
    )


def calibrated(capture: Capture, usable: list[int], config: Config, exposures_differ: Callable[[], bool]) -> bool:
    """Whether per-image colour matrices are fitted at the start: by the setting, else by metadata, cameras or
    photos."""
    if config.calibration != AUTO:
        return config.calibration == "on"
    cameras = {v.camera_group for v in capture.views if v.index in set(usable)}
    return capture.colours_drift or len(cameras) > 1 or exposures_differ()


STAGE = Stage(
    name="inverse_rendering",
    version=57,
    inputs=Inputs,
    config=Config,
    output=FittedFace,
    run=run,
    variants=dict.fromkeys(COMPARED, paper_config),
)
BOTH = Stage(STAGE.name, STAGE.version, BothInputs, Config, FittedFace, run_both)  # of two captures
