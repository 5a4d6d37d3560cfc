"""The whole way from a field and a mesh with charts to arrays of maps."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline import meshes, raster, tangents
from pipeline.errors import StageError
from pipeline.fields.protocol import Field
from pipeline.maths import microfacet
from pipeline.meshes import F32, F64, Charts, Indices, Mask, Mesh
from pipeline.visibility import Occluder, View, seen_weight
from stages.bake import detail, detail_views
from stages.bake.ambient import ambient
from stages.bake.confidence import sighted
from stages.bake.gutter import HALO, nearest_rows
from stages.bake.lut import basis_lut
from stages.bake.regions import Votes
from stages.bake.smooth import continued
from stages.bake.spool import Spool, blank
from stages.bake.texels import Known, Samples, place, points, sample

log = logging.getLogger("neuface.bake")

BAND = 262_144  # texels baked at once
NEAREST_BAND = 1 << 24  # texels whose nearest chart is looked for at once: around each band some are looked at again
SPARSE = 512  # texels along a side of the points that the detail's low band is made from
FEW_TEXELS = 100
MANY_LOST = 0.02  # share of texels off the zero set, beyond the cap of a bust
MANY_CLAMPED = 0.001
RESIDUAL = 0.1  # of the basis: from here on the table is only an approximation worth a word
SHARP_KAPPA = 50.0  # light of order 10 can't tell sharper lobes apart

Step = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class Baked:
    """Samples of the covered texels; `texel` (N,) their flat indices. `nearest` (H, W): row in `texel` for each texel.

    confidence (S, S) and votes for the regions at their own size; lut (1, 64, k); coverage: share of covered texels;
    figures: for the report.
    """

    size: int
    texel: Indices
    nearest: npt.NDArray[np.int32]
    samples: Samples
    confidence: F32
    lut: F32
    coverage: float
    figures: dict[str, float]
    warnings: tuple[str, ...]
    votes: Votes | None = None

    def covered(self) -> Mask:
        """(H, W) texels that a chart touches."""
        return _covered(self.texel, self.size)


@dataclass(frozen=True, slots=True)
class Photos:
    """What the photo detail needs beside the views: the fitted colour responses (views, 3, 3), and how the fit
    attenuated the light's bands."""

    responses: F64
    attenuation: str


def build(
    field: Field,
    mesh: Mesh,
    charts: Charts,
    views: Sequence[View],
    size: int,
    step: Step,
    photos: Photos | None = None,
    scratch: Path | None = None,
) -> Baked:
    """Bake every texel that a chart touches. `photos`: add their fine detail to the albedo. `scratch`: a folder for
    arrays larger than the memory.

    Raises:
        StageError: no chart has area, or the field is not finite on the mesh.
    """
    occluder = Occluder(mesh)
    known = _known(field, mesh, views, occluder, lambda done, total: step(done, total, "ambient occlusion"))
    found = _detail(field, mesh, charts, views, size, photos, step) if photos is not None and views else None
    texel, samples = _bands(field, mesh, charts, size, step, known, found, scratch)
    if len(texel) < FEW_TEXELS:
        raise StageError(
            "the charts cover no texels",
            where="uv",
            value=f"{len(texel)} of {size * size}",
            limit=f"at least {FEW_TEXELS}",
            remedy="run the uv stage again, or choose a larger bake.size",
        )
    seen = sighted(mesh, charts, views, size, lambda done, total: step(done, total, "visibility"))
    lut, residual = basis_lut(field)
    nearest = _nearest(texel, size, scratch)
    share = len(texel) / size**2
    log.info("bake: %.1f %% covered, basis residual %.3f", 100 * share, residual)
    figures = _figures(samples, found is not None)
    warnings = _warnings(samples, residual, len(views))
    return Baked(size, texel, nearest, samples, seen.confidence, lut, share, figures, warnings, seen.votes)


