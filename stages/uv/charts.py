"""From a mesh to charts: segments it, parameterises each piece, splits pieces where that helps, packs the charts.

Segmentation and the first parameterisation use the smoothed mesh, because noise would break the pieces into fragments.
The last ARAP steps use the true surface, so that they reduce the true stretch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline import meshes, raster
from pipeline.meshes import F32, F64, Charts, Faces, Indices, Mesh
from stages.uv.density import Front, dense_charts, enlarged, face_parted, scale_for
from stages.uv.pack import LOOSEST, boxed, pack
from stages.uv.parameterise import Flat, parameterised, rigid, signed_areas, unfolded
from stages.uv.segment import Dual, connected, dual, halved, seam_weights, segment, without_fragments
from stages.uv.stretch import STRETCHED, stretches
from stages.uv.tile_count import Tiling, packed

TRUE_STEPS = 6  # ARAP steps on the true surface
LARGE = 0.2  # of the area: larger charts are split if they fill too little of their rectangle
FULL = 0.7  # of its rectangle that a large chart should fill
MOST_STRETCHED = 0.005  # of the area: a chart with more that is stretched is split, as a sleeve laid flat in one piece
TRIES = 5  # packings
GOOD_UTILISATION = 0.66  # share of the square under charts from which no chart is split to pack better
MIN_GAIN = 0.005  # of the square: a packing must gain at least this
MAX_CHARTS = 40
ONE = Tiling()
CHECK = 768  # texels along a chart's longest side, to test it for overlap


@dataclass(frozen=True, slots=True)
class Surface:
    """The mesh to cut: smoothed and true vertices (V, 3); faces, face areas and face pairs of the smoothed mesh; cost
    of a seam at each vertex (V,)."""

    smooth: F64
    true: F64
    faces: Faces
    area: F64
    pairs: Dual
    weight: F64
    front: Front | None = None


def surface_of(mesh: Mesh, smooth: F64, front: Front | None = None, *, quads: bool = False) -> Surface:
    """Prepare a mesh with smoothed vertices (V, 3) for cutting. front: the face, whose charts are larger. quads: the
    faces are pairs, each a quad, which seams go around."""
    weight = seam_weights(smooth, mesh.faces)
    pairs = dual(smooth, mesh.faces, weight, quads=quads)
    area = meshes.areas(smooth, mesh.faces)
    return Surface(smooth, mesh.vertices.astype(np.float64), mesh.faces, area, pairs, weight, front)


def unwrapped(
    mesh: Mesh, smooth: F64, padding: float, tiling: Tiling = ONE, front: Front | None = None, *, quads: bool = False
) -> Charts | None:
    """Charts, or None if the mesh can't be cut into a few discs that can be parameterised.

    smooth: (V, 3) smoothed vertices. padding: between charts, in uv. Charts are made for one tile; for several tiles,
    only charts that are too large for a tile are cut further. front: the face, whose charts are larger. quads: see
    `surface_of`.
    """
    surface = surface_of(mesh, smooth, front, quads=quads)
    label = segment(smooth, mesh.faces, surface.pairs, quads=quads)
    if front is not None:
        label = without_fragments(smooth, mesh.faces, face_parted(label, front, surface.pairs), surface.pairs)
    known: dict[bytes, Flat] = {}
    best: tuple[float, Charts, Indices] | None = None
    tries = 0
    while tries < TRIES and int(label.max()) < MAX_CHARTS:
        flats = flats_of(surface, label, known)
        part = _must_part(surface, flats)
        if part is None:
            tries += 1
            charts = _packed(surface, flats, padding, LOOSEST if best is None else best[0] + MIN_GAIN)
            if charts is not None:
                best = _share(charts), charts, label
            if best is not None and best[0] >= GOOD_UTILISATION:
                break
            part = _worth_parting(surface, flats)
        pieces = int(label.max())
        label = _parted(surface, label, flats[part])
        if int(label.max()) <= pieces:  # a piece of one face
            break
    if best is None:
        return None
    total = _charted(surface, best[2])
    if tiling.content_with(best[0], total):
        return best[1]
    tiled = _tiled(surface, best[2], known, padding, tiling)
    return best[1] if tiled is None else tiled


def _tiled(surface: Surface, label: Indices, known: dict[bytes, Flat], padding: float, tiling: Tiling) -> Charts | None:
    """The pieces packed into several tiles; pieces whose charts are too large for a tile are cut further."""
    total = _charted(surface, label)
    limit = tiling.largest_chart(total)
    while True:
        flats = flats_of(surface, label, known)
        part = next((i for i, f in enumerate(flats) if not f.good or _longest(surface, f) > limit), None)
        pieces = int(label.max())
        if part is None or pieces > MAX_CHARTS * tiling.most:
            break
        label = _parted(surface, label, flats[part])
        if int(label.max()) <= pieces:  # a piece of one face
            break
    if not all(f.good for f in flats):
        return None
    uvs, faces, chart_of_face = together(surface, flats)
    placed = packed(uvs, faces, chart_of_face, total, padding, tiling)
    return None if placed is None else Charts(placed, faces)


def _longest(surface: Surface, flat: Flat) -> float:
    """Longer side of a chart's smallest bounding rectangle, at the scale of the true surface."""
    return float(np.ptp(boxed(_at_scale(surface, flat)), axis=0).max())


