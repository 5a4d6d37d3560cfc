"""Number of UDIM tiles for the charts, and their scale.

Symbols: A area of the charts in any unit; scale: tile sides per unit, the same in every tile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.meshes import F32, F64, Faces, Indices
from stages.uv.pack import DENSEST, pack_tiles

FILL = 0.5  # of the tiles under charts: no chart may be so large that this share can't be reached
ROOM = 0.94  # of a tile's side for one chart; the rest is padding


@dataclass(frozen=True, slots=True)
class Tiling:
    """most: number of tiles to fill; if `scale` is set, only as many of them as this scale needs."""

    most: int = 1
    scale: float | None = None

    def in_units_of(self, unit: float) -> Tiling:
        """The same tiling for charts in another unit, which is `unit` of this one."""
        return Tiling(self.most, None if self.scale is None else self.scale * unit)

    def content_with(self, share: float, area: float) -> bool:
        """Whether one tile is enough, if charts of this area cover `share` of it."""
        return self.most == 1 or (self.scale is not None and share >= area * self.scale**2)

    def least(self, area: float) -> int:
        """The smallest number of tiles that could be enough."""
        if self.scale is None:
            return self.most
        return int(np.clip(np.ceil(area * self.scale**2 / DENSEST), 2, self.most))

    def largest_chart(self, area: float) -> float:
        """Largest side of a chart, in its unit, so that one chart does not force a small scale on all."""
        filled = float(np.sqrt(self.most * FILL / area))
        return ROOM / (filled if self.scale is None else min(filled, self.scale))


def packed(uvs: F64, faces: Faces, chart_of_face: Indices, area: float, padding: float, tiling: Tiling) -> F32 | None:
    """(U, 2) uvs in several tiles (stages.uv.pack): as few as reach the scale, else all. None if charts do not fit."""
    for tiles in range(tiling.least(area), tiling.most + 1) if tiling.scale is not None else ():
        found = pack_tiles(uvs, faces, chart_of_face, padding, tiles, tiling.scale)
        if found is not None:
            return found
    return pack_tiles(uvs, faces, chart_of_face, padding, tiling.most)