def _known(
    field: Field, mesh: Mesh, views: Sequence[View], occluder: Occluder, step: Callable[[int, int], None]
) -> Known:
    normals = meshes.unit(mesh.normals)
    seen = seen_weight(mesh.vertices.astype(np.float64), normals, views, occluder) > 0
    albedo = continued(mesh, field.material(mesh.vertices).albedo.astype(np.float64), seen)
    return Known(ambient(mesh, occluder, step), (~seen).astype(np.float32), albedo.astype(np.float32))


def _detail(
    field: Field, mesh: Mesh, charts: Charts, views: Sequence[View], size: int, photos: Photos, step: Step
) -> detail.Detail:
    sparse = min(size, SPARSE)
    hits = raster.rasterise(raster.texel_corners(charts, sparse), sparse, 0, sparse)
    at = place(field, mesh, tangents.frames(mesh, charts), hits)
    x = at.x.astype(np.float32)
    some = points(field, mesh, hits, at, field.material(x).albedo, np.asarray(field.irradiance_ratio(x), np.float32))
    area = float(meshes.areas(mesh.vertices, mesh.faces).sum())
    texel = float(np.sqrt(area / max(len(hits.texel), 1))) * sparse / size
    read = detail_views.read_photos(
        views, photos.responses, mesh, texel, lambda done, total: step(done, total, "reading photos")
    )
    return detail.prepare(
        field, mesh, some, read, photos.attenuation, lambda done, total: step(done, total, "photo detail")
    )


def _bands(
    field: Field,
    mesh: Mesh,
    charts: Charts,
    size: int,
    step: Step,
    known: Known,
    found: detail.Detail | None,
    scratch: Path | None,
) -> tuple[Indices, Samples]:
    corners = raster.texel_corners(charts, size)
    frame = tangents.frames(mesh, charts)
    spool = Spool(scratch)
    for first, last in bands(size):
        step(first, size, "baking")
        hits = raster.rasterise(corners, size, first, last)
        part = sample(field, mesh, frame, hits, known, found)
        spool.append({"texel": hits.texel} | {f.name: getattr(part, f.name) for f in fields(Samples)})
    arrays = spool.arrays()
    return arrays.pop("texel"), Samples(**arrays)


def bands(size: int, texels: int | None = None) -> Iterator[tuple[int, int]]:
    """First and last row (exclusive) of the bands that a picture is worked off in, of BAND texels or as asked."""
    rows = max(1, (texels or BAND) // size)
    for first in range(0, size, rows):
        yield first, min(first + rows, size)


def _covered(texel: Indices, size: int) -> Mask:
    out = np.zeros(size * size, np.bool_)
    out[texel] = True
    return out.reshape(size, size)


def _nearest(texel: Indices, size: int, scratch: Path | None) -> npt.NDArray[np.int32]:
    """(H, W) row in `texel` of the covered texel nearest to each, band by band."""
    covered = _covered(texel, size)
    row = blank(scratch, (size * size,), np.int32)
    row[texel] = np.arange(len(texel), dtype=np.int32)
    out = blank(scratch, (size, size), np.int32)
    for first, last in bands(size, max(NEAREST_BAND, HALO * size)):
        out[first:last] = row[nearest_rows(covered, first, last)]
    return out


def _figures(s: Samples, detailed: bool) -> dict[str, float]:
    out = {"unseen": float((s.unseen > 0.5).mean()), "albedo_clamped": float((s.clamped > 0).mean())}
    if detailed:
        out["detail_support"] = float((s.support > detail.HALF_WEIGHT).mean())
    return {k: round(v, 6) for k, v in out.items()}


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
    rough = float(((1 / np.maximum(s.inv_kappa, 1e-6)) < microfacet.KAPPA_RANGE[0]).mean())
    if rough > 0.01:
        out.append(f"{rough:.0%} of the texels are rougher than the roughness map can say")
    clamped = float((s.clamped > 0).mean())
    if clamped > MANY_CLAMPED:
        out.append(
            f"the albedo of {clamped:.1%} of the texels was outside of what skin can be and was clamped "
            "(clamped.png shows where)"
        )
    if views == 0:
        out.append("no fitted view has a camera: confidence is 0 everywhere")
    return tuple(out)