def _charted(surface: Surface, label: Indices) -> float:
    """Area of all charts at the scale of the true surface, the face's enlarged."""
    area = meshes.areas(surface.true, surface.faces)
    if surface.front is None:
        return float(area.sum())
    dense = dense_charts(label, surface.front, area)[label]
    return float((area * np.where(dense, scale_for(surface.front, dense, area) ** 2, 1.0)).sum())


def flats_of(surface: Surface, label: Indices, known: dict[bytes, Flat]) -> list[Flat]:
    """Parameterise every piece; results are cached in `known`."""
    count = int(label.max()) + 1
    order = np.argsort(label, kind="stable")
    keys = [m.tobytes() for m in np.split(order, np.searchsorted(label[order], np.arange(1, count)))]
    new = np.array([k not in known for k in keys])
    for flat in parameterised(surface.smooth, surface.faces, surface.pairs, label, new):
        known[flat.member.tobytes()] = _on_true_surface(surface, flat)
    return [known[k] for k in keys]


def laid_flat(surface: Surface, member: Indices) -> Flat:
    """Parameterise one piece, given by its faces (m,)."""
    label = np.zeros(len(surface.area), np.int64)
    label[member] = 1
    wanted = np.array([False, True])
    return _on_true_surface(surface, parameterised(surface.smooth, surface.faces, surface.pairs, label, wanted)[0])


def _on_true_surface(surface: Surface, flat: Flat) -> Flat:
    """The last ARAP steps, on the true surface; dropped if they make the chart overlap itself."""
    if not len(flat.uv):
        return flat
    faces = flat.faces.astype(np.int64)
    uv = unfolded(faces, rigid(surface.true[flat.vertex], faces, flat.uv, TRUE_STEPS))
    for choice in (uv, flat.uv):
        if bool((signed_areas(choice, faces) > 0).all()) and not lies_over_itself(choice, flat.faces):
            return replace(flat, uv=choice, good=True)
    return replace(flat, good=False)


def lies_over_itself(uv: F64, faces: Faces) -> bool:
    """Whether a chart overlaps itself: any of CHECK x CHECK texels is under two faces. uv (n, 2), faces (m, 3)."""
    low = uv.min(0)
    square = ((uv - low) / max(float((uv.max(0) - low).max()), 1e-30)).astype(np.float32)
    return bool((raster.layers(raster.texel_corners(Charts(square, faces), CHECK), CHECK) > 1).any())


