"""How many tiles charts are packed into, and at which scale.

Symbols: A area of the charts in any unit; scale: sides of a tile over that unit, the same in every tile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.meshes import F32, F64, Faces, Indices
from stages.uv.pack import DENSEST, pack_tiles

FILL = 0.5  # of the tiles under charts: no chart may be so large that less can be reached
ROOM = 0.94  # of a tile's side for one chart, the rest is padding


@dataclass(frozen=True, slots=True)
class Tiling:
    """most: tiles that are filled. With `scale`, no more of them than it takes to reach it."""

    most: int = 1
    scale: float | None = None

    def in_units_of(self, unit: float) -> Tiling:
        """The same for charts measured in another unit, `unit` of this one's."""
        return Tiling(self.most, None if self.scale is None else self.scale * unit)

    def content_with(self, share: float, area: float) -> bool:
        """Whether one tile will do, `share` of which lies under charts of this area."""
        return self.most == 1 or (self.scale is not None and share >= area * self.scale**2)

    def least(self, area: float) -> int:
        """The smallest number of tiles that could do."""
        if self.scale is None:
            return self.most
        return int(np.clip(np.ceil(area * self.scale**2 / DENSEST), 2, self.most))

    def largest_chart(self, area: float) -> float:
        """Longest side that a chart may have, in its unit, so that no single one keeps all others small."""
        filled = float(np.sqrt(self.most * FILL / area))
        return ROOM / (filled if self.scale is None else min(filled, self.scale))


def packed(uvs: F64, faces: Faces, chart_of_face: Indices, area: float, padding: float, tiling: Tiling) -> F32 | None:
    """(U, 2) uvs in several tiles (stages.uv.pack), as few as reach the scale, else all; None if they do not fit."""
    for tiles in range(tiling.least(area), tiling.most + 1) if tiling.scale is not None else ():
        found = pack_tiles(uvs, faces, chart_of_face, padding, tiles, tiling.scale)
        if found is not None:
            return found
    return pack_tiles(uvs, faces, chart_of_face, padding, tiling.most)
