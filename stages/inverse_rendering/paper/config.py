"""The settings of the paper's own model, and of the systems that the paper compares.

Preset `paper` is the paper's model and schedule. Preset `comparison` is our fit, in which single parts may be replaced
by those of a compared system. The names of the parts are those of pipeline.fields.build.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from pipeline.units import ContentHash, Unit
from stages.inverse_rendering.config import Config

PAPER_PRESETS: dict[str, dict[str, Any]] = {
    "comparison": {},
    # The paper's networks, sampling, losses and schedule (section B): 3,000 epochs of one batch for each of 43 photos.
    # Tested in short runs only: on a CPU it would take weeks.
    "paper": {
        "method": "paper",
        "albedo_level": "fitted",
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


class PaperConfig(Config):
    """Settings of the paper's model and of the systems that it compares, besides those of the fit. The preset paper has
    the paper's values; comparison has the defaults, which are our own fit."""

    presets: ClassVar[dict[str, dict[str, Any]]] = PAPER_PRESETS

    @model_validator(mode="after")
    def _estimated_light(self) -> Self:
        if self.light_file or self.light_from == "stage":
            raise ValueError("these systems estimate the light: light_file and light_from=stage are not for them")
        return self

    # The settings of our fit with further values: no function reads a value that its own class does not allow.
    preset: Literal["paper", "comparison"] = Field(  # type: ignore[assignment]
        default="paper",
        description="paper: the paper's model and schedule; comparison: our fit, to replace single parts of it",
    )
    attenuation: Literal["exponential", "exact", "phong"] = Field(  # type: ignore[assignment]
        default="exponential",
        description="attenuation of the light's SH bands by the lobe [NeuFace eq. 11]; phong is for comparison",
    )
    method: Literal["fast", "paper"] = Field(
        default="fast", description="fast: SDF grid, shaded once per ray; paper: networks, shaded at every sample"
    )
    appearance: Literal["hash", "sinusoidal"] = Field(
        default="hash",
        description="encoding of the Spatial MLP; hash: multi-resolution hash table; sinusoidal: the paper's",
    )
    basis_inputs: Literal["cosine", "paper"] = Field(
        default="cosine", description="inputs of the specular bases; cosine: wo . n; paper: wo, n and wo . n"
    )
    basis_width: int = Field(default=64, ge=8, le=512, description="width of the Integrated Basis MLP")
    basis_depth: int = Field(default=2, ge=1, le=16, description="hidden layers of the Integrated Basis MLP")
    shading: Literal["neural", "phong", "disney"] = Field(
        default="neural", description="the specular term; phong and disney are for comparison"
    )
    light: Literal["sh", "cubemap"] = Field(
        default="sh", description="the captured light; sh: spherical harmonics; cubemap is for comparison"
    )
    integral: Literal["low_rank", "direct", "feature"] = Field(
        default="low_rank", description="the material integral [NeuFace eq. 6]; direct and feature are for comparison"
    )
    density: Literal["crossing", "laplace"] = Field(
        default="crossing",
        description="density from the SDF; crossing: unbiased at the zero crossing; laplace: the paper's",
    )
    volumetric: bool = Field(
        default=False,
        description="shade every sample of a ray, as the paper does, not only the expected surface point of each ray",
    )
    prior: Literal["auto", "hull", "template", "sphere", "imface"] = Field(  # type: ignore[assignment]
        default="hull",
        description="initial geometry [NeuFace section 4.3]; auto, hull, template: as in our fit",
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
    embedding: float = Field(
        default=1e3, ge=0, description="weight of the embedding loss, lambda 4 [NeuFace eq. 24], for prior imface"
    )
    displacement: float = Field(
        default=1e-3, ge=0, description="weight of the displacement loss, lambda 6 [NeuFace eq. 24], for method paper"
    )

    @model_validator(mode="before")
    @classmethod
    def _of_the_prior(cls, data: Any) -> Any:
        """The settings with what follows from the prior: the hash of its checkpoint, so that the store's key depends on
        its content; and stereo and resolution, which refine and measure the visual hull."""
        given = dict(data) if isinstance(data, dict) else {}
        if given.get("prior_file"):
            from pipeline.fields.paper.imface_layout import digest

            given["prior_digest"] = digest(str(given["prior_file"]))
        if given.get("prior") in ("sphere", "imface"):
            given.setdefault("stereo", "off")
        if given.get("prior") == "sphere":
            given.setdefault("resolution", "given")
        return given

    @model_validator(mode="after")
    def _possible(self) -> PaperConfig:
        if self.refine_geometry == "off" and self.method != "fast":
            raise ValueError("refine_geometry = off needs method fast; method paper always fits a displacement")
        if self.seconds > 0 and self.method != "fast":
            raise ValueError("seconds needs method fast; the schedule of method paper counts epochs")
        if self.method == "fast" and self.appearance != "hash":
            raise ValueError("appearance = sinusoidal needs method paper; method fast optimises a hash table")
        if self.stereo != "off" and self.prior in ("sphere", "imface"):
            raise ValueError("stereo needs prior hull, which is what it refines: set stereo=off")
        if self.resolution == "auto" and self.prior == "sphere":
            raise ValueError("resolution = auto needs another prior: on a sphere the pixels' size is not the subject's")
        return self

    @property
    def estimates_light(self) -> bool:
        """Whether the light is estimated from view-dependent residuals: only for bases that depend on wo . n."""
        return super().estimates_light and self.has_own_parts and self.basis_inputs == "cosine"

    @property
    def has_open_parts(self) -> bool:
        """Whether a part of the model is left to the model selection, which supports only our own parts."""
        return super().has_open_parts and self.has_own_parts

    @property
    def has_own_parts(self) -> bool:
        """Whether specular term, light and material integral are ours, and so is the fit."""
        kind = (self.method, self.shading, self.light, self.integral)
        return kind == ("fast", "neural", "sh", "low_rank")
