"""From a field and a mesh with charts to arrays of maps, tile by tile."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline import footprint, meshes, raster, tangents, tiles
from pipeline.errors import StageError
from pipeline.fields.protocol import Field
from pipeline.lighting.surroundings import Surroundings
from pipeline.meshes import F32, F64, Charts, Indices, Mask, Mesh
from pipeline.smoothing import continued
from pipeline.visibility import FittedPhoto, Occluder
from stages.bake import detail, detail_views
from stages.bake.ambient import ambient
from stages.bake.base_colour import CORRECTION
from stages.bake.confidence import SIZE as SIGHT
from stages.bake.confidence import sighted
from stages.bake.detail import shade
from stages.bake.dilate import HALO, nearest_rows
from stages.bake.even_skin import Even
from stages.bake.eyes import OPEN, Eyes, usual_behind_lids
from stages.bake.filling import Filler
from stages.bake.lit import Measured
from stages.bake.lut import basis_lut
from stages.bake.memmap_buffer import MemmapBuffer, blank
from stages.bake.mouth import Inside
from stages.bake.odd_colours import doubted
from stages.bake.regions import Votes, areas, unanimous
from stages.bake.relief import relief
from stages.bake.sources import sources
from stages.bake.standard_fit import Fitted
from stages.bake.standard_observe import field_normals, standard_material
from stages.bake.statistics import Statistics, statistics_of
from stages.bake.texels import Known, Samples, place, points, sample

log = logging.getLogger("neuface.bake")

BAND = 262_144  # texels baked at once
NEAREST_BAND = 1 << 24  # texels per band in the search for the nearest covered texel; bands overlap
SPARSE = 512  # texels along a side of the coarse texture at which the detail's low band is sampled; less per tile
FEW_TEXELS = 100
DENSER = 0.8  # of the mean texel: if the finest charts have smaller texels, they were enlarged on purpose (the face)

Step = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class Baked:
    """One tile. samples: of the covered texels; texel (N,): their flat indices; nearest (H, W): row in `texel` of the
    nearest covered texel.

    confidence (S, S) and votes for the regions have a size of their own; lut (1, 64, k); regions: area (m^2) of the
    surface by region code, empty if no photo has labels.
    """

    size: int
    texel: Indices
    nearest: npt.NDArray[np.int32]
    samples: Samples
    confidence: F32
    lut: F32
    statistics: Statistics
    votes: Votes | None
    regions: dict[int, float]

    def covered(self) -> Mask:
        """(H, W) mask of the texels that a chart touches."""
        return _covered(self.texel, self.size)


@dataclass(frozen=True, slots=True)
class Photos:
    """Data for the photo detail besides the views: the fitted colour responses (views, 3, 3), and the attenuation of
    the light's bands in the fit."""

    responses: F64
    attenuation: str


