"""A few charts of our own (stages.uv.charts), more of them where the surface is rough (stages.uv.rough), and xatlas's
(MIT) where even these do not lie flat.

xatlas too cuts and flattens the mesh with its bumps smoothed away, in the same connectivity: noise in the surface
would otherwise break its charts into hundreds of fragments. Its mirrored charts are turned over.
"""

from __future__ import annotations

import logging

import numpy as np

from pipeline import meshes, tiles
from pipeline.errors import StageError
from pipeline.meshes import F32, F64, Charts, Faces, Indices, Mesh
from stages.uv.charts import unwrapped
from stages.uv.config import Config
from stages.uv.density import Front, enlarged
from stages.uv.pack import pack
from stages.uv.rough import in_pieces, short
from stages.uv.split_overlaps import folded, one_by_one, taken_apart
from stages.uv.tile_count import Tiling, packed

log = logging.getLogger("neuface.uv")
UNIT = 1000.0  # longest side during the cut: xatlas has absolute thresholds of about 1e-7 for areas
SMOOTH_SHARE = 0.02  # of the box's longest side: how far the smoothing reaches
PACK_MARGIN = 2.0  # xatlas overshoots the asked resolution by up to this; the padding is asked larger by it
COARSER = 1.05  # of the texel that is wished for: a few per cent are not worth a further tile
UNFOLDINGS = 6  # rounds in which what folds is taken apart; in the latter half face by face, which ends it
FOLD_RASTER = 2048  # texels along a side on which folds are looked for
WORTH_TEXELS = 1e-3  # of the surface without texels: with less, the charts stay as they are
ITERATIONS = 1  # rounds in which xatlas grows charts from better seeds: more are slow
MANY_CHARTS = 150  # from here on xatlas packs: our own packer takes time for each chart


def unwrap(mesh: Mesh, config: Config, front: Front | None = None, texel: float | None = None) -> Charts:
    """Charts over the mesh, none mirrored, packed into [0, 1]^2 with padding, or into tiles (pipeline.tiles).

    A mesh that takes MANY_CHARTS or more stays in one tile. front: the face, whose charts are larger. texel: mean edge
    on the surface, in the mesh's unit, that texels should not exceed but for COARSER, config.tile_size of them along a
    tile's side; no more tiles are filled than that takes. None: config.tiles are filled.

    Raises:
        StageError: xatlas gives up, or leaves faces without a chart.
    """
    span = float(np.ptp(mesh.vertices, axis=0).max())
    points = smoothed(mesh.vertices.astype(np.float64) * (UNIT / span), mesh.faces, SMOOTH_SHARE * UNIT)
    scaled = Mesh((mesh.vertices.astype(np.float64) * (UNIT / span)).astype(np.float32), mesh.normals, mesh.faces)
    padding = config.padding / config.texture_size
    tiling = Tiling(most_tiles(config, texel), None if texel is None else 1 / (COARSER * texel * config.tile_size))
    own = unwrapped(scaled, points, padding, tiling.in_units_of(span / UNIT), front)
    if own is not None:
        return _with_texels(own, mesh, config, tiling, front)
    log.info("uv: a few discs do not lie flat; cutting further")
    found = in_pieces(scaled, points)
    if found is not None:
        uvs, faces, _ = found
        even = evened(uvs, faces, meshes.areas(mesh.vertices, mesh.faces))
    else:
        log.info("uv: too many pieces do not lie flat; xatlas takes over")
        even, faces = _flat(*_cut(points, mesh.faces, config), mesh, config)
    return _with_texels(_placed(even, faces, mesh, config, tiling, front), mesh, config, tiling, front)


def most_tiles(config: Config, texel: float | None) -> int:
    """How many tiles may be filled. texel: the largest that is wished for; auto without one knows no need of more."""
    if config.tiles == "auto":
        return 1 if texel is None else tiles.MAX_TILES
    return config.tiles


