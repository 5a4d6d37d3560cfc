"""Hair cut from the dense mesh, and what beside the head is no hair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.ball_head import RADIUS, ball_scan, no_head

from pipeline import meshes
from pipeline.artifacts import FileRef, Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import Mesh
from stages.uv.hair import hair_faces, hair_mesh, hair_vertices
from stages.uv.remainder import OVERLAP, beside_head, left_over


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
    hair = hair_mesh(dense, own)
    assert hair is not None and meshes.topology(hair.faces, len(hair.vertices)).sound
    assert len(hair.faces) == own.sum() and (hair.normals * meshes.unit(hair.vertices)).sum(1).min() > 0.9
    assert left_over(dense, beside(dense), own) is None and left_over(dense, beside(dense)) is not None
    assert hair_mesh(dense, np.zeros(len(dense.faces), bool)) is None


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
