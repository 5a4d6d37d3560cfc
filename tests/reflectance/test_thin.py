"""Thin sheets at outlines: thickness of a shell, which vertices an outline left behind, and what stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.camera import PinholeCamera
from pipeline.images import write_exr
from pipeline.meshes import Mesh, unique_edges
from stages.reflectance.reshape import moved, neighbour_mean, outline
from stages.reflectance.thin import THICK, THIN, Held, beyond, spread, subject, thickness, thin
from tests.reflectance.test_reshape import TRIED, VIEWS, ball_map, globe, meshed

FRONT = PinholeCamera(
    np.array([[400.0, 0, 64], [0, 400, 64], [0, 0, 1]]),
    np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]]), 128, 128,
)  # fmt: skip


def slab(half: float) -> Mesh:
    """The ball flattened along z: a lens whose middle is 2 half thick."""
    mesh = globe(4)
    return meshed(mesh.vertices.astype(float) * [1, 1, half / 0.1], mesh.faces)


def mean_of(mesh: Mesh) -> object:
    return neighbour_mean(unique_edges(mesh.faces), len(mesh.vertices))


@pytest.mark.parametrize("half", [0.003, 0.02])
def test_the_thickness_in_the_middle_is_that_of_the_lens(half: float) -> None:
    mesh = slab(half)
    middle = np.linalg.norm(mesh.vertices[:, :2], axis=1) < 0.01
    np.testing.assert_allclose(thickness(mesh)[middle], 2 * half, rtol=0.05)
    assert (thin(mesh)[middle] == (2 * half < THIN)).all()
    assert THIN < THICK and not thin(globe(3)).any()


def test_open_surfaces_are_not_thin() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    assert np.isinf(thickness(meshed(vertices, np.array([[0, 1, 2]], np.int32)))).all()


def test_spreading_reaches_a_few_edges_and_no_farther() -> None:
    mesh = globe(4)
    one = np.zeros(len(mesh.vertices))
    one[0] = 1
    found = spread(one, mesh, mean_of(mesh))
    far = np.linalg.norm(mesh.vertices - mesh.vertices[0], axis=1)
    edge = np.median(np.linalg.norm(np.diff(mesh.vertices[unique_edges(mesh.faces)], axis=1)[:, 0], axis=1))
    assert found[far < 1.5 * edge].min() > 0.5 and not found[far > 12 * edge].any()
    assert found.max() <= 1


def test_what_an_outline_left_behind_is_found_where_the_pictures_show_the_subject() -> None:
    """Oracle: the ball shrinks to 9/10; in front of the camera its rim is left behind, its middle is not."""
    mesh = globe(4)
    small = meshed(0.9 * mesh.vertices.astype(float), mesh.faces)
    left = beyond(mesh.vertices.astype(float), FRONT, outline(small, FRONT), np.ones((64, 64), bool))
    away = np.linalg.norm(mesh.vertices[:, :2], axis=1)
    front = np.abs(mesh.vertices[:, 2]) < 0.02  # at the rim distances in the picture are those from the axis
    assert left[front & (away > 0.095)].all() and not left[away < 0.08].any()
    dark = np.ones((64, 64), bool)
    dark[:, :32] = False
    only = beyond(mesh.vertices.astype(float), FRONT, outline(small, FRONT), dark)
    assert only[front & (mesh.vertices[:, 0] > 0.095)].all() and not only[mesh.vertices[:, 0] < -0.01].any()


def test_the_subject_is_what_any_light_shows(tmp_path: Path) -> None:
    """Two lights that light one half each; the border's pixels count as background."""
    paths = {}
    for n, half in enumerate((slice(0, 16), slice(0, 0), slice(0, 0), slice(16, 24))):
        picture = np.full((32, 32, 3), 0.004, np.float32)  # noise is no subject
        picture[8:24, half] = 1
        paths[0, n] = tmp_path / f"{n}.exr"
        write_exr(paths[0, n], picture, half=True)
    found = subject(paths | {(1, 0): tmp_path / "none.exr"}, 0)
    expected = np.zeros((32, 32), bool)
    expected[9:23, :23] = True
    np.testing.assert_array_equal(found, expected)


def test_a_thin_sheet_keeps_its_outline_and_a_thick_body_does_not() -> None:
    """A lens, and maps that say the surface lies 5 mm farther in: its rim recedes unless it is held."""
    maps, mesh = [ball_map(v) for v in VIEWS], slab(0.003)
    shown = [np.ones((64, 64), bool)] * len(VIEWS)
    held = Held(mesh, mean_of(mesh), shown)
    held.grow(VIEWS, [outline(meshed(0.8 * mesh.vertices.astype(float), mesh.faces), v) for v in VIEWS])
    assert held.share.max() > 0.9
    free = Held(mesh, mean_of(mesh), [np.zeros((64, 64), bool)] * len(VIEWS))
    still, other = (moved(mesh, mesh, maps, VIEWS, TRIED, 3, h) for h in (held, free))
    way = [np.linalg.norm(m.vertices - mesh.vertices, axis=1)[held.share > 0.9].max() for m in (still, other)]
    assert way[0] < 1.5e-3 < way[1]
    body = Held(globe(4), mean_of(globe(4)), shown)
    body.grow(VIEWS, [outline(meshed(0.8 * globe(4).vertices.astype(float), globe(4).faces), v) for v in VIEWS])
    assert not body.share.any()
