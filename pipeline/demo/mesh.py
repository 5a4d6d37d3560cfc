"""Triangle meshes of a signed distance, by marching cubes in a narrow shell around its zero level.

Lengths are metres. Vertices are projected onto the zero level, so that the only error of the mesh is the
sag of its flat faces (about step^2 / 8 R for a radius of curvature R).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

F64 = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]

_COARSE = 4  # fine cells along one side of a coarse cell
_LIPSCHITZ = 1.3  # how much steeper than a true distance the field may be


@dataclass(frozen=True, slots=True)
class Mesh:
    """`vertices` (V, 3) metres; `faces` (F, 3), counter-clockwise seen from outside."""

    vertices: F64
    faces: Faces


def mesh_from_distance(
    distance: Callable[[F64], F64],
    distance_and_gradient: Callable[[F64], tuple[F64, F64]],
    bounds: F64,
    step: float,
) -> Mesh:
    """Mesh the zero level inside `bounds` (2, 3) on a grid of spacing `step` metres.

    Only the cells of a coarse grid that can hold the surface are sampled finely; elsewhere the coarse
    value stands in, which keeps the sign and so adds no surface.
    """
    coarse_step = _COARSE * step
    cells = np.ceil((bounds[1] - bounds[0]) / coarse_step).astype(int)
    coarse = distance(_grid(bounds[0], coarse_step, tuple(cells + 1))).reshape(cells + 1)
    near = _near_cells(coarse, coarse_step)
    volume, known = _spread(coarse, near)
    holes = np.argwhere(known)
    volume[tuple(holes.T)] = distance(bounds[0] + holes * step)
    vertices, faces, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
        volume, 0.0, spacing=(step, step, step), mask=known
    )
    points = _project(np.asarray(vertices, dtype=np.float64) + bounds[0], distance_and_gradient, step)
    return _largest(points, _outward(points, np.asarray(faces, dtype=np.int64)))


def _grid(origin: F64, step: float, shape: tuple[int, ...]) -> F64:
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    return np.asarray(origin + index.reshape(-1, 3) * step)


def _near_cells(coarse: F64, coarse_step: float) -> npt.NDArray[np.bool_]:
    """Coarse cells (A, B, C) that the surface can reach, judged from the value at their eight corners."""
    closest = np.full(np.array(coarse.shape) - 1, np.inf)
    for corner in np.ndindex(2, 2, 2):
        window = tuple(slice(c, c + n) for c, n in zip(corner, closest.shape, strict=True))
        closest = np.minimum(closest, np.abs(coarse[window]))
    # A point of the cell lies within half its diagonal of some corner.
    return np.asarray(closest <= _LIPSCHITZ * coarse_step * np.sqrt(3.0) / 2.0)


def _spread(coarse: F64, near: npt.NDArray[np.bool_]) -> tuple[F64, npt.NDArray[np.bool_]]:
    """Fine volume holding coarse values, and the mask of its nodes that belong to near cells."""
    shape = tuple(_COARSE * n + 1 for n in near.shape)
    volume = np.empty(shape)
    rows = [
        np.minimum((np.arange(n) + _COARSE // 2) // _COARSE, m - 1) for n, m in zip(shape, coarse.shape, strict=True)
    ]
    volume[...] = coarse[np.ix_(*rows)]
    known = np.zeros(shape, dtype=bool)
    dense = near.repeat(_COARSE, 0).repeat(_COARSE, 1).repeat(_COARSE, 2)
    for corner in np.ndindex(2, 2, 2):
        window = tuple(slice(c, c + n) for c, n in zip(corner, dense.shape, strict=True))
        known[window] |= dense
    return volume, known


def _project(points: F64, distance_and_gradient: Callable[[F64], tuple[F64, F64]], step: float) -> F64:
    """Two Newton steps onto the zero level, each at most a cell long."""
    for _ in range(2):
        value, gradient = distance_and_gradient(points)
        length2 = np.maximum(np.einsum("ni,ni->n", gradient, gradient), 1e-6)
        points = points - gradient * np.clip(value / length2, -step, step)[:, None]
    return points


def _largest(vertices: F64, faces: Faces) -> Mesh:
    """The component with most vertices: a coarse grid may produce fragments at fine creases."""
    count = len(vertices)
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), dtype=np.int8), edges.T), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    kept = piece == np.argmax(np.bincount(piece))
    renumbered = np.cumsum(kept) - 1
    return Mesh(vertices[kept], renumbered[faces[kept[faces[:, 0]]]])


def _outward(vertices: F64, faces: Faces) -> Faces:
    """Flip all faces if the enclosed volume is negative."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return faces if np.einsum("ni,ni->", a, np.cross(b, c)) > 0.0 else np.ascontiguousarray(faces[:, ::-1])
