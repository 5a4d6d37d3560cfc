"""UDIM tiles: unit squares of texture space side by side, each with maps of its own.

Tile t holds the coordinates t <= u <= t + 1, 0 <= v <= 1 and is numbered 1001 + t. All tiles lie in one row, so that
there are at most ten: 1011 lies above 1001. No chart reaches across a border. A map of several tiles is NAME.1001.exr,
NAME.1002.exr, ..., and NAME.<UDIM>.exr where all of them are meant; of a single tile it is NAME.exr.
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import Charts, Indices, Mesh

FIRST, MAX_TILES = 1001, 10
TOKEN = "<UDIM>"


def form(kind: str, tile: int, tiles: int) -> str:
    """What follows "NAME." in the name of a tile's file: "exr" where there is one tile only, else "1001.exr"."""
    return kind if tiles == 1 else f"{FIRST + tile}.{kind}"


def of_face(charts: Charts) -> Indices:
    """(F,) the tile of each face, from the middle of its corners."""
    middle = charts.uvs.astype(np.float64)[charts.faces][..., 0].mean(1)
    return np.asarray(np.floor(middle).clip(0), np.int64)


def count(charts: Charts) -> int:
    """How many tiles, from the first to the last one with a face."""
    return int(of_face(charts).max()) + 1


def single_tile(mesh: Mesh, charts: Charts, tile: int) -> tuple[Mesh, Charts]:
    """The faces of one tile, their texture coordinates moved to the unit square. Vertices and uvs keep their rows."""
    mine = of_face(charts) == tile
    if tile == 0 and mine.all():
        return mesh, charts
    moved = (charts.uvs - np.array([tile, 0], np.float32)).astype(np.float32)
    return Mesh(mesh.vertices, mesh.normals, mesh.faces[mine]), Charts(moved, charts.faces[mine])