def _placed(even: F64, faces: Faces, mesh: Mesh, config: Config, tiling: Tiling, front: Front | None = None) -> Charts:
    """Charts of one scale, but for the face's, in one square, or in tiles where that is asked for and they are not too
    many."""
    padding, label = config.padding / config.texture_size, chart_of_face(faces, len(even))
    if front is not None:
        even = enlarged(even, faces, label, front, meshes.areas(mesh.vertices, mesh.faces))
    if label.max() < MANY_CHARTS:
        placed = pack(even, faces, label, padding)
        total = float(np.abs(signed_areas(even, faces)).sum())
        share = 0.0 if placed is None else float(np.abs(signed_areas(placed.astype(np.float64), faces)).sum())
        if not tiling.content_with(share, total):
            placed = packed(even, faces, label, total, padding, tiling)
        if placed is not None:
            return Charts(placed, faces)
    return _packed(spread(even, faces), faces, config)


def _with_texels(charts: Charts, mesh: Mesh, config: Config, tiling: Tiling, front: Front | None = None) -> Charts:
    """The charts, those faces laid flat by themselves that have next to no texels, if they are worth it."""
    areas = meshes.areas(mesh.vertices, mesh.faces)
    out = short(mesh, charts)
    if areas[out].sum() <= WORTH_TEXELS * areas.sum():
        return charts
    log.info("uv: %d faces have no texels and are laid flat by themselves", int(out.sum()))
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    uvs, faces = one_by_one(charts.uvs.astype(np.float64), charts.faces, out, corners)
    return _placed(evened(uvs, faces, areas), faces, mesh, config, tiling, front)


def _flat(uvs: F64, faces: Faces, mesh: Mesh, config: Config) -> tuple[F64, Faces]:
    """Charts of one scale, turned the right way, none of which folds over itself (stages.uv.split_overlaps)."""
    areas, corners = meshes.areas(mesh.vertices, mesh.faces), mesh.vertices.astype(np.float64)[mesh.faces]
    uvs = evened(turned_over(uvs, faces), faces, areas)
    for turn in range(UNFOLDINGS):
        out = folded(_packed(spread(uvs, faces), faces, config), FOLD_RASTER)
        if not out.any():
            break
        log.info("uv: %d faces lie on others", int(out.sum()))
        in_pieces = turn < UNFOLDINGS // 2
        uvs, faces = taken_apart(uvs, faces, out) if in_pieces else one_by_one(uvs, faces, out, corners)
        uvs = evened(turned_over(uvs, faces), faces, areas)
    return uvs, faces


def smoothed(vertices: F64, faces: Faces, length: float) -> F64:
    """Uniform Laplacian smoothing that diffuses over about `length` (same unit as the vertices)."""
    from scipy.sparse import coo_array, diags_array

    e = meshes.edges(faces)
    adjacent = coo_array((np.ones(len(e)), (e[:, 0], e[:, 1])), shape=(len(vertices), len(vertices))).tocsr()
    mean = diags_array(1 / np.maximum(adjacent.sum(1), 1)) @ adjacent
    edge = float(np.median(meshes.edge_lengths(vertices, faces)))
    v = vertices
    for _ in range(int(np.ceil((length / edge) ** 2))):  # a random walk of n steps goes sqrt(n) edges far
        v = 0.5 * (v + mean @ v)
    return v


def _cut(points: F64, triangles: Faces, config: Config) -> tuple[F64, Faces]:
    """uvs (U, 2) in a common scale, one vertex for each place in each chart, and faces (F, 3)."""
    import xatlas

    atlas = xatlas.Atlas()
    charts, quick = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_cost, charts.max_iterations = config.max_cost, ITERATIONS
    quick.resolution, quick.padding, quick.bilinear = 256, 0, False  # thrown away: the charts are packed again
    normals = meshes.vertex_normals(points, triangles)
    try:
        atlas.add_mesh(points.astype(np.float32), triangles.astype(np.uint32), normals)
        atlas.generate(charts, quick)
        _, faces, uvs = atlas[0]
    except (RuntimeError, ValueError, IndexError) as e:
        raise _failed(str(e)) from e
    texels: F64 = np.asarray(uvs, np.float64) * np.array([atlas.width, atlas.height], np.float64)
    return texels, _whole(faces, len(triangles))


def _whole(faces: object, expected: int) -> Faces:
    out = np.asarray(faces, np.int64).reshape(-1, 3).astype(np.int32)
    if len(out) != expected:
        raise _failed(f"{len(out)} of {expected} faces came back")
    return out


