"""Which region of a head each texel belongs to: the photos' labels, voted on.

Every fitted photo with labels votes for the label of the pixel under a place that it sees, with the cosine between
the normal and the direction to the camera. The label with the most votes wins, the lower code where two have as many.
Labels are whole numbers in one picture a photo (pipeline.artifacts.ViewMask); what they mean does not matter here.
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
from pipeline.visibility import View, picked

U8 = npt.NDArray[np.uint8]
GRID = 8192  # texels along the side of the texture in which triangles' middles are looked up
FEW_VOTES = 1e-3  # one photo that sees the place from the very side


@dataclass(frozen=True, slots=True)
class Votes:
    """codes (L,) of the labels that were voted for, ascending, none of them 0; image (S, S, L) their votes."""

    codes: U8
    image: F32

    def winners(self, texel: Indices, size: int) -> U8:
        """(N,) codes of texels, given by row * size + column; 0 without votes. Votes are linear between places."""
        side = len(self.image)
        row, column = (np.clip((i + 0.5) * side / size - 0.5, 0, side - 1) for i in np.divmod(texel, size))
        top, left = row.astype(np.int64), column.astype(np.int64)
        low, right = np.minimum(top + 1, side - 1), np.minimum(left + 1, side - 1)
        y, x = ((p - q).astype(np.float32)[:, None] for p, q in ((row, top), (column, left)))
        upper = self.image[top, left] * (1 - x) + self.image[top, right] * x
        lower = self.image[low, left] * (1 - x) + self.image[low, right] * x
        votes = upper * (1 - y) + lower * y
        return np.where(votes.max(1) > FEW_VOTES, self.codes[votes.argmax(1)], 0).astype(np.uint8)


def areas(mesh: Mesh, charts: Charts, votes: Votes | None) -> dict[int, float]:
    """Area of the surface by the code of its region, 0 where no photo with labels sees it. Each triangle counts with
    the label under its middle."""
    area = meshes.areas(mesh.vertices, mesh.faces)
    if votes is None:
        return {0: float(area.sum())}
    middle = charts.uvs.astype(np.float64)[charts.faces].mean(1)
    column, row = (np.stack([middle[:, 0], 1 - middle[:, 1]]) * GRID).astype(np.int64).clip(0, GRID - 1)
    code = votes.winners(row * GRID + column, GRID)
    total = np.bincount(code, area)
    return {int(c): float(total[c]) for c in np.flatnonzero(np.bincount(code))}


class Poll:
    """Gathers votes at `count` places."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._votes: dict[int, F64] = {}

    def ask(self, view: View, cosine: F64, uv: F64) -> None:
        """A view that sees places with cosines (N,), 0 where it does not, at pixels (N, 2)."""
        if view.labels is None:
            return
        seen = np.flatnonzero(cosine)
        label = picked(read_labels(view.labels), view.camera, uv[seen])
        for code in np.unique(label):
            if code > 0:
                mine = label == code
                self._votes.setdefault(int(code), np.zeros(self._count))[seen[mine]] += cosine[seen[mine]]

    def result(self, spread: Callable[[F64], F32]) -> Votes | None:
        """The votes, as a picture that `spread` makes from (N, L); None without any."""
        if not self._votes:
            return None
        codes = sorted(self._votes)
        return Votes(np.array(codes, np.uint8), spread(np.stack([self._votes[c] for c in codes], 1)))


def read_labels(path: Path) -> U8:
    """(H, W) codes of an 8-bit grey picture."""
    return np.asarray(read_encoded(path)[..., 0], np.uint8)
