"""The settings of the fit, and the presets. Those of the paper's own model are in paper/config.py.

A preset is a trade-off between speed and accuracy. The defaults are the draft's. Lengths are in metres, the asset's
unit. Weights are those of the terms of [NeuFace eq. 20].
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import Field, field_validator, model_validator

from pipeline.artifacts import sha256_of
from pipeline.contract import StageConfig
from pipeline.units import Cells, ContentHash, Metres, Pixels, Rays, Seconds, Share, Steps, Unit

GPU_BATCH = 16_384  # rays of a step on a GPU, where it takes as long as one of 4,096
AUTO: Final = "auto"  # decided by cross-validation during the fit (stages.inverse_rendering.cross_validation)
MAX_RANK, MAX_ORDER = 3, 10  # values until the model selection: the paper's

Preset = Literal["draft", "studio", "film"]
Decision = Literal["auto", "on", "off"]
PRIORS = {  # names of the initial geometries in the report
    "hull": "visual hull",
    "template": "visual hull cut by the head template",
    "sphere": "sphere",
    "imface": "ImFace",
}


# Presets: the settings that differ from the defaults of Config.
PRESETS: dict[str, dict[str, Any]] = {
    "draft": {},
    "studio": {
        "image_side": 1024,
        "steps": 8000,
        "grid_cells": 320,
        "hash_fine": 0.0006,
        "hash_log2_size": 18,
    },
    "film": {
        "image_side": 2048,
        "steps": 12000,
        "batch": 8192,
        "grid_cells": 448,
        "levels": 3,
        "hash_fine": 0.0003,
        "hash_log2_size": 20,
        "samples": 16,
    },
}


class Config(StageConfig):
    """Settings of the fit. A preset fills the settings that are not given, before the store's key is computed."""

    presets: ClassVar[dict[str, dict[str, Any]]] = PRESETS

    preset: Preset = Field(
        default="draft",
        description="trade-off between speed and accuracy; fills all settings that are not given; paper and comparison "
        "add the settings of the paper's model",
    )
    seed: int = Field(default=0, ge=0, description="seed of all random numbers")
    # size
    image_side: Pixels = Field(
        default=512, ge=32, le=16384, description="longest side of the photos in the last phase of the fit"
    )
    steps: Steps = Field(
        default=1300, ge=1, le=10_000_000, description="number of optimisation steps; ignored if seconds is set"
    )
    seconds: Seconds = Field(
        default=0.0,
        ge=0,
        le=1e7,
        description="time limit of the whole stage, which schedules follow; 0: use steps. Only steps is repeatable",
    )
    batch: Rays = Field(default=4096, ge=16, le=1_048_576, description="rays in one optimisation step")
    samples: Annotated[int, Unit("samples per ray")] = Field(
        default=10, ge=4, le=128, description="samples on each ray, in the shell around the surface"
    )
    grid_cells: Cells = Field(
        default=288, ge=16, le=2048, description="cells of the final SDF grid along the subject's longest side"
    )
    levels: int = Field(
        default=2, ge=1, le=4, description="number of grid resolutions, coarse to fine; each halves the cell size"
    )
    stereo: Literal["auto", "sweep", "dense", "off"] = Field(
        default=AUTO,
        description="stereo before the fit (prior auto, hull or template); sweep: plane sweep along the hull's "
        "normals; dense: a depth map for each photo; auto: each where it shows validation views better; off: the "
        "initial geometry as it is",
    )
    # model
    rank: Annotated[int, Field(ge=1, le=8)] | Literal["auto"] = Field(
        default=AUTO, description="k, number of specular bases [NeuFace eq. 7]; auto: by cross-validation, at most 3"
    )
    light_order: Annotated[int, Field(ge=0, le=10)] | Literal["auto"] = Field(
        default=AUTO, description="order of the light's spherical harmonics [NeuFace eq. 2]; auto: by cross-validation"
    )
    light_from: Literal["auto", "lobe", "uniform_albedo", "stage"] = Field(
        default=AUTO,
        description="source of the light; lobe: estimated from view-dependent residuals, in closed form; "
        "uniform_albedo: by optimisation with a uniform albedo; stage: the lamps of a light stage, as distant lights; "
        "auto: light_file if it is given, else the lamps of a light stage that are most of its light, else lobe",
    )
    light_file: str = Field(
        default="",
        description="lat-long .exr or .hdr file of the light, measured: it is not estimated; --light sets it",
        exclude=True,
    )
    light_digest: ContentHash = Field(default="", description="sha256 of light_file, set automatically")
    light_scale: Annotated[float, Field(gt=0, le=1e6)] | Literal["auto"] = Field(
        default=AUTO,
        description="factor from the radiance in light_file to the photos' linear values; auto: unknown, the level of "
        "the albedo decides it",
    )
    light_frame: Literal["auto", "world", "turntable", "camera", "flash"] = Field(
        default=AUTO,
        description="where the light stands still; world: in the room, with the subject; turntable: in the room, in "
        "which the subject turns; camera: relative to the camera; flash: a lamp on the camera, whose light falls off "
        "with the distance; auto: by cross-validation before the fit and by the photos' metadata",
    )
    surroundings: bool = Field(
        default=True,
        description="the captured light shows what the photos show behind the subject, for example a window; off: only "
        "what the subject tells of the light, and no picture of the room is in the asset",
    )
    skin_light: bool = Field(
        default=True,
        description="correct the low bands of the light during the fit so that the albedo of the skin does not depend "
        "on the direction that it faces",
    )
    albedo_level: Annotated[float, Field(ge=0.01, le=0.95)] | Literal["auto", "fitted"] = Field(
        default=AUTO,
        description="luminance of the face's albedo, linear, if it was measured; auto: from the lobe and the whites of "
        "the eyes; fitted: as it comes out of the fit",
    )
    attenuation: Literal["exponential", "exact"] = Field(
        default="exponential", description="attenuation of the light's SH bands by the lobe [NeuFace eq. 11]"
    )
    specular: Decision = Field(default=AUTO, description="model a specular term; auto: by cross-validation")
    refine_geometry: Decision = Field(
        default=AUTO,
        description="optimise the geometry, not only its prior; auto: by cross-validation",
    )
    refine_poses: Decision = Field(
        default="off",
        description="register the photos to the model during the fit and move their cameras, which also follows a head "
        "that moves between photos; auto: if the photos show that the cameras are off by more than their noise; on: "
        "without that condition",
    )
    weigh_photos: bool = Field(
        default=False,
        description="weigh photos and their parts during the fit by their residuals against those of the other photos "
        "at the same place of the surface, so that hands, moved shadows and moved photos count less",
    )
    resolution: Literal["auto", "given"] = Field(
        default=AUTO,
        description="auto: limit grid_cells and hash_fine to the size of a pixel on the surface; given: no limit",
    )
    shadows: bool = Field(default=True, description="model shadows and interreflections of the head onto itself")
    precision: Literal["float32", "bfloat16"] = Field(
        default="float32", description="number format of the networks' matrix products during the fit"
    )
    calibration: Decision = Field(
        default=AUTO,
        description="a colour matrix for each photo [NeuFace eq. 19]; auto: by cross-validation; before that, if there "
        "are several cameras or the exposure differs",
    )
    hash_levels: int = Field(default=10, ge=1, le=24, description="levels of the appearance encoding")
    hash_log2_size: int = Field(
        default=17, ge=8, le=24, description="log2 of the number of entries of the largest hash table"
    )
    hash_fine: Metres = Field(default=0.0008, gt=0, le=0.1, description="finest cell of the appearance encoding")
    uniform_albedo_until: Share = Field(
        default=0.36,
        ge=0,
        lt=1,
        description="share of the fit at which the light-only phase with uniform albedo ends; it begins at 0.3, so a "
        "smaller value skips it",
    )
    width: int = Field(default=64, ge=8, le=512, description="width of the appearance networks")
    depth: int = Field(default=2, ge=1, le=16, description="hidden layers of the appearance network")
    prior: Literal["auto", "hull", "template"] = Field(
        default=AUTO,
        description="initial geometry; hull: of the masks; template: the hull, cut by the head template on the face "
        "landmarks; auto: template where the hull hides the face",
    )
    follow_flow: Decision = Field(
        default=AUTO,
        description="move the surface during the fit to the depth that the optical flow from the model's pictures to "
        "the photos tells; auto: where the head template cut the hull",
    )
    unseen_smoothing: Metres = Field(
        default=0.006,
        ge=0,
        le=0.1,
        description="largest length over which the surface is smoothed during the fit where the photos hardly "
        "determine it, but at most three cells of the grid; 0: no smoothing there",
    )
    # weights
    rgb: float = Field(default=1.0, ge=0, description="weight of the colour loss, lambda 1 [NeuFace eq. 21]")
    mask: float = Field(default=0.1, ge=0, description="weight of the mask loss (cross-entropy of the opacity)")
    white: float = Field(default=0.02, ge=0, description="weight of the white-light loss, lambda 2 [NeuFace eq. 22]")
    specular_energy: float = Field(
        default=0.02, ge=0, description="weight of the specular-energy loss, lambda 3 [NeuFace eq. 23]"
    )
    f0_limit: float = Field(
        default=0.17, gt=0, le=1, description="largest F0 without penalty; diamond has .17, skin .02 to .045"
    )
    f0_excess: float = Field(default=0.1, ge=0, description="weight of the penalty on F0 above f0_limit")
    shininess_prior: float = Field(
        default=1e-3, ge=0, description="weight of the prior on 1 / kappa (skin's typical value)"
    )
    albedo_sparsity: float = Field(
        default=0.01, ge=0, description="weight of the sparse-albedo prior, which attributes shading to the light"
    )
    eikonal: float = Field(default=0.1, ge=0, description="weight of the Eikonal term, lambda 5 [NeuFace eq. 24]")
    smooth: float = Field(default=0.03, ge=0, description="weight of the smoothness of neighbouring normals")
    # learning
    lr_sdf: Annotated[float, Unit("cells per step")] = Field(
        default=0.1, gt=0, le=1, description="learning rate of the SDF"
    )
    lr_appearance: float = Field(
        default=1e-2, gt=0, le=1, description="learning rate of the hash table; that of the networks is 0.3 of it"
    )
    lr_light: float = Field(default=1e-2, gt=0, le=1, description="learning rate of the light's coefficients")
    beta_end: Annotated[float, Unit("finest cells")] = Field(
        default=0.15, gt=0, le=10, description="width of the soft surface at the end of the fit"
    )
    trials: Literal["on", "off"] = Field(
        default="off",
        description="judge the decisions during the fit on pixels that are not fitted, and take back those that make "
        "it worse; off: take each decision once",
    )
    # faults
    max_dropped: Steps = Field(
        default=20,
        ge=1,
        le=1_000_000,
        description="number of steps with values that are not finite at which the fit stops",
    )

    @model_validator(mode="before")
    @classmethod
    def _filled(cls, data: Any) -> Any:
        given = dict(data) if isinstance(data, dict) else {}
        preset = given.get("preset", cls.model_fields["preset"].default)
        return {**cls.presets.get(str(preset), {}), **given}

    @model_validator(mode="before")
    @classmethod
    def _fill_digest(cls, given: Any) -> Any:
        path = Path(str(given["light_file"])) if isinstance(given, dict) and given.get("light_file") else None
        return given if path is None else given | {"light_digest": sha256_of(path) if path.is_file() else ""}

    @model_validator(mode="after")
    def _one_light(self) -> Self:
        if self.light_file and self.light_from != AUTO:
            raise ValueError("light_file is the light: light_from must be auto beside it")
        if (self.light_file or self.light_from == "stage") and self.light_frame not in (AUTO, "world"):
            raise ValueError("a given light stands still: light_frame must be auto or world beside it")
        return self

    @field_validator("specular", "refine_geometry", "refine_poses", "trials", mode="before")
    @classmethod
    def _switch(cls, value: Any) -> Any:
        return {"true": "on", "false": "off"}.get(str(value).lower(), value)

    @field_validator("stereo", mode="before")
    @classmethod
    def _stereo(cls, value: Any) -> Any:
        return {"true": AUTO, "false": "off"}.get(str(value).lower(), value)

    @property
    def estimates_light(self) -> bool:
        """Whether the light is estimated from view-dependent residuals."""
        return self.light_from in (AUTO, "lobe") and not self.light_file

    @property
    def has_open_parts(self) -> bool:
        """Whether a part of the model is left to the model selection."""
        return AUTO in (self.specular, self.rank, self.light_order, self.calibration, self.refine_geometry)

    @property
    def by_clock(self) -> bool:
        """Whether the fit ends by time and not by a number of steps."""
        return self.seconds > 0

    @property
    def first_rank(self) -> int:
        """Rank k at the start of the fit."""
        return MAX_RANK if isinstance(self.rank, str) else self.rank

    @property
    def first_order(self) -> int:
        """SH order at the start of the fit."""
        return MAX_ORDER if isinstance(self.light_order, str) else self.light_order
