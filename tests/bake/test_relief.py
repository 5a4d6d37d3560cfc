"""Curvature, cavity and thickness against closed forms and quadrature, and at the extremes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import integrate

from pipeline.meshes import F64, Mesh, vertex_normals
from pipeline.visibility import Occluder
from stages.bake import relief
from tests.support.ball_mesh import ball_mesh


def quiet(done: int, total: int) -> None:
    """No progress."""


def grid(point: Callable[[F64, F64], F64], rows: int, columns: int) -> Mesh:
    """A surface over the unit square as a mesh; point(u, v): (N, 3)."""
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows)))
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    vertices = point(u, v).astype(np.float32)
    return Mesh(vertices, vertex_normals(vertices, faces), faces)


def exact(mesh: Mesh) -> F64:
    n = mesh.normals.astype(np.float64)
    return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))


@pytest.mark.parametrize("radius", [0.01, 0.1])
def test_the_curvature_of_a_ball_is_one_over_its_radius(radius: float) -> None:
    mesh, _ = ball_mesh(radius)
    used = np.unique(mesh.faces)  # the poles' rows have vertices without a triangle
    assert np.allclose(relief.mean_curvature(mesh, exact(mesh))[used], 1 / radius, rtol=1e-4)
    inward = Mesh(mesh.vertices, -mesh.normals, mesh.faces[:, ::-1])
    assert np.allclose(relief.mean_curvature(inward, exact(inward))[used], -1 / radius, rtol=1e-4)


def test_the_curvature_of_a_tube_is_half_of_that() -> None:
    def tube(u: F64, v: F64) -> F64:
        return np.stack([0.02 * np.sin(2 * np.pi * u), 0.1 * v, 0.02 * np.cos(2 * np.pi * u)], 1)

    mesh = grid(tube, 20, 100)
    n = mesh.vertices.astype(np.float64) * [1, 0, 1] / 0.02
    assert np.allclose(relief.mean_curvature(mesh, n), 25, rtol=2e-3)


def test_the_curvature_of_a_torus() -> None:
    """Closed form: H = (R + 2 r cos t) / (2 r (R + r cos t)), t the angle around the tube."""
    big, small = 0.06, 0.02

    def torus(u: F64, v: F64) -> F64:
        t, p = 2 * np.pi * v, 2 * np.pi * u
        far = big + small * np.cos(t)
        return np.stack([far * np.cos(p), far * np.sin(p), small * np.sin(t)], 1)

    mesh = grid(torus, 81, 161)
    t, p = (2 * np.pi * x.ravel() for x in np.meshgrid(np.linspace(0, 1, 81), np.linspace(0, 1, 161), indexing="ij"))
    n = np.stack([np.cos(t) * np.cos(p), np.cos(t) * np.sin(p), np.sin(t)], 1)
    expected = (big + 2 * small * np.cos(t)) / (2 * small * (big + small * np.cos(t)))
    assert np.allclose(relief.mean_curvature(mesh, n), expected, atol=0.3)
    assert np.ptp(expected) > 10


@pytest.mark.parametrize("wave", [0.006, 0.02])
def test_the_cavity_of_a_wave_keeps_what_both_smoothings_leave(wave: float) -> None:
    """Closed form: z = a cos(k x) has H = a k^2 / 2 cos(k x); a smoothing keeps (1 + w^2 k^2 / 4)^-2 of it."""
    k, height, length = 2 * np.pi / wave, 1e-5, 0.12

    def corrugated(u: F64, v: F64) -> F64:
        x = length * u
        return np.stack([x, 0.01 * v, height * np.cos(k * x)], 1)

    mesh = grid(corrugated, 9, 481)
    x = mesh.vertices[:, 0].astype(np.float64)
    n = np.stack([height * k * np.sin(k * x), 0 * x, np.ones_like(x)], 1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    made = relief.relief(mesh, n, Occluder(mesh), quiet)
    fine, coarse = ((1 + (w * k) ** 2 / 4) ** -2 for w in (relief.FINE, relief.COARSE))
    h = height * k**2 / 2 * np.cos(k * x)
    inside = (x > 0.04) & (x < 0.08)
    assert np.allclose(made.curvature[inside], (fine * h)[inside], atol=0.02 * np.abs(h).max())
    u = 0.006 * (fine - coarse) * h
    expected = (1 + u / np.sqrt(1 + u * u)) / 2
    assert np.allclose(made.cavity[inside], expected[inside], atol=0.02 * np.ptp(expected))
    assert made.cavity[inside].min() < 0.5 < made.cavity[inside].max()


def test_a_ball_of_any_size_has_no_cavity() -> None:
    for radius in (0.005, 0.1):
        mesh, _ = ball_mesh(radius)
        made = relief.relief(mesh, exact(mesh), Occluder(mesh), quiet)
        assert np.allclose(made.cavity[np.unique(mesh.faces)], 0.5, atol=1e-3)
    deep = relief.cavity(np.array([-1e6, 0.0, 1e6]), np.zeros(3))
    assert np.allclose(deep, [0, 0.5, 1], atol=1e-6)


def test_the_thickness_of_a_ball_is_its_mean_chord() -> None:
    """Quadrature: the chord at angle t from the normal is 2 r cos t, and rays have the density cos t in the cone."""
    mesh, _ = ball_mesh(0.03, 96, 48)
    got = relief.thickness(mesh.vertices.astype(np.float64), exact(mesh), Occluder(mesh), quiet)
    above = integrate.quad(lambda t: 0.06 * np.cos(t) * np.cos(t) * np.sin(t), 0, np.pi / 4)[0]
    below = integrate.quad(lambda t: np.cos(t) * np.sin(t), 0, np.pi / 4)[0]
    middle = np.abs(mesh.vertices[:, 1]) < 0.02
    off = np.abs(got[middle] / (above / below) - 1)
    assert np.quantile(off, 0.98) < 1e-3 and off.max() < 0.03  # a ray that meets the open seam may leave


@pytest.mark.parametrize("depth", [0.02, 0.0005])
def test_the_thickness_of_a_slab(depth: float) -> None:
    """Quadrature: d / cos t over the cone; also of a sheet of half a millimetre, in a box of half a metre."""
    top = grid(lambda u, v: np.stack([u - 0.5, v - 0.5, 0 * u + depth], 1) * [0.5, 0.5, 1], 21, 21)
    bottom = np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]], np.float32) * 0.3
    vertices = np.concatenate([top.vertices, bottom])
    under = len(top.vertices) + np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    faces = np.concatenate([top.faces, under]).astype(np.int32)
    mesh = Mesh(vertices, vertex_normals(vertices, faces), faces)
    got = relief.thickness(top.vertices.astype(np.float64), exact(top), Occluder(mesh), quiet)
    above = integrate.quad(lambda t: depth * np.sin(t), 0, np.pi / 4)[0]
    below = integrate.quad(lambda t: np.cos(t) * np.sin(t), 0, np.pi / 4)[0]
    inner = np.abs(top.vertices[:, :2]).max(1) < 0.2
    assert np.allclose(got[inner], above / below, rtol=2e-3)


def test_an_open_plane_is_flat_and_without_an_end() -> None:
    mesh = grid(lambda u, v: np.stack([0.1 * u, 0.1 * v, 0 * u], 1), 6, 6)
    made = relief.relief(mesh, exact(mesh), Occluder(mesh), quiet)
    assert np.allclose(made.curvature, 0, atol=1e-9) and np.allclose(made.cavity, 0.5)
    assert np.allclose(made.thickness, relief.FAR)


def test_one_triangle_and_one_without_area() -> None:
    vertices = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.3, 0.3, 0.3]], np.float32)
    for faces in ([[0, 1, 2]], [[0, 1, 2], [3, 3, 3]]):
        mesh = Mesh(vertices, np.tile(np.float32([0, 0, 1]), (4, 1)), np.array(faces, np.int32))
        made = relief.relief(mesh, exact(mesh), Occluder(mesh), quiet)
        for values in (made.curvature, made.cavity, made.thickness):
            assert np.isfinite(values).all()
        assert made.curvature[3] == 0 and made.cavity[3] == 0.5
