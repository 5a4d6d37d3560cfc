"""The region of the head that each texel belongs to, by a vote of the photos' labels.

Every fitted photo with labels votes for the label of the pixel at a point that it sees. The weight is the cosine
between the normal and the direction to the camera. The label with the most votes wins; in a tie, the lower code. Labels
are integers in one picture per photo (pipeline.artifacts.ViewMask); their meaning does not matter here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.images import read_encoded
from pipeline.meshes import F32, F64, Charts, Indices, Mesh
from pipeline.visibility import FittedPhoto, picked

U8 = npt.NDArray[np.uint8]
GRID = 8192  # texels along the side of the texture in which the triangles' centroids are looked up
FEW_VOTES = 1e-3  # one photo at a very grazing angle


@dataclass(frozen=True, slots=True)
class Votes:
    """codes (L,) of the labels with votes, ascending, without 0; image (S, S, L): their votes."""

    codes: U8
    image: F32

    def winners(self, texel: Indices, size: int) -> U8:
        """(N,) codes of texels, given by row * size + column; 0 without votes. Votes are interpolated linearly."""
        side = len(self.image)
        row, column = (np.clip((i + 0.5) * side / size - 0.5, 0, side - 1) for i in np.divmod(texel, size))
        top, left = row.astype(np.int64), column.astype(np.int64)
        low, right = np.minimum(top + 1, side - 1), np.minimum(left + 1, side - 1)
        y, x = ((p - q).astype(np.float32)[:, None] for p, q in ((row, top), (column, left)))
        upper = self.image[top, left] * (1 - x) + self.image[top, right] * x
        lower = self.image[low, left] * (1 - x) + self.image[low, right] * x
        return elected(self.codes, upper * (1 - y) + lower * y)


def unanimous(code: int) -> Votes:
    """Votes for one code everywhere."""
    return Votes(np.array([code], np.uint8), np.ones((1, 1, 1), np.float32))


def elected(codes: U8, votes: npt.NDArray[np.floating]) -> U8:
    """(N,) code with the most of the votes (N, L) of codes (L,); 0 with too few."""
    return np.where(votes.max(1) > FEW_VOTES, codes[votes.argmax(1)], 0).astype(np.uint8)


def areas(mesh: Mesh, charts: Charts, votes: Votes | None) -> dict[int, float]:
    """Area (m^2) of the surface by region code; code 0: no photo with labels sees it. Each triangle has the label at
    its centroid."""
    area = meshes.areas(mesh.vertices, mesh.faces)
    if votes is None:
        return {0: float(area.sum())}
    middle = charts.uvs.astype(np.float64)[charts.faces].mean(1)
    column, row = (np.stack([middle[:, 0], 1 - middle[:, 1]]) * GRID).astype(np.int64).clip(0, GRID - 1)
    code = votes.winners(row * GRID + column, GRID)
    total = np.bincount(code, area)
    return {int(c): float(total[c]) for c in np.flatnonzero(np.bincount(code))}


class Poll:
    """Collects votes at `count` points."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._votes: dict[int, F64] = {}

    def ask(self, view: FittedPhoto, cosine: F64, uv: F64) -> None:
        """Add the votes of a view: cosines (N,) of the points, 0 where it does not see them, at pixels uv (N, 2)."""
        if view.labels is None:
            return
        seen = np.flatnonzero(cosine)
        label = picked(read_labels(view.labels), view.camera, uv[seen])
        for code in np.unique(label):
            if code > 0:
                mine = label == code
                self._votes.setdefault(int(code), np.zeros(self._count))[seen[mine]] += cosine[seen[mine]]

    def result(self, spread: Callable[[F64], F32]) -> Votes | None:
        """The votes as a picture, which `spread` makes from (N, L); None if there are none."""
        return Votes(self._codes, spread(self._table())) if self._votes else None

    def winners(self) -> U8:
        """(count,) code of each point; 0 without votes."""
        return elected(self._codes, self._table()) if self._votes else np.zeros(self._count, np.uint8)

    @property
    def _codes(self) -> U8:
        return np.array(sorted(self._votes), np.uint8)

    def _table(self) -> F64:
        """(count, L) votes by code, ascending."""
        return np.stack([self._votes[c] for c in sorted(self._votes)], 1)


def read_labels(path: Path) -> U8:
    """(H, W) codes of an 8-bit grey picture."""
    return np.asarray(read_encoded(path)[..., 0], np.uint8)
