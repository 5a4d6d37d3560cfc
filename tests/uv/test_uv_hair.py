"""Hair cut from the dense mesh, and what beside the head is no hair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.ball_head import RADIUS, ball_scan, no_head

from pipeline import meshes
from pipeline.artifacts import FileRef, Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import Charts, Mesh, joined
from stages.uv.decimate import decimated
from stages.uv.hair import NEAREST, cut_at_zero, hair_faces, hair_vertices, parted
from stages.uv.remainder import OVERLAP, beside_head, cut_out, left_over

NONE = Charts(np.zeros((1, 2), np.float32), np.zeros((0, 3), np.int32))


def scan(thick: float = 0.015) -> tuple[Mesh, np.ndarray]:
    """A head with a cap of hair, and the cap's vertices."""
    ball = ball_scan(RADIUS)
    cap = ball.vertices[:, 1] > 0.05
    return Mesh(
        ball.vertices * np.where(cap, 1 + thick / RADIUS, 1)[:, None].astype(np.float32), ball.normals, ball.faces
    ), cap


def beside(dense: Mesh) -> np.ndarray:
    return beside_head(dense, ball_scan(RADIUS))


def test_the_cap_and_the_skin_at_its_rim_are_cut_out() -> None:
    dense, cap = scan()
    own = hair_faces(dense, cap, beside(dense))
    assert (own == cap[dense.faces].any(1)).all()
    none = np.zeros(len(dense.faces), bool)
    assert not left_over(dense, beside(dense), own).any() and left_over(dense, beside(dense), none).any()
    rest, hair = parted(cut_out(dense, dense.faces[own]), dense, none, own)
    assert rest is None and hair is not None and meshes.topology(hair.faces, len(hair.vertices)).sound
    assert len(hair.faces) == own.sum() and (hair.normals * meshes.unit(hair.vertices)).sum(1).min() > 0.9


def border(mesh: Mesh) -> np.ndarray:
    return np.unique(meshes.open_edges(mesh.faces, len(mesh.vertices)))


def test_hair_and_rest_end_at_the_same_vertices_after_decimation() -> None:
    """A ball that is half hair, half cloth, decimated: no slit between the halves."""
    dense = ball_scan(RADIUS, 60)
    hair = dense.vertices[dense.faces].mean(1)[:, 1] > 0.003
    both = decimated(dense, 3000)
    rest, locks = parted(both, dense, ~hair, hair)
    assert rest is not None and locks is not None
    ends = [np.unique(m.vertices[border(m)], axis=0) for m in (rest, locks)]
    assert len(ends[0]) > 30 and np.array_equal(*ends)
    assert np.abs(ends[0][:, 1] - 0.003).max() < 0.003  # though triangles have edges of 9 mm
    assert locks.vertices[:, 1].min() > -0.001 and rest.vertices[:, 1].max() < 0.007
    areas = [float(meshes.areas(m.vertices, m.faces).sum()) for m in (both, rest, locks)]
    assert areas[0] == pytest.approx(areas[1] + areas[2], rel=1e-6)
    for part in (rest, locks):
        assert meshes.topology(part.faces, len(part.vertices)).sound
        assert (meshes.area_vectors(part.vertices, part.faces) * part.vertices[part.faces[:, 0]]).sum(1).min() > 0
    assert parted(both, dense, hair | ~hair, hair & ~hair) == (both, None)
    assert parted(both, dense, hair & ~hair, hair | ~hair) == (None, both)


