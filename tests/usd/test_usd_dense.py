"""Texture coordinates of the dense mesh, taken from the textured one."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stages.usd.write import mesh as meshes
from stages.usd.write.mesh import UvSurface, half_gap, uv_fault, with_uvs_from

GAP = 0.08
SCALE = 0.2


def grid(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a lattice in z = 0, and its triangles, which look along +z."""
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], -1).reshape(-1, 3)
    a = (np.arange(len(x) - 1)[:, None] * len(y) + np.arange(len(y) - 1)).ravel()
    b = a + len(y)
    return points, np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])


def left(p: np.ndarray) -> np.ndarray:
    """Where x < 0 lies in the texture."""
    return np.array([0.5 - GAP / 2, 0.5]) + SCALE * p[..., :2]


def right(p: np.ndarray) -> np.ndarray:
    """Where x > 0 lies in the texture: upside down, the seam on the gutter's other side."""
    return np.array([0.5 + GAP / 2 + SCALE, 0.5]) - SCALE * p[..., :2]


def surface(points: np.ndarray, faces: np.ndarray, uvs: np.ndarray, uv_faces: np.ndarray) -> UvSurface:
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    return UvSurface(
        points.astype(np.float32), normals, faces.astype(np.int32), uvs.astype(np.float32), uv_faces.astype(np.int32)
    )


def sheet() -> UvSurface:
    """[-1, 1]^2 with a seam along x = 0 and a chart on either side."""
    points, faces = grid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
    over = points[faces].mean(1)[:, 0] > 0
    uvs = np.concatenate([left(points), right(points)])
    return surface(points, faces, uvs, np.where(over[:, None], faces + len(points), faces))


def turned_sheet() -> UvSurface:
    """A finer lattice askew, so that its triangles lie across the seam."""
    points, faces = grid(np.linspace(-0.6, 0.6, 31), np.linspace(-0.6, 0.6, 31))
    points = points @ Rotation.from_euler("z", 0.3).as_matrix().T
    return surface(points, faces, np.zeros((0, 2)), np.zeros((0, 3)))


def test_triangles_on_a_seam_keep_their_area_beyond_the_charts_edge() -> None:
    full, dense = sheet(), turned_sheet()
    made = with_uvs_from(dense, full, 4, half_gap(full))
    corners = dense.vertices[dense.faces].astype(np.float64)
    over = (corners.mean(1)[:, 0] > 0)[:, None, None]
    across = corners[..., 0].min(1) * corners[..., 0].max(1) < 0
    assert across.sum() > 30
    expected = np.where(over, right(corners), left(corners))
    np.testing.assert_allclose(made.uvs[made.uv_faces], expected, atol=2e-6)
    assert uv_fault(made, full) == ""
    drawn = with_uvs_from(dense, full, 4)
    assert np.abs(drawn.uvs[drawn.uv_faces] - expected)[across].max() > 0.003
    assert np.array_equal(made.vertices, dense.vertices) and np.array_equal(made.faces, dense.faces)


def test_corners_never_reach_further_than_asked() -> None:
    full, dense = sheet(), turned_sheet()
    made = with_uvs_from(dense, full, 4, 0.002)
    corners = dense.vertices[dense.faces].astype(np.float64)
    u = made.uvs[made.uv_faces][..., 0]
    over = corners.mean(1)[:, 0] > 0
    beyond = np.where(over[:, None], u - (0.5 + GAP / 2 + SCALE), u - (0.5 - GAP / 2))
    assert beyond.max() < 0.002 + 1e-6 and beyond.max() > 0.0019


def test_half_of_the_gap_between_charts_is_measured() -> None:
    full = sheet()
    one = surface(full.vertices, full.faces, left(full.vertices), full.faces)
    assert GAP / 2 - 2 / 512 < half_gap(full, 512) <= GAP / 2
    assert np.isinf(half_gap(one, 512))


def test_what_stands_on_end_is_laid_flat() -> None:
    """A rim that the textured mesh has cut off: a wall on the sheet, of which projection would leave a line."""
    full = sheet()
    wall, faces = grid(np.linspace(-0.5, -0.46, 3), np.linspace(0, 0.02, 2))
    wall = wall @ Rotation.from_euler("x", 90, degrees=True).as_matrix().T + [0, 0.13, 0]
    dense = surface(wall, faces, np.zeros((0, 2)), np.zeros((0, 3)))
    assert meshes._shares(with_uvs_from(dense, full, 4))[0] == 1
    made = with_uvs_from(dense, full, 4, 0.1)
    t = made.uvs[made.uv_faces].astype(np.float64)
    area = 0.5 * np.abs(np.linalg.det(t[:, 1:] - t[:, :1]))
    np.testing.assert_allclose(area, SCALE**2 * 0.5 * 0.02 * 0.02, rtol=1e-3)
    small = with_uvs_from(dense, full, 4, 0.001)
    t = small.uvs[small.uv_faces].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(t - t.mean(1, keepdims=True), axis=2).max(1), 0.001, rtol=1e-3)


def test_the_smallest_turn() -> None:
    rng = np.random.default_rng(3)
    start, goal, points = rng.normal(size=(40, 3)), rng.normal(size=(40, 3)), rng.normal(size=(40, 5, 3))
    goal[0], goal[1] = 2 * start[0], -start[1]
    got = meshes._turned(points, start, goal)
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (start, goal))
    axis = np.cross(a, b)
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(length, (a * b).sum(1, keepdims=True))
    turn = Rotation.from_rotvec(axis / np.maximum(length, 1e-30) * angle).as_matrix()
    expected = np.einsum("nij,nkj->nki", turn, points)
    keep = np.arange(40) != 1  # opposite directions: any half turn across them
    np.testing.assert_allclose(got[keep], expected[keep], atol=1e-9)
    np.testing.assert_allclose(meshes._turned(start[1:2, None], start[1:2], goal[1:2])[0, 0], goal[1], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(got, axis=2), np.linalg.norm(points, axis=2), atol=1e-9)
