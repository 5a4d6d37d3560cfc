"""The stage: settings from a preset, photos from the store, a fitted field and its held-out views back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.artifacts import CameraSet, Capture, FittedFace, Located, MaskSet
from pipeline.contract import Context, Stage, StageConfig
from pipeline.errors import StageError
from stages.inverse_rendering.settings import AUTO, PRESETS, FitSettings

MIN_VIEWS = 3


@dataclass(frozen=True, slots=True)
class Inputs:
    """Photos, cameras, masks."""

    capture: Located[Capture]
    poses: Located[CameraSet]
    masks: Located[MaskSet]


class Config(StageConfig):
    """A preset, and any of its settings changed. The filled-in settings are what the key sees."""

    preset: str = Field("draft", description="point on the curve of speed against accuracy")
    seed: int = Field(0, ge=0, description="seed of every random draw")
    image_side: int = Field(description="longest side of the photos in the fit's last phase, pixels", ge=32, le=16384)
    steps: int = Field(description="optimisation steps; not counted where seconds is set", ge=1, le=10_000_000)
    seconds: float = Field(
        description="length of the whole stage by the clock, every schedule with it; 0: by steps, which alone repeats",
        ge=0,
        le=1e7,
    )
    batch: int = Field(description="rays a step", ge=16, le=1_048_576)
    samples: int = Field(description="samples a ray in the shell around the surface", ge=4, le=128)
    grid_cells: int = Field(description="cells of the final SDF grid along the subject's longest side", ge=16, le=2048)
    levels: int = Field(description="grid resolutions from coarse to fine, each half the cell before", ge=1, le=4)
    stereo: bool = Field(description="move the hull to where the photos agree before the fit begins (prior hull)")
    rank: Annotated[int, Field(ge=1, le=8)] | Literal["auto"] = Field(
        description="k, number of specular bases [NeuFace eq. 7]; auto: by evidence, at most 3"
    )
    light_order: Annotated[int, Field(ge=0, le=10)] | Literal["auto"] = Field(
        description="SH order of the light [NeuFace eq. 2]; auto: by evidence"
    )
    light_from: Literal["lobe", "even"] = Field(
        description="what tells the light in mid-fit: what changes with the view, in closed form; or even skin alone"
    )
    attenuation: Literal["exponential", "exact", "phong"] = Field(
        description="of the light under the lobe [NeuFace eq. 11]"
    )
    basis_inputs: Literal["cosine", "paper"] = Field(description="what the bases see: wo . n, or (wo, n, wo . n)")
    density: Literal["crossing", "laplace"] = Field(description="crossing: no bias; laplace: the paper's")
    specular: Literal["auto", "on", "off"] = Field(description="model a specular term at all; auto: by evidence")
    relief: Literal["auto", "on", "off"] = Field(
        description="let the surface leave the prior that it begins as; auto: by evidence"
    )
    resolution: Literal["auto", "given"] = Field(
        description="auto: grid_cells and hash_fine no finer than the photos' pixels on the surface"
    )
    shadows: bool = Field(description="model what the surface itself hides and reflects of the light")
    volumetric: bool = Field(
        description="shade every sample of a ray as the paper does, not once a ray at the expected surface point"
    )
    precision: Literal["float32", "bfloat16"] = Field(description="of the networks' products while fitting")
    calibration: Literal["auto", "on", "off"] = Field(
        description="per-image colour matrices [NeuFace eq. 19]; auto: "
        "by evidence; until it is in, where the capture has more than one kind of camera"
    )
    hash_levels: int = Field(description="levels of the appearance encoding", ge=1, le=24)
    hash_log2_size: int = Field(description="log2 of the largest table", ge=8, le=24)
    hash_fine: float = Field(description="finest cell of the appearance encoding, asset units", gt=0, le=0.1)
    even_from: float = Field(description="share of the steps after which only the light is found for a while", ge=0)
    even_until: float = Field(description="share of the steps in which only the light is found", ge=0, lt=1)
    open_from: float = Field(description="share of the encoding's levels, coarse first, open at the start", ge=0, le=1)
    open_until: float = Field(description="share of the steps after which all levels are open", gt=0, le=1)
    width: int = Field(description="width of the appearance networks", ge=8, le=512)
    depth: int = Field(description="hidden layers of the appearance network", ge=1, le=16)
    method: Literal["fast", "paper"] = Field(
        description="fast: a grid, shaded once a ray; paper: networks, every sample"
    )
    appearance: Literal["hash", "sinusoidal"] = Field(description="the Spatial MLP's kind")
    shading: Literal["neural", "phong", "disney"] = Field(description="the specular term; the last two to compare")
    light: Literal["sh", "cubemap"] = Field(description="the captured light; cubemap to compare")
    integral: Literal["low_rank", "direct", "feature"] = Field(description="the material integral [NeuFace eq. 6]")
    basis_width: int = Field(description="width of the Integrated Basis MLP", ge=8, le=512)
    basis_depth: int = Field(description="hidden layers of the Integrated Basis MLP", ge=1, le=16)
    prior: Literal["hull", "sphere", "imface"] = Field(
        description="what the geometry starts from [NeuFace section 4.3]"
    )
    prior_file: str = Field(description="checkpoint of ImFace, for prior imface (docs/imface.md)", exclude=True)
    prior_digest: str = Field(description="sha256 of that file; filled in")
    prior_scale: float = Field(description="asset units (metres) per unit of ImFace", gt=0, le=1e6)
    prior_centre: tuple[float, float, float] = Field(description="ImFace's origin in asset coordinates")
    rgb: float = Field(description="lambda 1 [NeuFace eq. 21]", ge=0)
    mask: float = Field(description="weight of the opacity's cross-entropy against the masks", ge=0)
    white: float = Field(description="lambda 2 [NeuFace eq. 22]", ge=0)
    specular_energy: float = Field(description="lambda 3 [NeuFace eq. 23]", ge=0)
    shininess: float = Field(description="weight of the gauge that holds 1 / kappa near skin's", ge=0)
    parsimony: float = Field(description="weight of the gauge that gives shading to the light and not to albedo", ge=0)
    eikonal: float = Field(description="lambda 5 [NeuFace eq. 24]", ge=0)
    smooth: float = Field(description="weight of the normals' consistency", ge=0)
    embedding: float = Field(description="lambda 4 [NeuFace eq. 24], for prior imface", ge=0)
    displacement: float = Field(description="lambda 6 [NeuFace eq. 24], for method paper", ge=0)
    lr_sdf: float = Field(description="learning rate of the SDF, cells a step", gt=0, le=1)
    lr_appearance: float = Field(description="learning rate of the hash table; networks take 0.3 of it", gt=0, le=1)
    lr_light: float = Field(description="learning rate of the light's coefficients", gt=0, le=1)
    beta_end: float = Field(description="final width of the soft surface, finest cells", gt=0, le=10)
    max_dropped: int = Field(description="steps that are not finite after which the fit stops", ge=1, le=1_000_000)

    @field_validator("preset")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in PRESETS:
            raise ValueError(f"unknown preset {name!r}; choose one of {', '.join(PRESETS)}")
        return name

    @model_validator(mode="before")
    @classmethod
    def _filled(cls, data: Any) -> Any:
        given = dict(data) if isinstance(data, dict) else {}
        preset = PRESETS.get(str(given.get("preset", "draft")), {})
        filled = {**asdict(FitSettings()), **preset, **given}
        if filled.get("prior_file"):
            from pipeline.fields.imface_layout import digest

            filled["prior_digest"] = digest(str(filled["prior_file"]))
        return filled

    @field_validator("specular", "relief", mode="before")
    @classmethod
    def _switch(cls, value: Any) -> Any:
        return {"true": "on", "false": "off"}.get(str(value).lower(), value)

    @model_validator(mode="after")
    def _possible(self) -> Config:
        if self.relief == "off" and self.method != "fast":
            raise ValueError("relief = off is for method fast; the paper's displacement is what its method fits")
        if self.seconds > 0 and self.method != "fast":
            raise ValueError("seconds is for method fast; the paper's schedule counts epochs")
        return self

    def settings(self) -> FitSettings:
        """What the fit reads."""
        return FitSettings(**{f.name: getattr(self, f.name) for f in fields(FitSettings)})


def run(inputs: Inputs, config: Config, context: Context) -> FittedFace:
    """Fit the field and predict the held-out views."""
    from stages.inverse_rendering.begin import new_trainer
    from stages.inverse_rendering.clock import LEAST_TRAINING, Clock, seconds_to_predict
    from stages.inverse_rendering.deliver import model_facts, predict_held_out, write_light
    from stages.inverse_rendering.exposure import exposures_differ
    from stages.inverse_rendering.fit import Hooks, Trainer, run_fit
    from stages.inverse_rendering.footprint import footprint, supported
    from stages.inverse_rendering.gather import read_labels, read_views
    from stages.inverse_rendering.judge import Fitted, findings
    from stages.inverse_rendering.paper import new_paper_trainer
    from stages.inverse_rendering.residuals import view_errors
    from stages.inverse_rendering.start import agreed, hull_start, sphere_start
    from stages.inverse_rendering.stereo import start_from_photos

    clock, settings = Clock(), config.settings()
    dropped = set(inputs.masks.artifact.dropped)
    held = {v.index for v in inputs.capture.artifact.views if v.holdout}
    usable = [c.index for c in inputs.poses.artifact.cameras if c.index not in held and c.index not in dropped]
    if len(usable) < MIN_VIEWS:
        raise StageError(
            "too few views are left to fit",
            where="inverse_rendering",
            value=len(usable),
            limit=f"at least {MIN_VIEWS}",
            remedy="add photos, or hold fewer back with --holdout",
        )
    context.progress(0, settings.steps, "reading photos")
    views = read_views(inputs.capture, inputs.poses.artifact, inputs.masks, usable, settings.image_side)
    cameras = [c for c in inputs.poses.artifact.cameras if c.index in set(usable)]
    context.progress(0, settings.steps, "visual hull")
    radius, extent = inputs.poses.artifact.roi_radius, inputs.masks.artifact.extent
    masks = agreed(cameras, [v.alpha for v in views], radius)
    views = [replace(v, doubtful=masks.doubtful.get(n)) for n, v in enumerate(views)]
    if settings.prior == "sphere":
        start = sphere_start(radius, settings.grid_cells, settings.levels)
    else:
        start = hull_start(cameras, masks.alphas, radius, settings.grid_cells, settings.levels, extent)
    looked = footprint(start, views, settings.image_side)
    if settings.resolution == AUTO:
        settings, cells = supported(settings, looked, start), settings.grid_cells
        if settings.grid_cells < cells and settings.prior != "sphere":
            start = hull_start(cameras, masks.alphas, radius, settings.grid_cells, settings.levels, extent)
    prior = start
    if settings.stereo and settings.prior == "hull":
        context.progress(0, settings.steps, "stereo")
        start = start_from_photos(start, views, context.device, context.check)
    own_colours = calibrated(inputs, usable, config, lambda: exposures_differ(views, start, context.device))
    if settings.method == "paper":
        trainer: Trainer = new_paper_trainer(views, start, settings, own_colours, context.device)
    else:
        trainer = new_trainer(views, start, settings, own_colours, context.device, prior)
    if settings.by_clock:
        held_cameras = [c for c in inputs.poses.artifact.cameras if c.index in held]
        reserve = seconds_to_predict(trainer.model, held_cameras, settings, context.device)
        trainer.allowance = max(settings.seconds - clock.elapsed() - reserve, LEAST_TRAINING * settings.seconds)
    model = run_fit(trainer, Hooks(context.progress, context.cancelled, context.scratch / "checkpoint.pt"))
    model.save(context.workdir / "field.npz")
    write_light(model, context)
    held_out = predict_held_out(
        model, inputs.capture.artifact, inputs.poses.artifact, usable, config.image_side, config.samples, context
    )
    facts = model_facts(trainer, looked)
    labels, names = read_labels(inputs.masks, usable), inputs.masks.artifact.label_names
    left = view_errors(model, trainer.pixels, views, settings.image_side, settings.samples, labels, names)
    fitted = Fitted(left, inputs.capture.artifact, inputs.masks.artifact, trainer.history, facts, settings.prior)
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
        findings=findings(fitted),
    )


def calibrated(inputs: Inputs, usable: list[int], config: Config, exposures_differ: Callable[[], bool]) -> bool:
    """Whether per-image colour matrices are fitted: by the setting, else by metadata, cameras or the photos."""
    if config.calibration != AUTO:
        return config.calibration == "on"
    capture = inputs.capture.artifact
    cameras = {v.camera_group for v in capture.views if v.index in set(usable)}
    return capture.colours_drift or len(cameras) > 1 or exposures_differ()


STAGE = Stage(name="inverse_rendering", version=9, inputs=Inputs, config=Config, output=FittedFace, run=run)
