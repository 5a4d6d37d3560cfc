"""Catmull-Clark against known points, and against many levels of itself."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.meshes import unit
from pipeline.registration.subdivision import limit, subdivided

CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def grid(n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of n x m quads, and its quads, counter-clockwise seen from +z."""
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(m + 1.0), indexing="ij")
    at = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1), quads


def fan(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """n quads around vertex 0, with two rings more around them, so that the border is far."""
    k = np.arange(n)
    spokes, corners = 1 + 2 * k, 2 + 2 * k
    quads = [np.stack([np.zeros(n, int), spokes, corners, np.roll(spokes, -1)], 1)]
    inner, size = np.arange(1, 2 * n + 1), 2 * n
    angle = 2 * np.pi * np.arange(size) / size
    vertices = [np.zeros((1, 3)), np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)]
    for ring in range(2, 5):
        outer = inner + size
        quads.append(np.stack([inner, outer, np.roll(outer, -1), np.roll(inner, -1)], 1))
        vertices.append(ring * vertices[1])
        inner = outer
    out = np.concatenate(vertices)
    out[:, 2] = rng.normal(0, 0.3, len(out))
    return out, np.concatenate(quads)


def test_first_step_of_a_cube_has_the_known_points() -> None:
    level = subdivided(CUBE_QUADS, 8, 1)
    found = level.stencil @ CUBE
    assert np.allclose(found[:8], CUBE * 5 / 9)
    edges = found[8:20]
    assert np.allclose(np.sort(np.abs(edges), axis=1), [0, 0.75, 0.75])
    faces = found[20:]
    assert np.allclose(np.sort(np.abs(faces), axis=1), [0, 0, 1])
    assert level.quads.shape == (24, 4)


def test_limit_of_a_cube_has_the_known_corner_and_faces_outward() -> None:
    found = limit(CUBE_QUADS, 8)
    assert np.allclose(found.point @ CUBE, CUBE / 2)  # (9 + 4 - 1) / 24
    assert np.allclose(found.normals(CUBE), unit(CUBE))


@pytest.mark.parametrize("n", [3, 4, 5, 6, 9])
def test_limit_is_what_many_steps_converge_to(n: int) -> None:
    """The oracle is the subdivision itself, seven steps deep."""
    vertices, quads = fan(n, np.random.default_rng(n))
    found = limit(quads, len(vertices))
    ring = np.arange(2 * n + 1)  # the vertex in the middle and the first ring
    at, local, here = vertices, quads, vertices
    for _ in range(7):
        step = subdivided(local, len(here), 1)
        here, local = step.stencil @ here, step.quads
        near = np.isin(local, ring).any(1)  # vertices keep their numbers; only the rings around them are needed
        for _ in range(2):
            near = np.isin(local, local[near]).any(1)
        used, local = np.unique(local[near], return_inverse=True)
        assert (used[: len(ring)] == ring).all()
        here, local = here[used], local.reshape(-1, 4)
    assert np.abs((found.point @ at)[ring] - here[ring]).max() < 1e-3
    centre = here[0]
    touching = local[(local == 0).any(1)]
    corners = here[touching] - centre
    normal = np.cross(corners[:, 1] - corners[:, 3], corners[:, 2] - corners[:, 0])
    assert abs(unit(normal.sum(0)[None])[0] @ found.normals(at)[0]) > 0.9995


def test_a_fine_closed_mesh_converges_to_its_limit_by_a_quarter_a_step() -> None:
    errors = []
    for levels in (1, 2, 3, 4):
        level = subdivided(CUBE_QUADS, 8, levels)
        points = level.stencil @ CUBE
        errors.append(np.linalg.norm(limit(level.quads, len(points)).point @ points - points, axis=1).max())
    ratio = np.array(errors[1:]) / np.array(errors[:-1])
    assert (ratio < 0.35).all() and errors[-1] < 0.02


def test_borders_are_a_spline_or_straight() -> None:
    vertices, quads = grid(2, 2)
    smooth = subdivided(quads, 9, 1).stencil @ vertices
    sharp = subdivided(quads, 9, 1, "sharp").stencil @ vertices
    assert np.allclose(smooth[[0, 2, 6, 8]], vertices[[0, 2, 6, 8]])  # corners stay
    bent = vertices + [[0, 0, float(i == 1)] for i in range(9)]
    assert np.isclose((subdivided(quads, 9, 1).stencil @ bent)[1, 2], 0.75)
    assert np.isclose((subdivided(quads, 9, 1).stencil @ bent)[0, 2], 0.0)
    assert np.isclose((subdivided(quads, 9, 1, "sharp").stencil @ bent)[1, 2], 1.0)
    assert np.allclose(sharp[:9], vertices)
    assert np.isclose((limit(quads, 9).point @ bent)[1, 2], 4 / 6)


def test_normals_of_a_sheet_point_up_everywhere_also_on_its_border() -> None:
    vertices, quads = grid(4, 3)
    assert np.allclose(limit(quads, len(vertices)).normals(vertices), [0, 0, 1])


def test_border_normal_is_that_of_the_spline() -> None:
    """z = x^2 across a border at x = 0: a uniform cubic B-spline of values z_i whose ghost row is 2 z_0 - z_1 has
    the slope z_1 - z_0 at its end."""
    vertices, quads = grid(4, 4)
    vertices[:, 2] = vertices[:, 0] ** 2
    normals = limit(quads, len(vertices)).normals(vertices)
    assert np.allclose(normals[2], unit(np.array([[-1.0, 0, 1]]))[0])


def test_weights_sum_to_one_and_children_stay_with_their_quad() -> None:
    vertices, quads = grid(3, 3)
    level = subdivided(quads, len(vertices), 2)
    assert np.allclose(level.stencil.sum(1), 1)
    assert np.allclose(limit(quads, len(vertices)).point.sum(1), 1)
    fine = (level.stencil @ vertices)[level.quads].mean(1)
    coarse = np.repeat(vertices[quads].mean(1), 16, axis=0)
    assert (np.abs(fine - coarse)[:, :2] < 0.6).all()


def test_no_step_changes_nothing_and_a_crowded_edge_is_refused() -> None:
    level = subdivided(CUBE_QUADS, 8, 0)
    assert (level.quads == CUBE_QUADS).all() and np.allclose(level.stencil @ CUBE, CUBE)
    three = np.array([[0, 1, 2, 3], [1, 0, 4, 5], [0, 1, 6, 7]])
    with pytest.raises(ValueError, match="more than two quads"):
        subdivided(three, 8, 1)


def test_vertices_without_quads_stay() -> None:
    vertices, quads = grid(1, 1)
    vertices = np.concatenate([vertices, [[7.0, 8, 9]]])
    assert np.allclose((subdivided(quads, 5, 1).stencil @ vertices)[4], [7, 8, 9])
    assert np.allclose((limit(quads, 5).point @ vertices)[4], [7, 8, 9])