def _failed(reason: str) -> StageError:
    return StageError(
        "the mesh can't be unwrapped",
        where="uv",
        value=reason,
        limit="a chart for every face",
        remedy="change uv.target_faces or uv.max_cost a little",
    )


def chart_of_face(faces: Faces, count: int) -> Indices:
    """(F,) chart of each face, numbered from 0; charts are what hangs together in texture space."""
    label = meshes.component_of_face(faces, count)
    return np.asarray(np.unique(label, return_inverse=True)[1].reshape(-1), np.int64)


def signed_areas(uvs: F64, faces: Faces) -> F64:
    """(F,) signed areas, positive counter-clockwise (u right, v up)."""
    a, b, c = uvs[faces].transpose(1, 0, 2)
    out: F64 = 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    return out


def turned_over(uvs: F64, faces: Faces) -> F64:
    """Charts with negative area mirrored in u. Charts may overlap afterwards."""
    chart = chart_of_face(faces, len(uvs))
    mirrored = np.bincount(chart, signed_areas(uvs, faces)) < 0
    flip = np.zeros(len(uvs), np.bool_)
    flip[faces[mirrored[chart]].ravel()] = True
    return np.where(flip[:, None], uvs * [-1, 1], uvs)


def evened(uvs: F64, faces: Faces, areas: F64) -> F64:
    """Every chart at the same scale against the true surface (smoothing had shrunk the bumpy ones)."""
    chart = chart_of_face(faces, len(uvs))
    flat, true = np.bincount(chart, np.abs(signed_areas(uvs, faces))), np.bincount(chart, areas)
    scale = np.sqrt(true / np.maximum(flat, 1e-9 * flat.sum()))
    of_vertex = np.ones(len(uvs))
    of_vertex[faces.ravel()] = np.repeat(scale[chart], 3)
    return np.asarray(uvs * of_vertex[:, None], np.float64)


def spread(uvs: F64, faces: Faces) -> F64:
    """Charts side by side, so that none touches another before they are packed."""
    chart = chart_of_face(faces, len(uvs))
    of_vertex = np.zeros(len(uvs), np.int64)
    of_vertex[faces.ravel()] = np.repeat(chart, 3)
    count = int(chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, of_vertex, uvs)
    np.maximum.at(high, of_vertex, uvs)
    width = high[:, 0] - low[:, 0]
    gap = float(width.max())
    start = np.concatenate([[0.0], np.cumsum(width + 0.01 * gap)[:-1]])
    return np.asarray(uvs - low[of_vertex] + np.stack([start[of_vertex], np.zeros(len(uvs))], 1), np.float64)


def _packed(uvs: F64, faces: Faces, config: Config) -> Charts:
    """The charts in one square as xatlas places them: quick for hundreds of fragments, but not tight.

    xatlas leaves faces out that are smaller than 1e-7 in the given unit, and puts them anywhere: on a surface in metres
    a tenth of a square millimetre. So the charts are given to it larger.
    """
    import xatlas

    uvs = uvs * (UNIT * np.sqrt(len(faces) / max(float(np.abs(signed_areas(uvs, faces)).sum()), 1e-30)))

    atlas = xatlas.Atlas()
    settings = xatlas.PackOptions()
    settings.resolution = config.texture_size
    settings.padding = int(np.ceil(config.padding * PACK_MARGIN))
    settings.bilinear, settings.bruteForce = True, False
    settings.rotate_charts = False  # xatlas turns a chart by swapping its axes, which mirrors it
    try:
        atlas.add_uv_mesh(uvs.astype(np.float32), faces.astype(np.uint32))
        atlas.generate(xatlas.ChartOptions(), settings)
        _, packed_faces, packed = atlas[0]
    except (RuntimeError, ValueError, IndexError) as e:
        raise _failed(str(e)) from e
    whole = _whole(packed_faces, len(faces))
    square: F32 = (packed * np.array([atlas.width, atlas.height]) / max(atlas.width, atlas.height)).astype(np.float32)
    if np.median(signed_areas(square.astype(np.float64), whole)) < 0:
        square[:, 1] = square[:, 1].max() - square[:, 1] + square[:, 1].min()
    return Charts(square.clip(0, 1), whole)
