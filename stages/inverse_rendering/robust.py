"""The weights of photos and their parts in a running fit: the residuals of its own rays are kept, and weighed from time
to time (photo_weights.py). Nothing is rendered for it. The state is part of a checkpoint, and has no random numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pipeline.faces.labels import LABELS
from pipeline.fields.face import FaceModel
from stages.inverse_rendering.objective import Seen
from stages.inverse_rendering.photo_weights import CELLS, FACINGS, LOW, Residuals, Weights, weigh
from stages.inverse_rendering.ray_sampling import U8, Batch, PhotoView, codes_at, factor_for, normalised_positions
from stages.inverse_rendering.stereo import photo_noise

F64 = npt.NDArray[np.float64]
OBSERVE_FROM = 0.4  # share of the fit: model and light are selected, and the reflectance has adapted to them
WEIGH_AT = (0.48, 0.56, 0.64, 0.72, 0.8, 0.88, 0.96)  # shares of the fit
WINDOW = 200  # steps whose residuals are kept
PLACES = 24  # places along the longest side of the model's box: of a head about a centimetre
LABEL_SIDE = 256  # pixels, to count the labels of a cell
MOVING = ("hair", "eyes")  # labels of what moves between photos

Step = tuple[Tensor, Tensor, Tensor]  # of one step: place and facing, photo and cell, residual


@dataclass(slots=True)
class Robust:
    """used: whether photos are weighed at all. steps: the residuals of the last steps. due: how many of WEIGH_AT are
    done. moves: (V, CELLS, CELLS) share of each cell with a label that moves. latest: rays of the step under way."""

    views: Sequence[PhotoView]
    used: bool
    side: int
    steps: list[Step] = field(default_factory=list)
    due: int = 0
    weights: Weights | None = None
    moves: F64 = field(init=False)
    latest: tuple[Batch, Seen] | None = None
    _table: Tensor | None = None
    _noise: F64 | None = None
    _to_cell: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.moves = np.zeros((len(self.views), CELLS, CELLS))
        self._to_cell = _cell_from_plane(self.views)

    def know_labels(self, labels: Sequence[U8 | None], names: Sequence[str]) -> None:
        """Read where the labels say that things move. labels: (H, W) codes of each photo; names: of the codes."""
        codes = [n for n, name in enumerate(names or LABELS) if name in MOVING]
        for n, (view, found) in enumerate(zip(self.views, labels, strict=True)):
            if found is not None:
                xy = normalised_positions(view, factor_for(view.size, LABEL_SIDE)).reshape(-1, 2)
                at = torch.from_numpy(xy)
                cell = cells_of(at, torch.zeros(len(at), dtype=torch.int64), _cell_from_plane([view])).numpy()
                there = np.isin(codes_at(view, at, found), codes)
                count = np.maximum(np.bincount(cell, minlength=CELLS**2), 1)
                self.moves[n] = (np.bincount(cell, there, CELLS**2) / count).reshape(CELLS, CELLS)

    def of(self, batch: Batch) -> Tensor | None:
        """(N,) weights of a batch's rays; None if all count alike."""
        if self.weights is None:
            return None
        if self._table is None:
            self._table = torch.from_numpy(self.weights.table.reshape(-1).astype(np.float32)).to(batch.alpha.device)
        return self._table[self._place(batch)]

    def note(self, model: FaceModel) -> None:
        """Keep the residuals of the latest step, which was not dropped."""
        if self.latest is None:
            return
        batch, seen = self.latest
        self.latest = None
        lo, hi = (torch.tensor(corner, device=seen.x.device) for corner in (model.spec.lo, model.spec.hi))
        at = ((seen.x - lo) / ((hi - lo).max() / PLACES)).long().clamp(0, PLACES - 1)
        place = (at[:, 0] * PLACES + at[:, 1]) * PLACES + at[:, 2]
        cosine = -(seen.n * batch.rays.d[seen.rays]).sum(-1)
        facing = (cosine * FACINGS).long().clamp(0, FACINGS - 1)
        where = self._place(batch)[seen.rays]
        self.steps.append(((place * FACINGS + facing).int(), where.int(), seen.residual.float()))
        del self.steps[:-WINDOW]

    def weigh(self) -> None:
        """Weigh the photos by the residuals that are kept."""
        if not self.steps:
            return
        if self._noise is None:
            self._noise = np.array([photo_noise(v, self.side) for v in self.views])
        what, where, residual = (torch.cat(part).cpu().numpy() for part in zip(*self.steps, strict=True))
        place, facing = np.divmod(what.astype(np.int64), FACINGS)
        view, cell = np.divmod(where.astype(np.int64), CELLS**2)
        seen = Residuals(residual.astype(np.float64), place, facing, view, cell)
        self.weights, self._table = weigh(seen, self._noise, self.moves), None

    def facts(self) -> dict[str, str | float | bool]:
        """For the report."""
        if self.weights is None:
            return {"weighed": False, "why": "the fit was too short" if self.used else "setting"}
        mean, low = self.weights.of_photos()
        return {
            "weighed": True,
            "why": "setting",
            "lowest_weight": round(float(mean.min()), 4),
            "photos_with_low_weight": int((mean < LOW).sum()),
            "low_share": round(float(low.mean()), 4),
        }

    def of_photos(self) -> list[tuple[float, float]]:
        """Mean weight and share of low weights of each photo, to 4 digits; empty if all count alike."""
        if self.weights is None:
            return []
        mean, low = self.weights.of_photos()
        return [(round(float(w), 4), round(float(s), 4)) for w, s in zip(mean, low, strict=True)]

    def _place(self, batch: Batch) -> Tensor:
        """(N,) index of each ray's photo and cell."""
        self._to_cell = self._to_cell.to(batch.xy)
        return batch.view * CELLS**2 + cells_of(batch.xy, batch.view, self._to_cell)

    # ---------------------------------------------------------------- checkpoints
    def stored(self) -> dict[str, Any]:
        """For a checkpoint."""
        w = self.weights
        return {
            "due": self.due,
            "lengths": [len(step[0]) for step in self.steps],
            "steps": [torch.cat(part).cpu() for part in zip(*self.steps, strict=True)],
            "weights": None if w is None else [torch.from_numpy(part) for part in (w.view, w.cell, w.rays)],
        }

    def restore(self, state: dict[str, Any], device: str) -> None:
        """Inverse of `stored`."""
        self.due = int(state["due"])
        parts = [part.to(device).split(state["lengths"]) for part in state["steps"]]
        self.steps = list(zip(*parts, strict=True))
        self.weights = None if state["weights"] is None else Weights(*(part.numpy() for part in state["weights"]))
        self._table = None


def cells_of(xy: Tensor, view: Tensor, cell_from_plane: Tensor) -> Tensor:
    """(N,) cell of positions xy (N, 2) on the z = 1 plane of the photos view (N,). Distortion is left out: a cell is
    much larger."""
    m = cell_from_plane[view]
    column, row = ((m[:, k, :2] * xy).sum(-1) + m[:, k, 2] for k in (0, 1))
    last = CELLS - 1
    return row.floor().long().clamp(0, last) * CELLS + column.floor().long().clamp(0, last)


def _cell_from_plane(views: Sequence[PhotoView]) -> Tensor:
    """(V, 2, 3) from the z = 1 plane to column and row in cells."""
    return torch.from_numpy(np.stack([v.K[:2] * (CELLS / max(v.size)) for v in views]).astype(np.float32))
