"""Rays in several threads have the results of one."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
from support.ball_head import RADIUS, ball_scan

from pipeline import ray_casting
from pipeline.ray_casting import RayCaster, neighbours_first


@pytest.mark.parametrize("count", [0, 1, 7, 1001])
def test_threads_change_no_result(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    mesh, rng = ball_scan(RADIUS, 24), np.random.default_rng(3)
    start = rng.normal(scale=2 * RADIUS, size=(count, 3))
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    one = RayCaster(mesh.vertices, mesh.faces)
    wanted = (*one.hits(start, way), one.first_faces(start, way))
    monkeypatch.setenv("NUMBA_NUM_THREADS", "4")
    monkeypatch.setattr(ray_casting, "SHARE", 16)
    several = RayCaster(mesh.vertices, mesh.faces)
    for found, single in zip((*several.hits(start, way), several.first_faces(start, way)), wanted, strict=True):
        np.testing.assert_array_equal(found, single)
    assert count < 1000 or (wanted[1] >= 0).any() and (wanted[1] < 0).any()


def test_hits_of_a_sphere_are_those_of_its_equation() -> None:
    """Distances along rays towards the middle, of a fine ball: its radius less the facets' sagitta."""
    mesh, rng = ball_scan(RADIUS, 96), np.random.default_rng(4)
    out = rng.normal(size=(500, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    far, face = RayCaster(mesh.vertices, mesh.faces).hits(3 * RADIUS * out, -out)
    assert (face >= 0).all()
    np.testing.assert_allclose(far, 2 * RADIUS, rtol=1e-3)


def test_casters_of_equal_meshes_share_a_scene_and_others_do_not() -> None:
    mesh, turned = ball_scan(RADIUS, 24), np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
    first, again = RayCaster(mesh.vertices, mesh.faces), RayCaster(mesh.vertices.copy(), mesh.faces.copy())
    assert first._scene is again._scene
    for vertices, faces in (
        (mesh.vertices @ turned, mesh.faces),
        (mesh.vertices, mesh.faces[:-1]),
        (mesh.vertices, mesh.faces[::-1]),
        (mesh.vertices, mesh.faces.astype(np.int64)),
    ):
        assert RayCaster(vertices, faces)._scene is not first._scene
    held = weakref.ref(first._scene)
    del first, again
    assert held() is None  # nothing keeps a scene that no caster uses


@pytest.mark.parametrize("count", [0, 1, 700])
def test_neighbours_come_one_after_the_other(count: int) -> None:
    """Every point once; and steps along the order are far shorter than those between points as they come."""
    points = np.random.default_rng(9).normal(size=(count, 3))
    order = neighbours_first(points)
    assert np.array_equal(np.sort(order), np.arange(count))
    if count > 1:
        step, plain = (np.linalg.norm(np.diff(p, axis=0), axis=1).mean() for p in (points[order], points))
        assert step < plain / 3
    assert np.array_equal(neighbours_first(np.zeros((5, 3))), np.arange(5))
