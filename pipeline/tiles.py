"""UDIM tiles: unit squares of texture space side by side, each with its own maps.

Tile t has the coordinates t <= u <= t + 1, 0 <= v <= 1 and the number 1001 + t. All tiles are in one row, so there are
at most ten: 1011 is above 1001. No chart crosses a border. A map with several tiles is NAME.1001.exr, NAME.1002.exr,
..., and NAME.<UDIM>.exr refers to all of them; a map with a single tile is NAME.exr. Tiles may have different sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.meshes import Charts, Indices, Mesh

FIRST, MAX_TILES = 1001, 10
TOKEN = "<UDIM>"


def form(kind: str, tile: int, tiles: int) -> str:
    """End of the name of a tile's file, after "NAME.": "exr" if there is only one tile, else "1001.exr"."""
    return kind if tiles == 1 else f"{FIRST + tile}.{kind}"


def side_by_side(images: Sequence[npt.NDArray[Any]], *, whole: bool = False) -> npt.NDArray[Any]:
    """(H, tiles H, C) the square pictures (h, h, C) of all tiles in their order, smaller ones enlarged to the largest:
    linear between texels. whole: values are codes, each stays as it is."""
    import cv2

    side = max(len(image) for image in images)
    if all(len(image) == side for image in images):
        return images[0] if len(images) == 1 else np.concatenate(images, 1)
    how = cv2.INTER_NEAREST if whole else cv2.INTER_LINEAR
    same = [cv2.resize(image, (side, side), interpolation=how) if len(image) < side else image for image in images]
    return np.concatenate([image.reshape(side, side, -1) for image in same], 1)


def of_face(charts: Charts) -> Indices:
    """(F,) tile of each face, by the mean of its corners."""
    middle = charts.uvs.astype(np.float64)[charts.faces][..., 0].mean(1)
    return np.asarray(np.floor(middle).clip(0), np.int64)


def count(charts: Charts) -> int:
    """Number of tiles, up to the last one with a face."""
    return int(of_face(charts).max()) + 1


def single_tile(mesh: Mesh, charts: Charts, tile: int) -> tuple[Mesh, Charts]:
    """The faces of one tile, their texture coordinates moved to the unit square. Vertices and uvs keep their rows."""
    mine = of_face(charts) == tile
    if tile == 0 and mine.all():
        return mesh, charts
    moved = (charts.uvs - np.array([tile, 0], np.float32)).astype(np.float32)
    return Mesh(mesh.vertices, mesh.normals, mesh.faces[mine]), Charts(moved, charts.faces[mine])