def test_a_triangle_is_cut_where_the_value_is_zero() -> None:
    """By hand: the corner of the value 1 is cut off at a half and at a quarter of its edges."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    triangle = Mesh(corners, np.tile(np.float32([0, 0, 1]), (3, 1)), np.array([[0, 1, 2]], np.int32))
    for sign in (1.0, -1.0):
        found, positive = cut_at_zero(triangle, sign * np.array([1.0, -1.0, -3.0]))
        np.testing.assert_allclose(found.vertices[3:], [[0.5, 0, 0], [0, 0.25, 0]])
        area = meshes.area_vectors(found.vertices, found.faces)[:, 2]
        assert area[positive == (sign > 0)] == pytest.approx(0.5 * 0.125) and area.sum() == pytest.approx(0.5)
        assert (area > 0).all() and len(area) == 3
    near = cut_at_zero(triangle, np.array([1e-9, -1.0, -1.0]))[0]
    np.testing.assert_allclose(near.vertices[3:], [[NEAREST, 0, 0], [0, NEAREST, 0]])
    whole, positive = cut_at_zero(triangle, np.ones(3))
    assert np.array_equal(whole.faces, triangle.faces) and positive.all()


def test_crumbs_beyond_the_border_change_sides_and_loose_pieces_do_not() -> None:
    dense = ball_scan(RADIUS, 60)
    centre = dense.vertices[dense.faces].mean(1)
    hair = centre[:, 1] > 0.003
    speck = np.argsort(np.linalg.norm(centre - [0, -RADIUS, 0], axis=1))[:4]
    hair[speck] = True  # told wrongly, amid the cloth
    hair[np.argsort(np.linalg.norm(centre - [0, RADIUS, 0], axis=1))[:4]] = False
    rest, locks = parted(dense, dense, ~hair, hair)
    assert rest is not None and locks is not None
    assert locks.vertices[:, 1].min() > -0.01 and rest.vertices[:, 1].max() < 0.016
    small = ball_scan(0.002, 1, (0, -0.15, 0))  # twelve faces would be enough; its eight touch nothing
    small = Mesh(small.vertices, small.normals, small.faces[:8])
    alone, _ = joined([(dense, NONE), (small, NONE)])
    told = np.concatenate([hair, np.ones(8, bool)])
    locks = parted(alone, alone, ~told, told)[1]
    assert locks is not None and locks.vertices[:, 1].min() < -0.14


def test_a_small_piece_that_touches_hair_belongs_to_it() -> None:
    """Some of the cap was not told; far away a knob of the same size stays what it is."""
    dense, cap = scan()
    hole = cap & (np.linalg.norm(dense.vertices - [0, 0.115, 0], axis=1) < 0.012)
    knob = np.linalg.norm(dense.vertices - [0, -RADIUS, 0], axis=1) < 0.008
    moved = dense.vertices * np.where(knob, 1.1, 1)[:, None].astype(np.float32)
    dense = Mesh(moved, dense.normals, dense.faces)
    assert hole.sum() > 3 and knob.sum() > 3
    own = hair_faces(dense, cap & ~hole, beside(dense))
    assert own[hole[dense.faces].any(1)].all() and not own[knob[dense.faces].any(1)].any()


def test_the_told_hair_must_be_that_of_the_surface(tmp_path: Path) -> None:
    assert hair_vertices(no_head(tmp_path), 10) is None
    np.savez(tmp_path / "hair.npz", hair=np.arange(10) > 6)
    head = Located(RegisteredHead(registered=True, hair=FileRef.of(tmp_path, "hair.npz")), tmp_path)
    assert hair_vertices(head, 10).tolist() == (np.arange(10) > 6).tolist()  # type: ignore[union-attr]
    with pytest.raises(ValueError, match="10 vertices.*12"):
        hair_vertices(head, 12)


def test_around_an_ear_only_hair_is_left_over() -> None:
    """A web behind an ear and a knob far from it: the web goes, hair there and the knob stay."""
    ball = ball_scan(RADIUS)
    at = ball.vertices / RADIUS
    web, knob = at[:, 0] > 0.95, at[:, 2] < -0.95
    dense = Mesh(ball.vertices * np.where(web | knob, 1.1, 1)[:, None].astype(np.float32), ball.normals, ball.faces)
    ears = ball.vertices[at[:, 0] > 0.9]
    told = web & (at[:, 1] > 0)
    plain = beside_head(dense, ball)
    assert plain[web].all() and plain[knob].all()
    left = beside_head(dense, ball, ears, told)
    assert not left[web & ~told].any() and left[told].all() and left[knob].all()
    assert not beside_head(dense, ball, ears)[web].any()


def test_the_scan_overlaps_the_necks_end() -> None:
    """A head that ends at a circle: what lies beneath it is left over, with a rim on the head's own side."""
    dense = ball_scan(RADIUS, 160)  # edges of 1 mm: the border's own neighbourhood is much narrower than OVERLAP
    own = dense.faces[(dense.vertices[dense.faces][:, :, 1] > -0.06).all(1)]
    vertices, faces, rows = meshes.compact(dense.vertices, own)
    head = Mesh(np.asarray(vertices, np.float32), dense.normals[rows], faces)
    beside = beside_head(dense, head)
    high = dense.vertices[:, 1]
    end = head.vertices[:, 1].min()
    assert beside[high <= end].all()
    rim = (high > end) & (high < end + 0.7 * OVERLAP)
    assert rim.any() and beside[rim].all() and not beside[high > end + 2 * OVERLAP].any()
