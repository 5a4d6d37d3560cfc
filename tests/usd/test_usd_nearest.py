"""Nearest points on triangles and the map from space to texture, against trimesh and NumPy's pseudoinverse."""

from __future__ import annotations

import numpy as np
import trimesh

from stages.usd.write import mesh


def test_nearest_points_are_those_of_trimesh() -> None:
    """Points over the inside, edges and corners of triangles, among them slivers."""
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(60, 3, 3))
    corners[:10, 2] = corners[:10, 1] + 1e-4 * rng.normal(size=(10, 3))
    points, candidates = 2 * rng.normal(size=(500, 3)), rng.integers(0, 60, (500, 7))
    face, weights = mesh._nearest(points, corners, candidates)
    found = np.linalg.norm((corners[face] * weights[..., None]).sum(1) - points, axis=1)
    each = [trimesh.triangles.closest_point(corners[c], points) for c in candidates.T]
    least = np.min([np.linalg.norm(on - points, axis=1) for on in each], axis=0)
    assert np.abs(found - least).max() < 1e-9
    assert (weights >= 0).all() and np.abs(weights.sum(1) - 1).max() < 1e-12
    assert (candidates == face[:, None]).any(1).all()
    inside, corner = (weights > 0).all(1).mean(), (weights == 1).any(1).mean()
    assert inside > 0.05 and corner > 0.05 and inside + corner < 0.95  # all kinds are in it


def test_triangles_without_area_are_edges_and_points() -> None:
    line = np.array([[[0, 0, 0], [0, 0, 0], [2.0, 0, 0]], [[0, 0, 0], [1.0, 0, 0], [2, 0, 0]], [[1.0, 1, 1]] * 3])
    for k, (nearest, distance) in enumerate([([0.5, 0, 0], 1.0), ([0.5, 0, 0], 1.0), ([1, 1, 1], np.sqrt(1.25))]):
        _, weights = mesh._nearest(np.array([[0.5, 1.0, 0.0]]), line, np.array([[k]]))
        on = weights[0] @ line[k]
        assert np.allclose(on, nearest)
        assert np.isclose(np.linalg.norm(on - [0.5, 1, 0]), distance)


def test_pseudoinverse_is_that_of_numpy() -> None:
    edges = np.random.default_rng(1).normal(size=(200, 2, 3)) * np.geomspace(1e-6, 10, 200)[:, None, None]
    edges[0], edges[1], edges[2, 1], edges[3, 0] = 0, [[1, 2, 3], [2, 4, 6]], 0, -edges[3, 1]
    wanted = np.linalg.pinv(edges, rcond=1e-7)
    assert np.abs(mesh._pseudoinverse(edges) - wanted).max() <= 1e-9 * np.abs(wanted).max()
    shown = np.linalg.norm(mesh._pseudoinverse(edges) - wanted, axis=(1, 2))
    assert (shown <= 1e-9 * np.linalg.norm(wanted, axis=(1, 2)).clip(1e-300)).all()


def test_shared_coordinates_are_those_of_unique_rows() -> None:
    uvs = np.random.default_rng(2).integers(-2, 5, (300, 3, 2)) / 3
    values, index = mesh._shared(uvs)
    wanted, inverse = np.unique(uvs.reshape(-1, 2).astype(np.float32), axis=0, return_inverse=True)
    assert (values == wanted).all() and (index.ravel() == inverse.ravel()).all()
    assert (values[index] == uvs.astype(np.float32)).all()
