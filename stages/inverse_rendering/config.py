"""The one config of the fit: what a user may set, what the fit reads, and the presets that fill it.

A preset is a point on the curve of speed against accuracy. The defaults are the draft's. Lengths are in metres, the
asset's unit. Weights are those of the terms of [NeuFace eq. 20].
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator, model_validator

from pipeline.contract import StageConfig
from pipeline.units import Cells, ContentHash, Metres, Pixels, Rays, Seconds, Share, Steps, Unit

AUTO: Final = "auto"  # decided by evidence in mid-fit (stages.inverse_rendering.cross_validation)
MAX_RANK, MAX_ORDER = 3, 10  # what a fit begins with until it knows better: the paper's own

Preset = Literal["draft", "studio", "film", "paper"]
Decision = Literal["auto", "on", "off"]


class Config(StageConfig):
    """Settings of the fit. A preset fills all that is not given; the filled-in settings are what the key sees."""

    preset: Preset = Field(
        default="draft",
        description="point on the curve of speed against accuracy; fills all settings that are not given",
    )
    seed: int = Field(default=0, ge=0, description="seed of every random draw")
    # size
    image_side: Pixels = Field(
        default=512, ge=32, le=16384, description="longest side of the photos in the fit's last phase"
    )
    steps: Steps = Field(
        default=1300, ge=1, le=10_000_000, description="optimisation steps; not counted where seconds is set"
    )
    seconds: Seconds = Field(
        default=0.0,
        ge=0,
        le=1e7,
        description="length of the whole stage by the clock, every schedule with it; 0: by steps, which alone repeats",
    )
    batch: Rays = Field(default=4096, ge=16, le=1_048_576, description="rays in one optimisation step")
    samples: Annotated[int, Unit("samples a ray")] = Field(
        default=10, ge=4, le=128, description="samples on each ray in the shell around the surface"
    )
    grid_cells: Cells = Field(
        default=288, ge=16, le=2048, description="cells of the final SDF grid along the subject's longest side"
    )
    levels: int = Field(
        default=2, ge=1, le=4, description="grid resolutions from coarse to fine, each half the cell before"
    )
    stereo: bool = Field(
        default=True, description="move the hull to where the photos agree before the fit begins (prior hull)"
    )
    # model
    rank: Annotated[int, Field(ge=1, le=8)] | Literal["auto"] = Field(
        default=AUTO, description="k, number of specular bases [NeuFace eq. 7]; auto: by evidence, at most 3"
    )
    light_order: Annotated[int, Field(ge=0, le=10)] | Literal["auto"] = Field(
        default=AUTO, description="order of the light's spherical harmonics [NeuFace eq. 2]; auto: by evidence"
    )
    light_from: Literal["lobe", "uniform_albedo"] = Field(
        default="lobe",
        description="how the light is estimated in mid-fit; lobe: from what changes with the view, in closed form; "
        "uniform_albedo: from skin of one albedo alone",
    )
    attenuation: Literal["exponential", "exact", "phong"] = Field(
        default="exponential", description="how the lobe attenuates the light's bands [NeuFace eq. 11]"
    )
    basis_inputs: Literal["cosine", "paper"] = Field(
        default="cosine", description="what the specular bases see; cosine: wo . n; paper: wo, n and wo . n"
    )
    density: Literal["crossing", "laplace"] = Field(
        default="crossing", description="density from the SDF; crossing: without bias; laplace: the paper's"
    )
    specular: Decision = Field(default=AUTO, description="model a specular term at all; auto: by evidence")
    refine_geometry: Decision = Field(
        default=AUTO,
        description="let the surface leave the prior that it begins as; auto: by evidence; off needs method fast",
    )
    resolution: Literal["auto", "given"] = Field(
        default=AUTO, description="auto: grid_cells and hash_fine no finer than the photos' pixels on the surface"
    )
    shadows: bool = Field(default=True, description="model what the surface itself hides and reflects of the light")
    volumetric: bool = Field(
        default=False,
        description="shade every sample of a ray as the paper does, not once a ray at the expected surface point",
    )
    precision: Literal["float32", "bfloat16"] = Field(
        default="float32", description="number format of the networks' products while fitting"
    )
    calibration: Decision = Field(
        default=AUTO,
        description="a colour matrix for each photo [NeuFace eq. 19]; auto: by evidence; until it is in, where the "
        "capture has more than one kind of camera",
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
        description="share of the fit at which the phase ends in which the light alone is found, for a uniform albedo; "
        "it begins at 0.3, so that a smaller value leaves it out",
    )
    width: int = Field(default=64, ge=8, le=512, description="width of the appearance networks")
    depth: int = Field(default=2, ge=1, le=16, description="hidden layers of the appearance network")
    # which of the paper's systems (pipeline.fields.build)
    method: Literal["fast", "paper"] = Field(
        default="fast", description="fast: a grid, shaded once a ray; paper: networks, shaded at every sample"
    )
    appearance: Literal["hash", "sinusoidal"] = Field(
        default="hash", description="encoding of the Spatial MLP; hash: a table of many levels; sinusoidal: the paper's"
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
        default="hull", description="what the geometry starts from [NeuFace section 4.3]"
    )
    prior_file: str = Field(
        default="", description="checkpoint of ImFace, for prior imface (docs/imface.md)", exclude=True
    )
    prior_digest: ContentHash = Field(default="", description="sha256 of prior_file")
    prior_scale: Annotated[float, Unit("metres per unit of ImFace")] = Field(
        default=0.1, gt=0, le=1e6, description="size of ImFace's unit in the asset"
    )
    prior_centre: Annotated[tuple[float, float, float], Unit("metres")] = Field(
        default=(0.0, 0.0, 0.0), description="ImFace's origin in asset coordinates"
    )
    # weights
    rgb: float = Field(default=1.0, ge=0, description="weight of the colour's error, lambda 1 [NeuFace eq. 21]")
    mask: float = Field(default=0.1, ge=0, description="weight of the opacity's cross-entropy against the masks")
    white: float = Field(default=0.02, ge=0, description="weight of a white light, lambda 2 [NeuFace eq. 22]")
    specular_energy: float = Field(
        default=0.02, ge=0, description="weight of little specular, lambda 3 [NeuFace eq. 23]"
    )
    shininess_prior: float = Field(
        default=1e-3, ge=0, description="weight of the prior that holds 1 / kappa near skin's"
    )
    albedo_sparsity: float = Field(
        default=0.01, ge=0, description="weight of an albedo that varies little, so that shading goes to the light"
    )
    eikonal: float = Field(
        default=0.1, ge=0, description="weight of the SDF's unit gradient, lambda 5 [NeuFace eq. 24]"
    )
    smooth: float = Field(default=0.03, ge=0, description="weight of the normals' consistency between neighbours")
    embedding: float = Field(
        default=1e3, ge=0, description="weight of small codes, lambda 4 [NeuFace eq. 24], for prior imface"
    )
    displacement: float = Field(
        default=1e-3, ge=0, description="weight of a small displacement, lambda 6 [NeuFace eq. 24], for method paper"
    )
    # learning
    lr_sdf: Annotated[float, Unit("cells a step")] = Field(
        default=0.1, gt=0, le=1, description="learning rate of the SDF"
    )
    lr_appearance: float = Field(
        default=1e-2, gt=0, le=1, description="learning rate of the hash table; networks take 0.3 of it"
    )
    lr_light: float = Field(default=1e-2, gt=0, le=1, description="learning rate of the light's coefficients")
    beta_end: Annotated[float, Unit("finest cells")] = Field(
        default=0.15, gt=0, le=10, description="width of the soft surface at the end of the fit"
    )
    # faults
    max_dropped: Steps = Field(
        default=20, ge=1, le=1_000_000, description="steps with numbers that are not finite after which the fit stops"
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

    @model_validator(mode="after")
    def _possible(self) -> Config:
        if self.refine_geometry == "off" and self.method != "fast":
            raise ValueError(
                "refine_geometry = off is for method fast; the paper's displacement is what its method fits"
            )
        if self.seconds > 0 and self.method != "fast":
            raise ValueError("seconds is for method fast; the paper's schedule counts epochs")
        if self.method == "fast" and self.appearance != "hash":
            raise ValueError("appearance = sinusoidal is for method paper; the fast fit moves a hash table")
        return self

    @property
    def estimates_light(self) -> bool:
        """Whether the light is to be told by the lobe, and this kind of model can take it over."""
        return self.judges and (self.light_from, self.appearance, self.basis_inputs) == ("lobe", "hash", "cosine")

    @property
    def by_clock(self) -> bool:
        """Whether the fit ends when its time is up, not after so many steps."""
        return self.seconds > 0

    @property
    def first_rank(self) -> int:
        """k that the fit begins with."""
        return MAX_RANK if isinstance(self.rank, str) else self.rank

    @property
    def first_order(self) -> int:
        """SH order that the fit begins with."""
        return MAX_ORDER if isinstance(self.light_order, str) else self.light_order

    @property
    def judges(self) -> bool:
        """Whether this kind of model can be judged by evidence: the fast one with the paper's terms."""
        kind = (self.method, self.shading, self.light, self.integral)
        return kind == ("fast", "neural", "sh", "low_rank")


# Every preset but the draft says what it sets otherwise than the defaults of Config.
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
    # Measured in short runs alone: on a CPU it would take weeks.
    "paper": {
        "method": "paper",
        "stereo": False,
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
