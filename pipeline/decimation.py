"""Quadric decimation of a mesh (fast-simplification, MIT), and the parts of the result.

A crowded edge has more than two faces. An edge collapse can pinch off a bubble, a small closed part that is joined to
the rest at crowded edges alone.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline import meshes
from pipeline.meshes import F64, Faces, Indices

UNIT = 1000.0  # the longest side of the box during decimation: its thresholds are absolute
AGGRESSIVENESS = 7.0  # the package's own


def unit_box(vertices: npt.NDArray[np.floating]) -> tuple[F64, float, F64]:
    """Points (V, 3) = (vertices - low) scale, whose longest side is `UNIT`; scale; low (3,)."""
    low, high = vertices.min(0).astype(np.float64), vertices.max(0).astype(np.float64)
    scale = UNIT / max(float((high - low).max()), 1e-30)
    return (vertices.astype(np.float64) - low) * scale, scale, low


def simplified(points: F64, faces: Faces, target: int, aggressiveness: float = AGGRESSIVENESS) -> tuple[F64, Faces]:
    """Vertices and faces of about `target` triangles. points (V, 3): in the unit box."""
    import fast_simplification

    v, f = fast_simplification.simplify(points, faces, target_count=target, agg=aggressiveness)
    return np.asarray(v, np.float64), np.asarray(f, np.int32)


def is_crowded(faces: Faces, count: int) -> bool:
    """Whether more than two faces meet at some edge. `count`: vertices."""
    return meshes.paired_edges(faces, count)[2] > 2


def part_of_face(faces: Faces, count: int) -> Indices:
    """(F,) part of each face after a cut along crowded edges: faces are joined where just two share an edge. `count`:
    vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b, _ = meshes.paired_edges(faces, count)
    graph = coo_array((np.ones(len(a), np.int8), (a % len(faces), b % len(faces))), shape=(len(faces), len(faces)))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def largest_part(faces: Faces, count: int) -> Faces:
    """The faces of the part that has most."""
    part = part_of_face(faces, count)
    return np.asarray(faces[part == np.bincount(part).argmax()])


def largest_parts(faces: Faces, count: int) -> Faces:
    """The faces (F', 3) of the largest part of each connected piece. `count`: vertices."""
    part, piece = part_of_face(faces, count), meshes.component_of_face(faces, count)
    size = np.bincount(part)[part]
    order = np.lexsort((part, -size, piece))
    first = order[np.r_[True, piece[order][1:] != piece[order][:-1]]]  # a face of each piece's largest part
    return np.asarray(faces[np.isin(part, part[first])])
