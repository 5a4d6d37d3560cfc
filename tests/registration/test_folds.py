"""Folds and self-intersections on meshes whose faults are known."""

from __future__ import annotations

import numpy as np
from registration.test_subdivision import grid
from scipy.spatial.transform import Rotation

from pipeline.registration.folds import folded_quads, pierced_quads, piercing_edges
from pipeline.registration.subdivision import limit, subdivided

TRIANGLE = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])


def test_a_turned_and_stretched_sheet_has_no_folds() -> None:
    vertices, quads = grid(3, 3)
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    now = (vertices * [2.0, 0.7, 1.0]) @ turn.T
    assert not folded_quads(vertices, now, np.broadcast_to(turn, (16, 3, 3)), quads).any()


def test_a_vertex_pulled_across_its_quad_folds_the_quads_around_it() -> None:
    vertices, quads = grid(3, 3)
    now = vertices.copy()
    now[5] = [2.5, 2.5, 0]  # from (1, 1): beyond the opposite corner
    bad = folded_quads(vertices, now, np.broadcast_to(np.eye(3), (16, 3, 3)), quads)
    assert bad[(quads == 5).any(1)].any() and not bad[~(quads == 5).any(1)].any()


def test_collapsed_quads_count_as_folded() -> None:
    vertices, quads = grid(2, 2)
    assert folded_quads(vertices, vertices * [1, 1e-3, 1], np.broadcast_to(np.eye(3), (9, 3, 3)), quads).all()


def test_crossing_triangles_are_found_and_others_are_not() -> None:
    needle = np.array([[0.0, 0, -1], [0.1, 0, 1], [-0.1, 0, 1]])
    both = np.concatenate([TRIANGLE, needle])
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    found = {tuple(e) for e in piercing_edges(both, faces)}
    assert found == {(3, 4), (3, 5)}
    assert not len(piercing_edges(np.concatenate([TRIANGLE, needle + [0, 0, 3]]), faces))


def test_neighbours_that_share_corners_do_not_pierce() -> None:
    vertices, quads = grid(4, 4)
    vertices[:, 2] = np.sin(vertices[:, 0])
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)
    assert not len(piercing_edges(vertices, faces))


def test_the_quads_of_the_cage_that_pierce_are_named() -> None:
    """Two parallel sheets; the middle of the lower one is pushed through the upper one."""
    vertices, quads = grid(4, 4)
    count = len(vertices)
    lower = vertices - [0, 0, 0.5]
    lower[12, 2] = 4.0
    both, all_quads = np.concatenate([vertices, lower]), np.concatenate([quads, quads + count])
    level = subdivided(all_quads, 2 * count, 2)
    points = limit(level.quads, level.stencil.shape[0]).point @ (level.stencil @ both)
    hits = pierced_quads(points, level.quads) > 0
    around = (all_quads == count + 12).any(1)
    assert hits[around].any() and not hits[[0, 3, 12, 15]].any()
