"""Settings of the fit, and the presets that fill them: points on the curve of speed against accuracy.

Kept free of everything but the standard library, so that the fit runs on a bare machine with torch alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

AUTO = "auto"  # decided by evidence in mid-fit (stages.inverse_rendering.evidence)
MOST_RANK, MOST_ORDER = 3, 10  # what a fit begins with until it knows better: the paper's own


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Everything that the fit reads. Lengths in asset units (metres); weights of the terms of [NeuFace eq. 20]."""

    seed: int = 0
    # size
    image_side: int = 512
    steps: int = 1300
    seconds: float = 0.0
    batch: int = 4096
    samples: int = 10
    grid_cells: int = 288
    levels: int = 2
    stereo: bool = True
    # model
    rank: int | str = AUTO
    light_order: int | str = AUTO
    attenuation: str = "exponential"
    basis_inputs: str = "cosine"
    density: str = "crossing"
    specular: str = AUTO
    relief: str = AUTO
    resolution: str = AUTO
    shadows: bool = True
    volumetric: bool = False
    precision: str = "float32"
    calibration: str = AUTO
    hash_levels: int = 10
    hash_log2_size: int = 17
    hash_fine: float = 0.0008
    even_from: float = 0.3
    even_until: float = 0.36
    open_from: float = 0.4
    open_until: float = 0.5
    width: int = 64
    depth: int = 2
    # which of the paper's systems (pipeline.fields.build)
    method: str = "fast"
    appearance: str = "hash"
    shading: str = "neural"
    light: str = "sh"
    light_from: str = "lobe"
    integral: str = "low_rank"
    basis_width: int = 64
    basis_depth: int = 2
    prior: str = "hull"
    prior_file: str = ""
    prior_digest: str = ""
    prior_scale: float = 0.1
    prior_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # weights
    rgb: float = 1.0
    mask: float = 0.1
    white: float = 0.02
    specular_energy: float = 0.02
    shininess: float = 1e-3
    parsimony: float = 0.01
    eikonal: float = 0.1
    smooth: float = 0.03
    embedding: float = 1e3
    displacement: float = 1e-3
    # learning
    lr_sdf: float = 0.1
    lr_appearance: float = 1e-2
    lr_light: float = 1e-2
    beta_end: float = 0.15
    # faults
    max_dropped: int = 20

    @property
    def lamps(self) -> bool:
        """Whether the light is to be told by the lobe, and this kind of model can take it over."""
        return self.judges and (self.light_from, self.appearance, self.basis_inputs) == ("lobe", "hash", "cosine")

    @property
    def by_clock(self) -> bool:
        """Whether the fit ends when its time is up, not after so many steps."""
        return self.seconds > 0

    @property
    def first_rank(self) -> int:
        """k that the fit begins with."""
        return MOST_RANK if isinstance(self.rank, str) else self.rank

    @property
    def first_order(self) -> int:
        """SH order that the fit begins with."""
        return MOST_ORDER if isinstance(self.light_order, str) else self.light_order

    @property
    def judges(self) -> bool:
        """Whether this kind of model can be judged by evidence: the fast one with the paper's terms."""
        kind = (self.method, self.shading, self.light, self.integral)
        return kind == ("fast", "neural", "sh", "low_rank")


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
        "relief": "on",
        "resolution": "given",
        "shadows": False,
        "white": 5e-3,
        "specular_energy": 8e-3,
        "parsimony": 0.0,
        "even_until": 0.0,
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
        "shininess": 0.0,
        "smooth": 0.0,
        "lr_appearance": 1e-4,
        "lr_light": 1e-4,
    },
}
