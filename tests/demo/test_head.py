"""The sculpture: exact gradients, symmetry, human size, and a closed surface without tunnels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from pipeline.demo import head, shapes
from pipeline.demo.mesh import Mesh, mesh_from_distance

F64 = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return mesh_from_distance(head.signed_distance, head.distance_and_gradient, head.BOUNDS, 0.002)


def points_near(mesh: Mesh, count: int, spread: float) -> F64:
    rng = np.random.default_rng(3)
    chosen = mesh.vertices[rng.integers(0, len(mesh.vertices), count)]
    return np.asarray(chosen + rng.normal(scale=spread, size=chosen.shape))


def test_gradient_is_that_of_finite_differences(mesh: Mesh) -> None:
    points, step = points_near(mesh, 3000, 0.004), 1e-7
    value, gradient = head.distance_and_gradient(points)
    np.testing.assert_array_equal(value, head.signed_distance(points))
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (head.signed_distance(points + shift) - head.signed_distance(points - shift)) / (2 * step)
        # The curvature of the smallest joints (some 0.5 mm) leaves a little even at this step.
        np.testing.assert_allclose(gradient[:, axis], slope, atol=2e-5)


def test_value_does_not_depend_on_its_neighbours(mesh: Mesh) -> None:
    """Features are evaluated only for the points that they touch; that must not show in the values."""
    points = points_near(mesh, 400, 0.01)
    together = head.signed_distance(points)
    alone = np.concatenate([head.signed_distance(p[None]) for p in points[:60]])
    np.testing.assert_allclose(together[:60], alone, atol=1e-15)


def test_skipped_features_would_change_nothing(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    points = points_near(mesh, 12000, 0.01)
    skipping = head.signed_distance(points)
    points, skipping = (x[np.abs(skipping) < 0.008] for x in (points, skipping))
    monkeypatch.setattr(head, "_WIDEST_JOINT", 1e6)
    np.testing.assert_allclose(skipping, head.signed_distance(points), atol=1e-9)


def test_left_is_the_mirror_image_of_right(mesh: Mesh) -> None:
    points = points_near(mesh, 2000, 0.01)
    mirrored = points * np.array([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(head.signed_distance(points), head.signed_distance(mirrored), atol=1e-12)


def test_distance_grows_hardly_faster_than_length(mesh: Mesh) -> None:
    """Ellipsoids are distances to first order only: a few points beside thin ones feel a steeper field."""
    a, b = points_near(mesh, 20000, 0.002), points_near(mesh, 20000, 0.002)[::-1]
    b = a + 0.002 * (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    slope = np.abs(head.signed_distance(a) - head.signed_distance(b)) / 0.002
    assert np.percentile(slope, 99.5) <= 1.2
    assert slope.max() <= 3.0


def test_head_has_human_size_and_faces_plus_z(mesh: Mesh) -> None:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    above_chin = mesh.vertices[mesh.vertices[:, 1] > -0.115]
    skull = above_chin[above_chin[:, 1] > 0.03]
    assert 0.20 < high[1] + 0.112 < 0.25, "vertex to chin"
    assert 0.14 < np.ptp(skull[:, 0]) < 0.165, "breadth of the skull"
    assert 0.18 < np.ptp(skull[:, 2]) < 0.21, "length of the skull"
    assert low[1] == pytest.approx(head.NECK_CUT, abs=1e-4)
    tip = mesh.vertices[np.argmax(mesh.vertices[:, 2])]
    assert abs(tip[0]) < 0.004 and -0.05 < tip[1] < -0.02, "the nose is the foremost point"


def test_surface_is_closed_and_lies_on_the_zero_level(mesh: Mesh) -> None:
    shell = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert shell.is_watertight and shell.volume > 0.003
    assert head.BOUNDS[0].max() < 0 < head.BOUNDS[1].min()
    assert (mesh.vertices > head.BOUNDS[0]).all() and (mesh.vertices < head.BOUNDS[1]).all()
    assert np.percentile(np.abs(head.signed_distance(mesh.vertices)), 99) < 1e-7


@pytest.mark.parametrize(
    "box",
    [[[0.045, -0.07, -0.06], [0.10, 0.03, 0.03]], [[-0.004, -0.12, 0.03], [0.06, 0.06, 0.13]]],
    ids=["ear", "face"],
)
def test_finely_meshed_features_have_no_tunnels(box: list[list[float]]) -> None:
    """A box cuts a disc (Euler number 1) out of the surface; a hole through the ear would lower that by two.

    Two millimetres, the grid of the other tests, is too coarse for the lid's edge to tell.
    """
    patch = mesh_from_distance(head.signed_distance, head.distance_and_gradient, np.array(box), 0.001)
    assert trimesh.Trimesh(patch.vertices, patch.faces, process=False).euler_number == 1


def test_narrow_mesh_is_the_whole_mesh() -> None:
    """Sampling only near the surface must lose none of it: compare with a sphere's known area."""

    def sphere(points: F64) -> F64:
        return np.asarray(np.linalg.norm(points, axis=1) - 0.05)

    def with_gradient(points: F64) -> tuple[F64, F64]:
        return sphere(points), points / np.linalg.norm(points, axis=1, keepdims=True)

    ball = mesh_from_distance(sphere, with_gradient, np.array([[-0.06] * 3, [0.06] * 3]), 0.002)
    solid = trimesh.Trimesh(ball.vertices, ball.faces, process=False)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=2e-3)


def test_wrapped_and_arched_frames_pull_gradients_back() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (3, 200)) + np.array([[0.0], [0.0], [60.0]])

    def distance(p: F64, with_gradient: bool) -> shapes.Distance:
        frame = shapes.arched(shapes.wrapped(shapes.plain(p, with_gradient), 20.0, 38.0), 0.004)
        frame = shapes.turned(shapes.mirrored(frame, 1.0), (1, 2, 3), shapes.rotation(0.3, 0.2, 0.1))
        return shapes.ellipsoid(frame, (5, 0, 1), (9, 4, 5))

    gradient = distance(points, True).gradient
    assert gradient is not None
    for axis in range(3):
        shift = 1e-5 * np.eye(3)[:, axis : axis + 1]
        slope = (distance(points + shift, False).value - distance(points - shift, False).value) / 2e-5
        np.testing.assert_allclose(gradient[axis], slope, atol=1e-6)