class Baker:
    """Computes once what all tiles share: ambient occlusion, visibility in the photos, and the low bands of the photo
    detail. `tile` may then be called for each of `tiles`."""

    def __init__(
        self,
        field: Field,
        mesh: Mesh,
        charts: Charts,
        views: Sequence[FittedPhoto],
        size: int,
        step: Step,
        photos: Photos | None = None,
        scratch: Path | None = None,
        skin_code: int = -1,
        fit_standard: bool = True,
        eyes: Eyes | None = None,
        mouth: Inside | None = None,
        region: Indices | None = None,
        hair: Mask | None = None,
        hair_code: int = -1,
        measured: Measured | None = None,
        even: Even | None = None,
        surroundings: Surroundings | None = None,
    ) -> None:
        """`photos`: adds their fine detail to the albedo. `scratch`: folder for arrays that do not fit in memory.
        `skin_code`: label of skin in the photos. `fit_standard`: fit the standard shaders to the photos, if given.
        `eyes`: the fitted eyes of the template; `mouth`: the inside of its mouth. `region` (V,): of the head, of each
        vertex (head_regions.region_of); None: one region. `hair` (V,): vertices of the mesh of hair, which
        is the last tile, with the label `hair_code`. `measured`: what a light stage says, of the first tile.
        `even`: takes errors of the light out of the base colour of skin (even_skin.py). `surroundings`: what the photos
        show behind the subject."""
        self.tiles = tiles.count(charts)
        self.lut, self.residual = basis_lut(field)
        self._field, self._whole, self._views, self._size = field, (mesh, charts), views, size
        self._step, self._scratch = step, scratch
        self._hair_code = hair_code if hair is not None else -1
        self._occluder = Occluder(mesh)
        around = ambient(mesh, self._occluder, lambda done, total: step(done, total, "ambient occlusion"))
        shape = relief(
            mesh, surface_normals(field, mesh), self._occluder, lambda done, total: step(done, total, "thickness")
        )
        fill = Filler.of(mesh, views, self._occluder, mouth, region)
        self._known = replace(_known(field, fill, around), eyes=eyes, relief=shape)
        self._measured = measured
        self._found = _detail(field, mesh, charts, views, size, photos, step) if photos is not None and views else None
        self.detailed = self._found is not None
        self.material_figures: dict[str, float] = {}
        standard: Fitted | None = None
        if fit_standard and self._found is not None:
            step(0, 1, "standard material")
            seen = self._known.unseen < 0.5
            fitted = standard_material(
                field, mesh, views, skin_code, seen, self._found, lambda: step(0, 1, "standard material"), hair,
                self._known.albedo, region, even, surroundings,
            )  # fmt: skip
            if fitted.plausible:
                standard, self.material_figures = fitted, fitted.figures
            else:
                self.material_figures = {"standard_refused_f0": fitted.figures["gloss_rest_refused_f0"]}
        if region is not None:  # things may have any colour in one place
            self._known, standard = _believed(self._known, field, fill, standard)
        if standard is not None and eyes is not None:
            standard = _corrected_at_eyes(standard, eyes, field, mesh, self._known)
        told = sources(self._known.unseen, self._known.replaced, standard)
        self._known = replace(self._known, standard=standard, sources=told)

    @property
    def standard_fitted(self) -> bool:
        """Whether the maps are those of the fitted standard material, or measured by a light stage."""
        return self._known.standard is not None or self._measured is not None

    def tile(self, number: int) -> Baked:
        """Bake all texels that a chart of this tile touches.

        Raises:
            StageError: the charts cover no texels, or the field is not finite on the mesh.
        """
        size, step = self._size, self._step
        mesh, charts = tiles.single_tile(*self._whole, number)

        def ahead(done: int, total: int, message: str) -> None:
            step(number * total + done, self.tiles * total, message)

        known = replace(self._known, measured=self._measured if number == 0 else None)
        texel, samples = _bands(self._field, mesh, charts, size, ahead, known, self._found, self._scratch)
        least = FEW_TEXELS if self.tiles == 1 else 1
        if len(texel) < least:
            raise StageError(
                "the charts cover no texels",
                where="uv",
                value=f"{len(texel)} of {size * size}",
                limit=f"at least {least}",
                remedy="run the uv stage again, or raise bake.size",
            )
        side = min(size, _per_tile(SIGHT, self.tiles))
        seen = sighted(
            mesh, charts, self._views, side, lambda done, total: ahead(done, total, "visibility"), self._occluder
        )
        nearest = nearest_covered(texel, size, self._scratch)
        found = statistics_of(samples, size)
        log.info(
            "bake: tile %d, %.1f %% covered, basis residual %.3f",
            tiles.FIRST + number,
            100 * found.coverage,
            self.residual,
        )
        labelled, votes = any(v.labels is not None for v in self._views), seen.votes
        if labelled and self._hair_code > 0 and number == self.tiles - 1:
            votes = unanimous(self._hair_code)
        regions = areas(mesh, charts, votes) if labelled else {}
        return Baked(size, texel, nearest, samples, seen.confidence, self.lut, found, votes, regions)


def surface_normals(field: Field, mesh: Mesh) -> F64:
    """(V, 3) the field's unit normals at the vertices, the mesh's own where it is not the zero set (the inside of a
    mouth, the cut of the neck)."""
    near = np.abs(field.sdf_and_gradient(mesh.vertices)[0]) < field.cell
    return np.where(near[:, None], field_normals(field, mesh), meshes.unit(mesh.normals))


def _per_tile(side: int, count: int) -> int:
    """Side of each of `count` tiles that together have about as many texels as one tile of `side`."""
    return int(np.ceil(side / np.sqrt(count)))


def _known(field: Field, fill: Filler, around: F32) -> Known:
    """around (V,): ambient occlusion."""
    replaced, albedo = fill(field.material(fill.mesh.vertices).albedo.astype(np.float64))
    unseen = (fill.sight.cosine == 0).astype(np.float32)
    return Known(around, unseen, replaced.astype(np.float32), albedo.astype(np.float32))


