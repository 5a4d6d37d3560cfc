"""The rim of hair and clothes lies beneath the skin."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes
from support.ball_head import RADIUS, ball_scan

from pipeline import meshes
from pipeline.meshes import Mesh
from stages.uv.remainder import AWAY, beside_head, cut_out
from stages.uv.rim import FALL, RIM, SINK, with_rim

CELL = 0.0015


@pytest.fixture(scope="module")
def capped() -> Mesh:
    """A ball with a cap of 12 mm, whose edge stands on the ball like a wall."""
    n = round(0.25 / CELL)
    x, y, z = np.meshgrid(*[CELL * (np.arange(n) - n / 2)] * 3, indexing="ij", sparse=True)
    r = np.sqrt(x * x + y * y + z * z)
    solid = np.minimum(r - RADIUS, np.maximum(r - RADIUS - 0.012, 0.05 - y)).astype(np.float32)
    vertices, faces, normals, _ = marching_cubes(-solid, 0.0)
    vertices = (vertices - n / 2) * CELL
    faces = faces[:, ::-1] if meshes.volume(vertices, faces) < 0 else faces
    return Mesh(vertices.astype(np.float32), normals.astype(np.float32), faces.astype(np.int32))


@pytest.fixture(scope="module")
def skin() -> Mesh:
    return ball_scan(RADIUS, 160)


def height(points: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(points, axis=1) - RADIUS)


def border(mesh: Mesh) -> np.ndarray:
    """Positions of the vertices on open edges."""
    return mesh.vertices[np.unique(meshes.open_edges(mesh.faces, len(mesh.vertices)))].astype(np.float64)


def test_the_border_ends_beneath_the_skin_and_the_part_stays(capped: Mesh, skin: Mesh) -> None:
    beside = beside_head(capped, skin)
    part = beside[capped.faces].any(1)
    before = cut_out(capped, capped.faces[part])
    assert np.median(height(border(before))) > 0.5 * AWAY  # a slit all around
    found = with_rim(capped, part, skin)
    after = cut_out(found.mesh, capped.faces[found.faces])
    ends = height(border(after))
    assert ends.max() < -0.4 * SINK and ends.min() > -2 * SINK
    own = np.unique(capped.faces[part])
    assert np.array_equal(found.mesh.vertices[own], capped.vertices[own]) and found.faces[part].all()
    assert after.faces.shape[0] > before.faces.shape[0]
    assert meshes.topology(after.faces, len(after.vertices)).sound


def test_it_falls_from_the_parts_own_height_to_its_depth(capped: Mesh, skin: Mesh) -> None:
    part = beside_head(capped, skin)[capped.faces].any(1)
    found = with_rim(capped, part, skin)
    own = np.zeros(len(capped.vertices), bool)
    own[capped.faces[part]] = True
    rim = np.flatnonzero((found.mesh.vertices != capped.vertices).any(1))
    assert not own[rim].any()
    r = cKDTree(capped.vertices[own].astype(float)).query(capped.vertices[rim].astype(float))[0]
    assert r.max() <= RIM
    expected = (1 - np.minimum(r / FALL, 1)) * height(capped.vertices[rim]) - np.minimum(r / FALL, 1) * SINK
    assert height(found.mesh.vertices[rim]) == pytest.approx(expected, abs=1e-4)


def test_another_sheet_close_by_is_not_taken(capped: Mesh, skin: Mesh) -> None:
    part = beside_head(capped, skin)[capped.faces].any(1)
    low = border(cut_out(capped, capped.faces[part]))[0] * 0.985
    crumb = ball_scan(0.001, 3, tuple(low))
    count = len(capped.vertices)
    both = Mesh(
        np.concatenate([capped.vertices, crumb.vertices]),
        np.concatenate([capped.normals, crumb.normals]),
        np.concatenate([capped.faces, crumb.faces + count]),
    )
    found = with_rim(both, np.r_[part, np.zeros(len(crumb.faces), bool)], skin)
    assert not found.faces[len(part) :].any() and np.array_equal(found.mesh.vertices[count:], crumb.vertices)


def test_nothing_beside_the_head(capped: Mesh, skin: Mesh) -> None:
    none = np.zeros(len(capped.faces), bool)
    found = with_rim(capped, none, skin)
    assert not found.faces.any() and found.mesh is capped
