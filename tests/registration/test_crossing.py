"""Edges that pass through triangles, against the signs of volumes of tetrahedra."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.meshes import F64, Mask, unique_edges
from pipeline.registration.crossing_kernels import crossing


def volume(a: F64, b: F64, c: F64, d: F64) -> float:
    return float(np.linalg.det(np.stack([b - a, c - a, d - a])))


def expected(vertices: F64, faces: np.ndarray, ends: np.ndarray) -> Mask:
    """Every edge with every triangle: its ends lie on different sides, and the triangle's sides all turn the same way
    around it."""
    out = np.zeros(len(ends), bool)
    for k, (i, j) in enumerate(ends):
        for face in faces:
            if {i, j} & set(face):
                continue
            p, q, (a, b, c) = vertices[i], vertices[j], vertices[face]
            if volume(a, b, c, p) * volume(a, b, c, q) >= 0:
                continue
            turns = [volume(p, q, x, y) for x, y in ((a, b), (b, c), (c, a))]
            out[k] |= all(t > 0 for t in turns) or all(t < 0 for t in turns)
    return out


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (1, 1e-6), (2, 1e6)])
def test_the_edges_of_a_heap_of_triangles(seed: int, scale: float) -> None:
    """Triangles of very different sizes, so that they lie in many cells or in one."""
    random = np.random.default_rng(seed)
    size = np.where(random.random(60) < 0.2, 1.0, 0.15)
    corners = random.random((60, 1, 3)) + size[:, None, None] * random.normal(0, 0.5, (60, 3, 3))
    vertices, faces = scale * corners.reshape(-1, 3) + 3 * scale, np.arange(180).reshape(-1, 3)
    ends = unique_edges(faces)
    wanted = expected(vertices / scale, faces, ends)
    found = crossing(vertices, faces, ends)
    assert 10 < wanted.sum() < 160
    assert (found == wanted).mean() > 0.97 and not (found & ~wanted).any()  # hits close to an edge's end do not count


def test_an_edge_through_the_side_of_two_triangles_meets_one() -> None:
    sheet = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, -1], [0.5, 0.5, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    assert crossing(sheet, faces, np.array([[4, 5]])).all()
    assert not crossing(sheet + np.eye(6)[:, 4:5] * [0, 2, 0] + np.eye(6)[:, 5:6] * [0, 2, 0], faces,
                        np.array([[4, 5]])).any()  # fmt: skip


def test_what_is_flat_or_small_or_nothing_crosses_nothing() -> None:
    none = np.zeros((0, 3), np.int64), np.zeros((0, 2), np.int64)
    assert not len(crossing(np.zeros((3, 3)), *none))
    sheet = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 0], [0.4, 0.2, 0], [0.2, 0.2, 0]])
    face = np.array([[0, 1, 2]])
    assert not crossing(sheet, face, np.array([[3, 4], [3, 5]])).any()  # in its plane; without length
    assert not crossing(np.zeros((6, 3)), face, np.array([[3, 4]])).any()
    point = np.array([[0.2, 0.2, 0], [0.2, 0.2, 0], [0.2, 0.2, 0], [0.2, 0.2, -1], [0.2, 0.2, 1]])
    assert not crossing(point, face, np.array([[3, 4]])).any()  # a triangle without area