def _must_part(surface: Surface, flats: list[Flat]) -> int | None:
    """A piece that is not a disc or has mirrored faces, else one that is stretched, else a large one that fills too
    little of its rectangle."""
    for i, flat in enumerate(flats):
        if not flat.good:
            return i
    total = surface.area.sum()
    if len(flats) < MAX_CHARTS // 2:  # noise stays stretched in any piece
        far = [_stretched(surface, flat) for flat in flats]
        if max(far) > MOST_STRETCHED * total:
            return int(np.argmax(far))
    for i, flat in enumerate(flats):
        if surface.area[flat.member].sum() > LARGE * total and _fill(flat) < FULL and not _front(surface, flat) > 0.5:
            return i
    return None


def _stretched(surface: Surface, flat: Flat) -> float:
    """Area of a good chart's faces that are stretched by more than STRETCHED."""
    if not surface.area[flat.member].sum() > 0:
        return 0.0
    _, most, area = stretches(surface.true[surface.faces[flat.member]], flat.uv[flat.faces])
    return float(area[most > STRETCHED].sum())


def _fill(flat: Flat) -> float:
    """Share of its smallest bounding rectangle that a chart covers."""
    width, height = np.ptp(boxed(flat.uv), axis=0)
    return float(signed_areas(flat.uv, flat.faces.astype(np.int64)).sum() / max(width * height, 1e-30))


def _front(surface: Surface, flat: Flat) -> float:
    """Mean seam cost over a chart, from 0 at the back to 1 in front."""
    w = surface.weight[surface.faces[flat.member]].mean(1)
    a = surface.area[flat.member]
    return float((a * (w - 1)).sum() / (a.sum() * max(float(surface.weight.max()) - 1, 1e-30)))


def _worth_parting(surface: Surface, flats: list[Flat]) -> int:
    """The chart that leaves most of its rectangle empty; charts in front come last."""
    loss = [(1 - _fill(f)) * surface.area[f.member].sum() * (1 - _front(surface, f)) if f.good else 0.0 for f in flats]
    return int(np.argmax(loss))


def _parted(surface: Surface, label: Indices, flat: Flat) -> Indices:
    """Split one piece in two, across its longest direction (in the chart if there is one, else in space)."""
    corners = flat.uv[flat.faces] if flat.good else surface.smooth[surface.faces[flat.member]]
    centre = corners.mean(1) - corners.mean((0, 1))
    along = centre @ np.linalg.svd(centre, full_matrices=False)[2][0]
    place = np.zeros(len(label))
    place[flat.member] = along
    parted = halved(place, label, int(label[flat.member[0]]), surface.area, surface.pairs)
    return connected(parted, surface.pairs)


def _packed(surface: Surface, flats: list[Flat], padding: float, least: float) -> Charts | None:
    """Pack all charts into one square at one scale; None if less than `least` of it would be under charts."""
    uvs, faces, label = together(surface, flats)
    placed: F32 | None = pack(uvs, faces, label, padding, least)
    return None if placed is None else Charts(placed, faces)


def together(surface: Surface, flats: list[Flat]) -> tuple[F64, Faces, Indices]:
    """All charts in one array: texture vertices (U, 2) at the scale of the true surface, the face's enlarged; faces
    (F, 3); the chart (F,) of each face."""
    faces = np.zeros((len(surface.faces), 3), np.int32)
    label = np.zeros(len(surface.faces), np.int64)
    parts, first = [], 0
    for i, flat in enumerate(flats):
        parts.append(_at_scale(surface, flat))
        faces[flat.member], label[flat.member] = flat.faces + first, i
        first += len(flat.uv)
    uvs = np.concatenate(parts)
    if surface.front is None:
        return uvs, faces, label
    return enlarged(uvs, faces, label, surface.front, meshes.areas(surface.true, surface.faces)), faces, label


def _at_scale(surface: Surface, flat: Flat) -> F64:
    """A chart's texture vertices, scaled so that its area is that of the true surface."""
    own = signed_areas(flat.uv, flat.faces.astype(np.int64)).sum()
    area = meshes.areas(surface.true, surface.faces[flat.member]).sum()
    return np.asarray(flat.uv * np.sqrt(area / max(own, 1e-30)), np.float64)


def _share(charts: Charts) -> float:
    """Share of the square under charts."""
    return float(signed_areas(charts.uvs.astype(np.float64), charts.faces.astype(np.int64)).sum())
