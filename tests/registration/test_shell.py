"""The head's outer shell and signed distances to closed meshes, against exact ones."""

import numpy as np
import pytest
import trimesh

from pipeline.meshes import topology, volume
from pipeline.registration.shell import border_loops, contained, outer_shell, shell_distance
from pipeline.template.load import load_template

TEMPLATE = load_template()


def ball(radius: float = 0.1) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=5, radius=radius)


def test_the_shell_is_closed_and_has_a_head_s_volume() -> None:
    shell = outer_shell(TEMPLATE)
    used, faces = np.unique(shell.faces, return_inverse=True)
    found = topology(faces.reshape(-1, 3).astype(np.int32), len(used))
    assert found.watertight and found.euler == 2 and len(shell.loops) == 4
    points = shell.vertices(TEMPLATE.vertices)
    assert volume(points, shell.faces) == pytest.approx(3.8e-3, rel=0.1)  # litres: head and neck of the template
    assert points[shell.loops[0]][:, 1].max() < points[shell.loops[1]][:, 1].min()  # the longest border is the neck's


def test_a_shell_follows_moved_vertices() -> None:
    shell = outer_shell(TEMPLATE)
    moved = shell.vertices(2 * TEMPLATE.vertices + 1)
    np.testing.assert_allclose(moved, 2 * shell.vertices(TEMPLATE.vertices) + 1)


def test_distances_to_a_ball_are_right_near_it_and_bounded_far_away() -> None:
    mesh, cell, shape = ball(), 0.008, (36, 35, 34)
    lo = np.array([-0.14, -0.139, -0.137])
    found = shell_distance(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32), lo, cell, shape)
    node = np.stack(np.meshgrid(*(lo[a] + cell * np.arange(shape[a]) for a in range(3)), indexing="ij"), -1)
    true = np.linalg.norm(node, axis=-1) - 0.1
    near = np.abs(true) < 2 * cell
    assert np.abs(found.values - true)[near].max() < 4e-4
    assert np.abs(found.values - true).max() < 1.2 * cell and ((found.values < 0) == (true < 0))[~near].all()
    middle = np.asarray(mesh.triangles_center)[found.face[near]]
    cosine = (middle * node[near]).sum(1) / np.linalg.norm(middle, axis=1) / np.linalg.norm(node[near], axis=1)
    assert cosine.min() > 0.97  # the triangle named is the one under the node


def test_a_hollow_is_outside() -> None:
    outer, inner = ball(0.1), ball(0.05)
    inner.invert()
    both = trimesh.util.concatenate([outer, inner])
    lo, cell, shape = np.full(3, -0.12), 0.01, (25, 25, 25)
    inside = contained(np.asarray(both.vertices), np.asarray(both.faces, np.int32), lo, cell, shape)
    node = np.stack(np.meshgrid(*(lo[a] + cell * np.arange(25) for a in range(3)), indexing="ij"), -1)
    radius = np.linalg.norm(node, axis=-1)
    clear = (np.abs(radius - 0.1) > 2e-3) & (np.abs(radius - 0.05) > 2e-3)
    assert (inside == ((radius < 0.1) & (radius > 0.05)))[clear].all()


def test_a_grid_that_misses_the_mesh_is_empty() -> None:
    mesh = ball()
    assert not contained(np.asarray(mesh.vertices), np.asarray(mesh.faces), np.full(3, 5.0), 0.1, (3, 3, 3)).any()


def test_border_loops_of_two_quads_and_of_a_closed_box() -> None:
    strip = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    (loop,) = border_loops(strip)
    assert sorted(loop.tolist()) == [0, 1, 2, 3, 4, 5]
    steps = set(zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))
    assert steps == {(0, 1), (1, 2), (2, 5), (5, 4), (4, 3), (3, 0)}
    box = np.array([[0, 1, 2, 3], [7, 6, 5, 4], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]])
    assert border_loops(box) == []
