"""The settings of the fit, and the presets.

A preset is a trade-off between speed and accuracy. The defaults are the draft's. Lengths are in metres, the asset's
unit. Weights are those of the terms of [NeuFace eq. 20].
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.contract import StageConfig
from pipeline.units import Cells, ContentHash, Metres, Pixels, Rays, Seconds, Share, Steps, Unit

AUTO: Final = "auto"  # decided by cross-validation during the fit (stages.inverse_rendering.cross_validation)
MAX_RANK, MAX_ORDER = 3, 10  # values until the model selection: the paper's

Preset = Literal["draft", "studio", "film", "paper"]
Decision = Literal["auto", "on", "off"]


class Config(StageConfig):
    """Settings of the fit. A preset fills the settings that are not given, before the store's key is computed."""

    preset: Preset = Field(
        default="draft",
        description="trade-off between speed and accuracy; fills all settings that are not given",
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
        description="stereo before the fit (prior hull); sweep: plane sweep along the hull's normals; dense: a depth "
        "map for each photo; auto: the one that shows validation views better; off: the visual hull as it is",
    )
    # model
    rank: Annotated[int, Field(ge=1, le=8)] | Literal["auto"] = Field(
        default=AUTO, description="k, number of specular bases [NeuFace eq. 7]; auto: by cross-validation, at most 3"
    )
    light_order: Annotated[int, Field(ge=0, le=10)] | Literal["auto"] = Field(
        default=AUTO, description="order of the light's spherical harmonics [NeuFace eq. 2]; auto: by cross-validation"
    )
    light_from: Literal["lobe", "uniform_albedo"] = Field(
        default="lobe",
        description="light estimation during the fit; lobe: from view-dependent residuals, in closed form; "
        "uniform_albedo: by optimisation with a uniform albedo",
    )
    attenuation: Literal["exponential", "exact", "phong"] = Field(
        default="exponential", description="attenuation of the light's SH bands by the lobe [NeuFace eq. 11]"
    )
    basis_inputs: Literal["cosine", "paper"] = Field(
        default="cosine", description="inputs of the specular bases; cosine: wo . n; paper: wo, n and wo . n"
    )
    density: Literal["crossing", "laplace"] = Field(
        default="crossing",
        description="density from the SDF; crossing: unbiased at the zero crossing; laplace: the paper's",
    )
    specular: Decision = Field(default=AUTO, description="model a specular term; auto: by cross-validation")
    refine_geometry: Decision = Field(
        default=AUTO,
        description="optimise the geometry, not only its prior; auto: by cross-validation; off needs method fast",
    )
    resolution: Literal["auto", "given"] = Field(
        default=AUTO,
        description="auto: limit grid_cells and hash_fine to the size of a pixel on the surface; given: no limit",
    )
    shadows: bool = Field(default=True, description="model shadows and interreflections of the head onto itself")
    volumetric: bool = Field(
        default=False,
        description="shade every sample of a ray, as the paper does, not only the expected surface point of each ray",
    )
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
    # which of the paper's systems (pipeline.fields.build)
    method: Literal["fast", "paper"] = Field(
        default="fast", description="fast: SDF grid, shaded once per ray; paper: networks, shaded at every sample"
    )
    appearance: Literal["hash", "sinusoidal"] = Field(
        default="hash",
        description="encoding of the Spatial MLP; hash: multi-resolution hash table; sinusoidal: the paper's",
    )
    shading: Literal["neural", "phong", "disney"] = Field(
        default="neural", description="the specular term; phong and disney are for comparison"
    )
    light: Literal["sh", "cubemap"] = Field(
        default="sh", description="the captured light; sh: spherical harmonics; cubemap is for comparison"
    )
    integral: Literal["low_rank", "direct", "feature"] = Field(
        default="low_rank", description="the material integral [NeuFace eq. 6]; direct and feature are for comparison"
    )
    basis_width: int = Field(default=64, ge=8, le=512, description="width of the Integrated Basis MLP")
    basis_depth: int = Field(default=2, ge=1, le=16, description="hidden layers of the Integrated Basis MLP")
    prior: Literal["hull", "sphere", "imface"] = Field(
        default="hull", description="initial geometry [NeuFace section 4.3]"
    )
    prior_file: str = Field(
        default="", description="path of an ImFace checkpoint, for prior imface (docs/imface.md)", exclude=True
    )
    prior_digest: ContentHash = Field(default="", description="sha256 of prior_file, set automatically")
    prior_scale: Annotated[float, Unit("metres per unit of ImFace")] = Field(
        default=0.1, gt=0, le=1e6, description="size of ImFace's unit in the asset"
    )
    prior_centre: Annotated[tuple[float, float, float], Unit("metres")] = Field(
        default=(0.0, 0.0, 0.0), description="ImFace's origin in asset coordinates"
    )
    # weights
    rgb: float = Field(default=1.0, ge=0, description="weight of the colour loss, lambda 1 [NeuFace eq. 21]")
    mask: float = Field(default=0.1, ge=0, description="weight of the mask loss (cross-entropy of the opacity)")
    white: float = Field(default=0.02, ge=0, description="weight of the white-light loss, lambda 2 [NeuFace eq. 22]")
    specular_energy: float = Field(
        default=0.02, ge=0, description="weight of the specular-energy loss, lambda 3 [NeuFace eq. 23]"
    )
    shininess_prior: float = Field(
        default=1e-3, ge=0, description="weight of the prior on 1 / kappa (skin's typical value)"
    )
    albedo_sparsity: float = Field(
        default=0.01, ge=0, description="weight of the sparse-albedo prior, which attributes shading to the light"
    )
    eikonal: float = Field(default=0.1, ge=0, description="weight of the Eikonal term, lambda 5 [NeuFace eq. 24]")
    smooth: float = Field(default=0.03, ge=0, description="weight of the smoothness of neighbouring normals")
    embedding: float = Field(
        default=1e3, ge=0, description="weight of the embedding loss, lambda 4 [NeuFace eq. 24], for prior imface"
    )
    displacement: float = Field(
        default=1e-3, ge=0, description="weight of the displacement loss, lambda 6 [NeuFace eq. 24], for method paper"
    )
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
        filled = {**PRESETS.get(str(given.get("preset", "draft")), {}), **given}
        if filled.get("prior_file"):
            from stages.inverse_rendering.prior_file import prior_digest

            filled["prior_digest"] = prior_digest(str(filled["prior_file"]))
        return filled

    @field_validator("specular", "refine_geometry", mode="before")
    @classmethod
    def _switch(cls, value: Any) -> Any:
        return {"true": "on", "false": "off"}.get(str(value).lower(), value)

    @field_validator("stereo", mode="before")
    @classmethod
    def _stereo(cls, value: Any) -> Any:
        return {"true": AUTO, "false": "off"}.get(str(value).lower(), value)

    @model_validator(mode="after")
    def _possible(self) -> Config:
        if self.refine_geometry == "off" and self.method != "fast":
            raise ValueError("refine_geometry = off needs method fast; method paper always fits a displacement")
        if self.seconds > 0 and self.method != "fast":
            raise ValueError("seconds needs method fast; the schedule of method paper counts epochs")
        if self.method == "fast" and self.appearance != "hash":
            raise ValueError("appearance = sinusoidal needs method paper; method fast optimises a hash table")
        return self

    @property
    def estimates_light(self) -> bool:
        """Whether the light is estimated from view-dependent residuals (light_from = lobe, and the model allows it)."""
        return self.judges and (self.light_from, self.appearance, self.basis_inputs) == ("lobe", "hash", "cosine")

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

    @property
    def judges(self) -> bool:
        """Whether the model selection supports this model: method fast with the paper's terms."""
        kind = (self.method, self.shading, self.light, self.integral)
        return kind == ("fast", "neural", "sh", "low_rank")


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
    # The paper's networks, sampling, losses and schedule (section B): 3,000 epochs of one batch for each of 43 photos.
    # Tested in short runs only: on a CPU it would take weeks.
    "paper": {
        "method": "paper",
        "stereo": "off",
        "rank": 3,
        "light_order": 10,
        "specular": "on",
        "refine_geometry": "on",
        "resolution": "given",
        "shadows": False,
        "white": 5e-3,
        "specular_energy": 8e-3,
        "albedo_sparsity": 0.0,
        "uniform_albedo_until": 0.0,
        "image_side": 1024,
        "steps": 129_000,
        "batch": 2048,
        "samples": 32,
        "levels": 1,
        "grid_cells": 96,
        "appearance": "sinusoidal",
        "width": 256,
        "depth": 8,
        "basis_inputs": "paper",
        "basis_width": 256,
        "basis_depth": 8,
        "density": "laplace",
        "calibration": "on",
        "mask": 0.0,
        "shininess_prior": 0.0,
        "smooth": 0.0,
        "lr_appearance": 1e-4,
        "lr_light": 1e-4,
    },
}
