"""The whole way from a field and a mesh with charts to arrays of maps."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from pipeline import raster, tangents
from pipeline.errors import StageError
from pipeline.fields.protocol import Field
from pipeline.maths import microfacet
from pipeline.meshes import F32, Charts, Indices, Mask, Mesh
from stages.bake.confidence import View, confidence
from stages.bake.gutter import nearest_index
from stages.bake.lut import basis_lut
from stages.bake.texels import Samples, sample

log = logging.getLogger("neuface.bake")

BAND = 262_144  # texels baked at once
FEW_TEXELS = 100
MANY_LOST = 0.02  # share of texels off the zero set, beyond the cap of a bust
RESIDUAL = 0.1  # of the basis: from here on the table is only an approximation worth a word
SHARP_KAPPA = 50.0  # light of order 10 can't tell sharper lobes apart

Step = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class Baked:
    """Samples of the covered texels; `texel` (N,) their flat indices. `nearest` (H, W): row in `texel` for each texel.

    confidence (S, S) at its own size; lut (1, 64, k); coverage: share of covered texels.
    """

    size: int
    texel: Indices
    nearest: Indices
    samples: Samples
    confidence: F32
    lut: F32
    coverage: float
    warnings: tuple[str, ...]

    def covered(self) -> Mask:
        """(H, W) texels that a chart touches."""
        out = np.zeros(self.size * self.size, np.bool_)
        out[self.texel] = True
        return out.reshape(self.size, self.size)


def build(field: Field, mesh: Mesh, charts: Charts, views: Sequence[View], size: int, step: Step) -> Baked:
    """Bake every texel that a chart touches.

    Raises:
        StageError: no chart has area, or the field is not finite on the mesh.
    """
    texel, samples = _bands(field, mesh, charts, size, step)
    if len(texel) < FEW_TEXELS:
        raise StageError(
            "the charts cover no texels",
            where="uv",
            value=f"{len(texel)} of {size * size}",
            limit=f"at least {FEW_TEXELS}",
            remedy="run the uv stage again, or choose a larger bake.size",
        )
    seen = confidence(mesh, charts, views, size, lambda done, total: step(done, total, "visibility"))
    lut, residual = basis_lut(field)
    covered = np.zeros(size * size, np.bool_)
    covered[texel] = True
    row_of = np.cumsum(covered) - 1
    nearest = row_of[nearest_index(covered.reshape(size, size))]
    share = len(texel) / size**2
    log.info("bake: %.1f %% covered, basis residual %.3f", 100 * share, residual)
    return Baked(size, texel, nearest, samples, seen, lut, share, _warnings(samples, residual, len(views)))


def _bands(field: Field, mesh: Mesh, charts: Charts, size: int, step: Step) -> tuple[Indices, Samples]:
    corners = raster.texel_corners(charts, size)
    frame = tangents.frames(mesh, charts)
    texels: list[Indices] = []
    parts: list[Samples] = []
    for first, last in _rows(size):
        step(first, size, "baking")
        hits = raster.rasterise(corners, size, first, last)
        if len(hits.texel):
            texels.append(hits.texel)
            parts.append(sample(field, mesh, frame, hits))
    if not parts:
        return np.zeros(0, np.int64), _empty(field.rank)
    joined = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Samples)}
    return np.concatenate(texels), Samples(**joined)


def _rows(size: int) -> Iterator[tuple[int, int]]:
    rows = max(1, BAND // size)
    for first in range(0, size, rows):
        yield first, min(first + rows, size)


def _empty(rank: int) -> Samples:
    one, three, k = (np.zeros(s, np.float32) for s in ((0,), (0, 3), (0, rank)))
    return Samples(three, one, k, one, three, one, three, one, np.zeros(0, np.bool_))


def _warnings(s: Samples, residual: float, views: int) -> tuple[str, ...]:
    out = []
    lost = float(1 - s.landed.mean())
    if lost > MANY_LOST:
        out.append(
            f"{lost:.1%} of the texels have no zero set of the field near them (the flat cut of the neck, or a "
            "mesh that does not belong to this field)"
        )
    if residual > RESIDUAL:
        out.append(f"basis_lut.exr is a mean over directions: the learned basis varies by {residual:.0%} around it")
    sharp = float((s.inv_kappa < 1 / SHARP_KAPPA).mean())
    if sharp > 0.01:
        out.append(
            f"{sharp:.0%} of the texels have kappa above {SHARP_KAPPA:.0f}: light of order 10 can't tell such "
            "lobes apart"
        )
    clamped = float(((1 / np.maximum(s.inv_kappa, 1e-6)) < microfacet.KAPPA_RANGE[0]).mean())
    if clamped > 0.01:
        out.append(f"{clamped:.0%} of the texels are rougher than the roughness map can say")
    if views == 0:
        out.append("no fitted view has a camera: confidence is 0 everywhere")
    return tuple(out)
