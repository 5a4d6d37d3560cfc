"""Places the surface of B on that of A, so that maps of different charts can be compared texel by texel.

For each texel of A's charts: the nearest point of B's surface, its texture coordinates, and the signed distance.

    B in A's frame:  the similarity that moves the cameras of common photos onto each other [Umeyama 1991]; the identity
                     where both runs have the same cameras
    nearest point:   of a dense set of texel centres on B's surface, by |p_A - p_B|^2 + NORMAL^2 |n_A - n_B|^2, so that
                     the other side of a lip or a lid is not taken
    distance:        n_B . (p_A - p_B), positive where A lies outside of B
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.transforms import apply, matrix, scale_of, umeyama
from workflows.compare.runs import Side, common_photos

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
GRID = 256  # texels of A's charts along a side of a tile
DENSE = 640  # the same of B, whose points are searched
FAR = 0.006  # metres beyond which the two surfaces are not the same place
NORMAL = 0.003  # metres that two perpendicular normals count as, over sqrt(2)
LEAST_RANK = 1e-4  # of the camera centres: on one line they determine no rotation


@dataclass(frozen=True, slots=True)
class Sheet:
    """Texel centres on a surface. at (N, 3): tile, row, column in the grid; uv (N, 2), u counted on over the tiles;
    points, normals (N, 3) metres."""

    at: npt.NDArray[np.int64]
    uv: F64
    points: F64
    normals: F64
    tiles: int
    size: int


@dataclass(frozen=True, slots=True)
class Matched:
    """A's sheet, and where each of its texels is on B. uv (N, 2) of B; distance (N,) metres of A's scale, NaN where B
    is too far away. same_charts: both have the same texture coordinates. scale: of B's asset over A's, by the cameras;
    off: RMS distance of the cameras after it, metres."""

    sheet: Sheet
    uv: F64
    distance: F64
    same_charts: bool
    scale: float
    off: float


def matched(a: Side, b: Side) -> Matched | str:
    """The match, or why there is none."""
    paths = [s.stored("uv", s.run.manifest("uv").get("mesh")) for s in (a, b)]
    if paths[0] is None or paths[1] is None:
        return "a mesh is not in the store any more, so that maps are shown without differences"
    moved = a_from_b(a, b)
    if isinstance(moved, str):
        return moved
    a_of_b, off = moved
    ours, theirs = sheet(paths[0], GRID), sheet(paths[1], DENSE)
    uv, distance = nearest(ours, theirs, a_of_b)
    same = same_charts(paths[0], paths[1])
    return Matched(ours, ours.uv if same else uv, distance, same, scale_of(a_of_b), off)


def a_from_b(a: Side, b: Side) -> tuple[F64, float] | str:
    """(4, 4) similarity from B's world to A's, and the RMS distance of the cameras after it; or why there is none."""
    if a.key("poses") and a.key("poses") == b.key("poses"):
        return np.eye(4), 0.0
    centres = [_centres(s) for s in (a, b)]
    both = [(x["index"], y["index"]) for x, y in common_photos(a, b)]
    both = [(i, j) for i, j in both if i in centres[0] and j in centres[1]]
    if len(both) < 3:
        return "fewer than three photos have a camera in both, so that the surfaces can't be placed on each other"
    x, y = np.array([centres[1][j] for _, j in both]), np.array([centres[0][i] for i, _ in both])
    spread = np.linalg.svd(x - x.mean(0), compute_uv=False)
    if spread[1] <= LEAST_RANK * spread[0]:
        return "the common photos' cameras stand on one line, so that the surfaces can't be placed on each other"
    moved = umeyama(x, y)
    return moved, float(np.sqrt(((apply(moved, x) - y) ** 2).sum(1).mean()))


def _centres(side: Side) -> dict[int, F64]:
    cameras = side.run.manifest("poses").get("cameras", ())
    return {int(c["index"]): matrix(c["world_from_cam"])[:3, 3] for c in cameras if isinstance(c, dict)}


def sheet(path: Path, size: int) -> Sheet:
    """The texel centres of a mesh's charts, `size` along a side of a tile."""
    from pipeline import meshes, raster, tiles

    mesh, charts = meshes.load(path), meshes.load_charts(path)
    count = tiles.count(charts)
    parts: list[tuple[Any, ...]] = []
    for t in range(count):
        part, flat = tiles.single_tile(mesh, charts, t)
        if not len(part.faces):
            continue
        hits = raster.rasterise(raster.texel_corners(flat, size), size, 0, size, reach=0.5)
        w, corners = hits.weights.astype(np.float64)[..., None], part.faces[hits.face]
        row, column = np.divmod(hits.texel, size)
        uv = (w * flat.uvs.astype(np.float64)[flat.faces[hits.face]]).sum(1) + [t, 0]
        points, normals = ((w * v.astype(np.float64)[corners]).sum(1) for v in (part.vertices, part.normals))
        parts.append((np.stack([np.full(len(row), t), row, column], 1), uv, points, meshes.unit(normals)))
    at, uv, points, normals = (np.concatenate(x) for x in zip(*parts, strict=True))
    return Sheet(at, uv, points, normals, count, size)


def nearest(ours: Sheet, theirs: Sheet, a_of_b: F64) -> tuple[F64, F64]:
    """(N, 2) texture coordinates on B of each texel of A, and (N,) signed distance, NaN beyond FAR."""
    from scipy.spatial import cKDTree

    placed = apply(a_of_b, theirs.points)
    normals = theirs.normals @ (a_of_b[:3, :3] / scale_of(a_of_b)).T
    found = cKDTree(np.concatenate([placed, NORMAL * normals], 1))
    _, near = found.query(np.concatenate([ours.points, NORMAL * ours.normals], 1), workers=1)
    away = ours.points - placed[near]
    known = (np.linalg.norm(away, axis=1) < FAR) & ((ours.normals * normals[near]).sum(1) > 0)
    distance = np.einsum("nj,nj->n", normals[near], away)
    return theirs.uv[near], np.where(known, distance, np.nan)


def same_charts(one: Path, two: Path) -> bool:
    """Whether two meshes have the same texture coordinates in the same triangles, as those of one template have."""
    from pipeline import meshes

    x, y = meshes.load_charts(one), meshes.load_charts(two)
    return np.array_equal(x.faces, y.faces) and np.array_equal(x.uvs, y.uvs)


def looked_up(image: F32, uv: F64) -> F32:
    """(N, C) the texels of a map (H, tiles H, C) at texture coordinates."""
    size = image.shape[0]
    column = (uv[:, 0] * size).astype(int).clip(0, image.shape[1] - 1)
    return np.asarray(image[((1 - uv[:, 1]) * size).astype(int).clip(0, size - 1), column], np.float32)


def spread_out(of: Sheet, values: npt.NDArray[Any], empty: float) -> npt.NDArray[Any]:
    """(size, tiles size, C) a picture of values (N, C) in the sheet's charts."""
    out = np.full((of.size, of.tiles * of.size, values.shape[1]), empty, values.dtype)
    out[of.at[:, 1], of.at[:, 0] * of.size + of.at[:, 2]] = values
    return out
