"""Maps of a light stage: what its single lights say of base colour, F0, roughness and normals.

The reflectance stage has measured them at the texels of the same charts, with far more evidence than photos under one
light. They replace what was fitted to those photos, also where the field was continued from what cameras saw, so that
there is no seam; `coverage` says which is which. The fitted eyes of the template stay.

Where the stage found corneas (pipeline/eyes/mirror.py), the surface reflects as they do: their normals, F0, and the
roughness of a film of tears, so that eyes glint in any renderer.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.artifacts import Located
from pipeline.eyes.material import ROUGHNESS
from pipeline.eyes.mirror import Cornea, from_stored
from pipeline.map_lookup import bilinear
from pipeline.meshes import F32, Indices
from pipeline.reflectance_artifacts import ReflectanceField

OPENPBR, NORMAL, COVERAGE = "openpbr.exr", "normal.exr", "coverage.exr"
BASIS, SURFACE = "basis.json", "surface.exr"


@dataclass(frozen=True, slots=True)
class Measured:
    """values (S, S, 9): base colour, F0, roughness, normal in asset coordinates, 1 where a camera saw the texel. size:
    of the maps that are baked, of the first tile."""

    values: F32
    size: int

    def at(self, texel: Indices) -> F32:
        """(N, 9) values at texels row * size + column, bilinear."""
        row, column = ((n + 0.5) / self.size for n in divmod(texel, self.size))
        return bilinear(self.values, np.stack([column, 1 - row], 1))


def measured_of(reflectance: Located[ReflectanceField], size: int) -> Measured | None:
    """The maps of a light stage's field; None for other captures."""
    from pipeline.images import read_exr

    files = {f.path.rsplit("/", 1)[-1]: f for f in reflectance.artifact.files}
    if not reflectance.artifact.present or OPENPBR not in files:
        return None
    parts = [np.atleast_3d(read_exr(reflectance.path(files[n]))[0]) for n in (OPENPBR, NORMAL, COVERAGE)]
    values = np.concatenate(parts, 2).astype(np.float32)
    if BASIS in files and SURFACE in files:
        stored = json.loads(reflectance.path(files[BASIS]).read_text()).get("corneas", ())
        values = with_corneas(values, read_exr(reflectance.path(files[SURFACE]))[0], from_stored(stored))
    return Measured(values, size)


def with_corneas(values: F32, surface: F32, corneas: Sequence[Cornea]) -> F32:
    """values (S, S, 9) of `Measured` with what corneas reflect. surface (S, S, 6): position and unit normal of each
    texel, asset coordinates."""
    out = values.reshape(-1, values.shape[2]).astype(np.float64)
    position, normal = np.split(surface.reshape(-1, 6).astype(np.float64), 2, axis=1)
    for cornea in corneas:
        share, n = cornea.covers(position, normal)
        wet = np.concatenate([np.full((len(n), 1), cornea.f0), np.full((len(n), 1), ROUGHNESS), n], 1)
        out[:, 3:8] += share[:, None] * (wet - out[:, 3:8])
    return np.asarray(out.reshape(values.shape), np.float32)
