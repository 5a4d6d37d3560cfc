"""Maps of a light stage: what its single lights say of base colour, F0, roughness and normals.

The reflectance stage has measured them at the texels of the same charts, with far more evidence than photos under one
light. They replace what was fitted to those photos, also where the field was continued from what cameras saw, so that
there is no seam; `seen` says which is which. The fitted eyes of the template stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Located
from pipeline.map_lookup import bilinear
from pipeline.meshes import F32, Indices
from pipeline.reflectance_artifacts import ReflectanceField

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stages.bake.texels import Placed, Samples

OPENPBR, NORMAL, COVERAGE = "openpbr.exr", "normal.exr", "coverage.exr"


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
    parts: Sequence[npt.NDArray[np.float32]] = [
        np.atleast_3d(read_exr(reflectance.path(files[n]))[0]) for n in (OPENPBR, NORMAL, COVERAGE)
    ]
    return Measured(np.concatenate(parts, 2).astype(np.float32), size)


def with_measured(found: Samples, at: Placed, texel: Indices, measured: Measured) -> Samples:
    """The samples of texels with what the single lights say."""
    from stages.bake.texels import ALBEDO_RANGE, in_frame

    values = measured.at(texel)
    length = np.linalg.norm(values[:, 5:8], axis=1, keepdims=True)
    normal = np.where(length > 0.1, values[:, 5:8] / np.maximum(length, 1e-9), at.world)
    return replace(
        found,
        base_color=values[:, :3].clip(*ALBEDO_RANGE),
        f0=values[:, 3].clip(0, 1),
        roughness=values[:, 4].clip(0.1, 1),
        normal=in_frame(normal.astype(np.float64), at.t, at.b, at.n),
        unseen=(values[:, 8] < 0.5).astype(np.float32),
    )