def _believed(known: Known, field: Field, fill: Filler, fitted: Fitted | None) -> tuple[Known, Fitted | None]:
    """Both with the colours replaced that few photos show, and no other place has or these photos contradict
    (odd_colours.py)."""
    own = field.material(fill.mesh.vertices).albedo.astype(np.float64)
    shown = own if fitted is None else own * fitted.correction
    doubt = doubted(fill.mesh, shown, fill.region, fill.sight, None if fitted is None else fitted.apart)
    if not doubt.any():
        return known, fitted
    replaced, albedo = fill(own, doubt)
    if fitted is not None:
        right = (known.unseen < 0.5) & (doubt == 0)
        correction = continued(fill.mesh, fitted.correction.astype(np.float64), right)
        fitted = replace(fitted, correction=correction.astype(np.float32))
    return replace(known, replaced=replaced.astype(np.float32), albedo=albedo.astype(np.float32)), fitted


def _corrected_at_eyes(fitted: Fitted, eyes: Eyes, field: Field, mesh: Mesh, known: Known) -> Fitted:
    """The fitted material with the correction of the eyes: their albedo is not the field's."""
    ratio = np.asarray(field.irradiance_ratio(mesh.vertices), np.float32)
    lit = shade(field.light, meshes.unit(mesh.normals), ratio).astype(np.float64)
    own = np.where((eyes.of_vertex >= 0)[:, None], lit / np.maximum(fitted.received, 1e-6), fitted.correction)
    shown = (known.unseen < 0.5) & (known.ambient > OPEN)
    return replace(fitted, correction=usual_behind_lids(eyes, mesh, own.clip(*CORRECTION), shown))


def _detail(
    field: Field, mesh: Mesh, charts: Charts, views: Sequence[FittedPhoto], size: int, photos: Photos, step: Step
) -> detail.Detail:
    count = tiles.count(charts)
    sparse = min(size, _per_tile(SPARSE, count))
    some = detail.joined([_spread(field, *tiles.single_tile(mesh, charts, t), sparse) for t in range(count)])
    area = float(meshes.areas(mesh.vertices, mesh.faces).sum())
    texel = float(np.sqrt(area / max(len(some.x), 1))) * sparse / size
    fine = footprint.fine_texel(mesh, charts, size)
    texel = fine if fine < DENSER * texel else texel
    read = detail_views.read_photos(
        views, photos.responses, mesh, texel, lambda done, total: step(done, total, "reading photos")
    )
    return detail.prepare(
        field, mesh, some, read, photos.attenuation, lambda done, total: step(done, total, "photo detail")
    )


def _spread(field: Field, mesh: Mesh, charts: Charts, sparse: int) -> detail.Points:
    """Points of a tile's surface: those of the texels of a coarse texture."""
    hits = raster.rasterise(raster.texel_corners(charts, sparse), sparse, 0, sparse)
    at = place(field, mesh, tangents.frames(mesh, charts), hits)
    x = at.x.astype(np.float32)
    return points(field, mesh, hits, at, field.material(x).albedo, np.asarray(field.irradiance_ratio(x), np.float32))


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
    buffer = MemmapBuffer(scratch)
    for first, last in bands(size):
        step(first, size, "baking")
        hits = raster.rasterise(corners, size, first, last)
        part = sample(field, mesh, frame, hits, known, found)
        buffer.append({"texel": hits.texel} | {f.name: getattr(part, f.name) for f in fields(Samples)})
    arrays = buffer.arrays()
    return arrays.pop("texel"), Samples(**arrays)


def bands(size: int, texels: int | None = None) -> Iterator[tuple[int, int]]:
    """First and last row (exclusive) of the bands of a picture, with about `texels` (default BAND) texels each."""
    rows = max(1, (texels or BAND) // size)
    for first in range(0, size, rows):
        yield first, min(first + rows, size)


def _covered(texel: Indices, size: int) -> Mask:
    out = np.zeros(size * size, np.bool_)
    out[texel] = True
    return out.reshape(size, size)


def nearest_covered(texel: Indices, size: int, scratch: Path | None) -> npt.NDArray[np.int32]:
    """(H, W) row in `texel` of the nearest covered texel, computed band by band."""
    covered = _covered(texel, size)
    row = blank(scratch, (size * size,), np.int32)
    row[texel] = np.arange(len(texel), dtype=np.int32)
    out = blank(scratch, (size, size), np.int32)
    for first, last in bands(size, max(NEAREST_BAND, HALO * size)):
        out[first:last] = row[nearest_rows(covered, first, last)]
    return out
