"""What the material of standard shaders is fitted to: the vertices in the photos, and what arrives at them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.lighting import standard
from pipeline.meshes import F32, F64

ALPHAS = np.array([0.09, 0.12, 0.16, 0.20, 0.25, 0.31, 0.38, 0.47, 0.6], np.float32)


@dataclass(frozen=True, slots=True)
class Seen:
    """M observations of the mesh's vertices. vertex (M,); wo (M, 3) unit; colour (M, 3) linear, without the photo's
    colour response; predicted (M, 3) by the field. mirror (M, 3): the mirror reflection of a polarised pair, whose
    colour shows none, NaN where it is not known; None without pairs."""

    vertex: npt.NDArray[np.int64]
    wo: F64
    colour: F64
    predicted: F64
    mirror: F64 | None = None


@dataclass(frozen=True, slots=True)
class Lit:
    """What arrives at M observations. lobes(rows, alphas): (m, K, 2, 3) of m of them, for F0 = 1 and the rim, for K
    widths; shade (M, 3): S. received (V, 3): S at the vertices, of the still light or its stand-in."""

    lobes: Callable[[npt.NDArray[np.int64], F32], F32]
    shade: F64
    received: F64


def under_dome(at: standard.Arrivals, normals: F64, seen: Seen) -> Lit:
    """What arrives at the observations under a still light."""
    received = np.asarray(at.irradiance / np.pi, np.float64)

    def lobes(rows: npt.NDArray[np.int64], alphas: F32) -> F32:
        vertex = seen.vertex[rows]
        return standard.lobes(at, vertex, normals[vertex], seen.wo[rows], alphas)

    return Lit(lobes, received[seen.vertex], received)
