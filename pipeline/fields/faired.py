"""A field whose surface was made fair where no photo shows it (stages.surface.fairing), as a file beside the mesh.

d' = (1 - b) d + b phi      d the field's own distance; phi, b trilinear on a coarse grid
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from pipeline.fields.protocol import Field, Material

if TYPE_CHECKING:  # stages are listed without torch
    from pipeline.lighting.moving import MovingLight

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]


def fair_again(field: Field, path: Path | None) -> Field:
    """The field with the distances of a file that Faired.save wrote; the field itself without a file."""
    if path is None:
        return field
    with np.load(path, allow_pickle=False) as f:
        return Faired(field, f["lower"], float(f["cell"]), f["phi"], f["share"])


class Faired:
    """A field with other distances where `share` says so. lower (3,): first node; cell: distance of nodes; phi,
    share (X, Y, Z): the other distances, and how much of them counts, b. All but the SDF is the field's own."""

    def __init__(self, field: Field, lower: F64, cell: float, phi: F32, share: F32) -> None:
        self._field, self._lower, self._cell, self._phi, self._share = field, lower, cell, phi, share
        self._slopes = [[np.asarray(g, np.float64) for g in np.gradient(a, cell)] for a in (phi, share)]

    def save(self, path: Path) -> None:
        """Write the distances; the field itself is not in the file."""
        counts = ndimage.maximum_filter(self._share, 5) > 0  # nodes that values and slopes are interpolated from
        np.savez_compressed(path, lower=self._lower, cell=self._cell, phi=np.where(counts, self._phi, np.float32(0)),
                            share=self._share)  # fmt: skip

    def sdf(self, points: F32) -> F32:
        """See Field."""
        value, (on, p, b) = np.array(self._field.sdf(points)), self._concerned(points)
        value[on] += (b * (self._at(self._phi, p) - value[on])).astype(np.float32)
        return value

    def sdf_and_gradient(self, points: F32) -> tuple[F32, F32]:
        """See Field. d((1 - b) d + b phi) = (1 - b) dd + b dphi + (phi - d) db."""
        value, gradient = (np.array(a) for a in self._field.sdf_and_gradient(points))
        on, p, b = self._concerned(points)
        more = self._at(self._phi, p) - value[on]
        of_phi, of_share = (np.stack([self._at(axis, p) for axis in slopes], 1) for slopes in self._slopes)
        gradient[on] += (b[:, None] * (of_phi - gradient[on]) + more[:, None] * of_share).astype(np.float32)
        value[on] += (b * more).astype(np.float32)
        return value, gradient

    def _concerned(self, points: F32) -> tuple[npt.NDArray[np.int64], F64, F64]:
        """The numbers (n,) of the points whose distance is not the field's own, those points (n, 3), and b there."""
        b = self._at(self._share, points.astype(np.float64))
        on = np.flatnonzero(b > 0)
        return on, points[on].astype(np.float64), b[on]

    def _at(self, values: F32 | F64, points: F64) -> F64:
        """(N,) trilinear in values (X, Y, Z)."""
        places = ((points - self._lower) / self._cell).T
        return np.asarray(ndimage.map_coordinates(values, places, order=1, mode="nearest"), np.float64)

    @property
    def bounds(self) -> tuple[F32, F32]:
        """See Field."""
        return self._field.bounds

    @property
    def cell(self) -> float:
        """See Field."""
        return self._field.cell

    @property
    def rank(self) -> int:
        """See Field."""
        return self._field.rank

    @property
    def light(self) -> F32:
        """See Field."""
        return self._field.light

    @property
    def moving_light(self) -> MovingLight | None:
        """See Field."""
        return self._field.moving_light

    @property
    def colour_responses(self) -> F32 | None:
        """See Field."""
        return self._field.colour_responses

    def material(self, points: F32) -> Material:
        """See Field."""
        return self._field.material(points)

    def irradiance_ratio(self, points: F32) -> F32:
        """See Field."""
        return self._field.irradiance_ratio(points)

    def basis(self, wo: F32, normal: F32) -> F32:
        """See Field."""
        return self._field.basis(wo, normal)
