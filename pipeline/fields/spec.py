"""What a fitted face is made of, as plain values: enough to build its modules before their parameters are read."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FaceSpec:
    """What is needed to build the modules before their parameters are read."""

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
    levels: int = 10
    log2_size: int = 17
    coarse: float = 0.03
    fine: float = 0.0006
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
