"""Unwraps a mesh: a few charts of our own (stages.uv.charts); more charts if the surface is rough (stages.uv.rough);
xatlas (MIT) if that fails too.

xatlas also gets the smoothed mesh, with the same connectivity: noise in the surface would break its charts into
hundreds of fragments. Its mirrored charts are flipped.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from pipeline import meshes, tiles
from pipeline.errors import StageError
from pipeline.meshes import F32, F64, Charts, Faces, Indices, Mesh
from stages.uv.charts import unwrapped
from stages.uv.config import Config
from stages.uv.density import Front, enlarged
from stages.uv.pack import pack
from stages.uv.parameterise import signed_areas
from stages.uv.rough import in_pieces, short
from stages.uv.split_overlaps import folded, one_by_one, taken_apart
from stages.uv.tile_count import Tiling, packed

log = logging.getLogger("neuface.uv")
UNIT = 1000.0  # longest side during the cut: xatlas has absolute thresholds of about 1e-7 for areas
SMOOTH_SHARE = 0.02  # of the box's longest side: reach of the smoothing
PACK_MARGIN = 2.0  # xatlas exceeds the requested resolution by up to this factor, so the padding is multiplied by it
COARSER = 1.05  # of the requested texel: a few per cent do not justify a further tile
UNFOLDINGS = 6  # rounds of splitting overlaps; the second half goes face by face, which always ends
FOLD_RASTER = 2048  # texels along a side of the raster that is tested for overlaps
MIN_WITHOUT_TEXELS = 1e-3  # of the surface without texels: below it the charts stay as they are
ITERATIONS = 1  # rounds in which xatlas grows charts from better seeds: more are slow
MANY_CHARTS = 150  # from this number on xatlas packs: our own packer is slow for many charts


def unwrap(
    mesh: Mesh,
    config: Config,
    front: Front | None = None,
    texel: float | None = None,
    check: Callable[[], None] = lambda: None,
) -> Charts:
    """Charts over the mesh, none mirrored, packed with padding into [0, 1]^2 or into tiles (pipeline.tiles).

    A mesh that needs MANY_CHARTS or more stays in one tile. front: the face, whose charts are larger. texel: largest
    mean edge of a texel on the surface (up to the factor COARSER), in the mesh's unit, with config.tile_size texels
    along a tile's side; only as many tiles are filled as this needs. None: config.tiles are filled. check: called
    between the parts of the work; what it raises ends it.

    Raises:
        StageError: xatlas fails, or leaves faces without a chart.
    """
    span = float(np.ptp(mesh.vertices, axis=0).max())
    points = smoothed(mesh.vertices.astype(np.float64) * (UNIT / span), mesh.faces, SMOOTH_SHARE * UNIT)
    scaled = Mesh((mesh.vertices.astype(np.float64) * (UNIT / span)).astype(np.float32), mesh.normals, mesh.faces)
    padding = config.padding / config.texture_size
    tiling = Tiling(most_tiles(config, texel), None if texel is None else 1 / (COARSER * texel * config.tile_size))
    quads = config.remesh == "quads"
    check()
    own = unwrapped(scaled, points, padding, tiling.in_units_of(span / UNIT), front, quads=quads)
    check()
    if own is not None:
        return _with_texels(own, mesh, config, tiling, front)
    log.info("uv: the mesh can't be cut into a few discs; cutting further")
    found = in_pieces(scaled, points, quads=quads)
    check()
    if found is not None:
        uvs, faces, _ = found
        even = evened(uvs, faces, meshes.areas(mesh.vertices, mesh.faces))
    else:
        log.info("uv: too many pieces are needed; using xatlas")
        even, faces = _flat(*_cut(points, mesh.faces, config), mesh, config)
        check()
    return _with_texels(_placed(even, faces, mesh, config, tiling, front), mesh, config, tiling, front)


def most_tiles(config: Config, texel: float | None) -> int:
    """Largest number of tiles. texel: see `unwrap`; without it, `auto` means one tile."""
    if config.tiles == "auto":
        return 1 if texel is None else tiles.MAX_TILES
    return config.tiles


def _placed(even: F64, faces: Faces, mesh: Mesh, config: Config, tiling: Tiling, front: Front | None = None) -> Charts:
    """Pack charts at one scale (the face's are larger) into one square, or into tiles if requested and the charts are
    not too many."""
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
    """The charts, with faces that have almost no texels as charts of their own, if they have enough area together."""
    areas = meshes.areas(mesh.vertices, mesh.faces)
    out = short(mesh, charts)
    if areas[out].sum() <= MIN_WITHOUT_TEXELS * areas.sum():
        return charts
    log.info("uv: %d faces have no texels and become charts of their own", int(out.sum()))
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    uvs, faces = one_by_one(charts.uvs.astype(np.float64), charts.faces, out, corners)
    return _placed(evened(uvs, faces, areas), faces, mesh, config, tiling, front)


def _flat(uvs: F64, faces: Faces, mesh: Mesh, config: Config) -> tuple[F64, Faces]:
    """Charts at one scale, not mirrored, none of which overlaps itself (stages.uv.split_overlaps)."""
    areas, corners = meshes.areas(mesh.vertices, mesh.faces), mesh.vertices.astype(np.float64)[mesh.faces]
    uvs = evened(turned_over(uvs, faces), faces, areas)
    for turn in range(UNFOLDINGS):
        out = folded(_packed(spread(uvs, faces), faces, config), FOLD_RASTER)
        if not out.any():
            break
        log.info("uv: %d faces overlap others", int(out.sum()))
        in_pieces = turn < UNFOLDINGS // 2
        uvs, faces = taken_apart(uvs, faces, out) if in_pieces else one_by_one(uvs, faces, out, corners)
        uvs = evened(turned_over(uvs, faces), faces, areas)
    return uvs, faces


def smoothed(vertices: F64, faces: Faces, length: float) -> F64:
    """(V, 3) vertices after uniform Laplacian smoothing that reaches about `length` (unit of the vertices)."""
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
    """The charts of xatlas: uvs (U, 2) at a common scale and faces (F, 3)."""
    import xatlas

    atlas = xatlas.Atlas()
    charts, quick = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_cost, charts.max_iterations = config.max_cost, ITERATIONS
    quick.resolution, quick.padding, quick.bilinear = 256, 0, False  # not used: the charts are packed again
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
        raise _failed(f"xatlas returned {len(out)} of {expected} faces")
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
    """(F,) chart of each face (F, 3), numbered from 0: the connected components in texture space. count: vertices."""
    label = meshes.component_of_face(faces, count)
    return np.asarray(np.unique(label, return_inverse=True)[1].reshape(-1), np.int64)


def turned_over(uvs: F64, faces: Faces) -> F64:
    """uvs (U, 2) with the charts of negative area mirrored in u. Charts may overlap afterwards."""
    chart = chart_of_face(faces, len(uvs))
    mirrored = np.bincount(chart, signed_areas(uvs, faces)) < 0
    flip = np.zeros(len(uvs), np.bool_)
    flip[faces[mirrored[chart]].ravel()] = True
    return np.where(flip[:, None], uvs * [-1, 1], uvs)


def evened(uvs: F64, faces: Faces, areas: F64) -> F64:
    """uvs (U, 2) with every chart scaled to its true area (smoothing had shrunk the rough ones). areas (F,)."""
    chart = chart_of_face(faces, len(uvs))
    flat, true = np.bincount(chart, np.abs(signed_areas(uvs, faces))), np.bincount(chart, areas)
    scale = np.sqrt(true / np.maximum(flat, 1e-9 * flat.sum()))
    of_vertex = np.ones(len(uvs))
    of_vertex[faces.ravel()] = np.repeat(scale[chart], 3)
    return np.asarray(uvs * of_vertex[:, None], np.float64)


def spread(uvs: F64, faces: Faces) -> F64:
    """uvs (U, 2) with the charts side by side, so that none touches another before packing."""
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
    """Pack the charts into one square with xatlas: fast for hundreds of charts, but not dense.

    xatlas ignores faces smaller than 1e-7 in the input unit and places them anywhere; on a surface in metres that is a
    tenth of a square millimetre. So the charts are enlarged first.
    """
    import xatlas

    uvs = uvs * (UNIT * np.sqrt(len(faces) / max(float(np.abs(signed_areas(uvs, faces)).sum()), 1e-30)))

    atlas = xatlas.Atlas()
    settings = xatlas.PackOptions()
    settings.resolution = config.texture_size
    settings.padding = int(np.ceil(config.padding * PACK_MARGIN))
    settings.bilinear, settings.bruteForce = True, False
    settings.rotate_charts = False  # xatlas rotates a chart by swapping its axes, which mirrors it
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
