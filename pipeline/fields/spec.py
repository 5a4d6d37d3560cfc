"""Specification of a fitted face as plain values, to construct its modules before their parameters are read.

The names are those of the fit's settings (stages.inverse_rendering.config), where they are described. Three have older
names in the file, which are kept, so that earlier fitted fields can be read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

IN_FILE = {"hash_levels": "levels", "hash_log2_size": "log2_size", "hash_fine": "fine"}
TRIPLES = ("lo", "hi", "albedo_start", "prior_centre", "second_light_start")
OF_SECOND = ("second_views", "second_calibrated", "second_light_start")


@dataclass(frozen=True, slots=True)
class FaceSpec:
    """The values that determine the modules and their shapes."""

    lo: tuple[float, float, float]
    hi: tuple[float, float, float]
    views: int
    rank: int = 3
    light_order: int = 10
    light_start: float = 1.0
    albedo_start: tuple[float, float, float] = (0.4, 0.4, 0.4)
    attenuation: str = "exponential"
    basis_inputs: str = "cosine"
    density: str = "crossing"
    volumetric: bool = False
    specular: bool = True
    shadows: bool = False
    calibrated: bool = False
    light_frame: str = "world"  # where the light stands still: pipeline.maths.light_frame
    light_distance: float = 1.0  # of the camera at which a flash has the light's strength
    hash_levels: int = 10
    hash_log2_size: int = 17
    coarse: float = 0.03
    hash_fine: float = 0.0006
    width: int = 64
    depth: int = 2
    # which of the paper's systems; see pipeline.fields.build
    appearance: str = "hash"
    shading: str = "neural"
    light: str = "sh"
    integral: str = "low_rank"
    cubemap_size: int = 12
    basis_width: int = 64
    basis_depth: int = 2
    geometry: str = "grid"
    prior: str = "hull"
    prior_scale: float = 0.1
    prior_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    displacement_width: int = 256
    # a second capture of the subject, under a light of its own; 0 views: none. The file of a field never has one
    second_views: int = 0
    second_calibrated: bool = False
    second_light_start: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def colour_matrices(self) -> bool:
        """Whether photos of any capture have colour matrices."""
        return self.calibrated or self.second_calibrated

    def stored(self) -> dict[str, Any]:
        """The values by their names in the file."""
        values = {IN_FILE.get(name, name): value for name, value in asdict(self).items()}
        return values if self.second_views else {k: v for k, v in values.items() if k not in OF_SECOND}

    @classmethod
    def from_stored(cls, values: Mapping[str, Any]) -> FaceSpec:
        """The inverse of `stored`; JSON has lists where tuples were."""
        names = {old: new for new, old in IN_FILE.items()}
        given: dict[str, Any] = {names.get(k, k): tuple(v) if k in TRIPLES else v for k, v in values.items()}
        return cls(**given)
