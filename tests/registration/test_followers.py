"""Parts that follow the skin, closed lids and the file of a registered head."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.ball_head import RADIUS, ball_quads, ball_scan, ball_template

from pipeline.registration.cage import cage_of
from pipeline.registration.displacement import displacement
from pipeline.registration.followers import behind, followed, rigid_motion, room
from pipeline.registration.head import Head, limit_surface, load_head
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.lids import BLINK, blink, closing, lids_closed, with_lids
from pipeline.registration.quality import distances, face_piercings, quad_quality, seen_share
from pipeline.registration.scan import Scan
from pipeline.registration.subdivision import subdivided
from pipeline.template.load import load_template
from pipeline.template.model import Template

TURN = Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix()
STILL = np.eye(4)


def test_rigid_motion_is_the_one_that_was_made_and_never_a_reflection() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    turn, shift = rigid_motion(points, points @ TURN.T + [1, 2, 3], np.random.default_rng(1).random(20))
    assert np.allclose(turn, TURN) and np.allclose(shift, [1, 2, 3])
    turn, _ = rigid_motion(points, points * [-1, 1, 1], np.ones(20))
    assert np.isclose(np.linalg.det(turn), 1)


def with_eye(template: Template) -> Template:
    """A ball head with a small ball inside as its eye."""
    vertices, quads = ball_quads(3)
    count = len(template.vertices)
    own = np.arange(len(quads)) + len(template.quads)
    return replace(
        template,
        vertices=np.concatenate([template.vertices, 0.02 * vertices + [0, 0, 0.07]]),
        quads=np.concatenate([template.quads, quads + count]),
        parts=dict(template.parts) | {"eye_left": own},
        regions=dict(template.regions) | {"eyes": own},
    )


def test_an_eye_makes_the_motion_of_the_skin_and_keeps_its_shape() -> None:
    template = with_eye(ball_template())
    cage = cage_of(template).of_template
    skin = template.vertices[cage] @ TURN.T + [0.01, 0, 0]
    out = followed(template, template.vertices, cage, skin, np.broadcast_to(TURN, (len(skin), 3, 3)), 1.0)
    assert np.allclose(out, template.vertices @ TURN.T + [0.01, 0, 0])


def test_an_eye_that_is_too_large_becomes_smaller_and_no_other() -> None:
    ball = ball_quads(4)[0]
    assert np.allclose(np.linalg.norm(behind(ball, 0.9 * ball, 0.05), axis=1), 0.85)
    assert np.allclose(behind(ball, 1.5 * ball, 0.05), ball)
    assert np.allclose(np.linalg.norm(behind(ball, 0.1 * ball, 0.05), axis=1), 0.7)  # never less


def test_the_template_s_own_eyes_keep_their_size() -> None:
    """Its lids' inner edges are sunk into the eyes; that is no reason to make these smaller."""
    template = load_template()
    rest = template.vertices
    rows = template.part_vertices("skin")
    turns = np.tile(np.eye(3), (len(rows), 1, 1))
    found = followed(template, rest, rows, rest[rows], turns, 1.0)
    for eye in ("eye_left", "eye_right"):
        own = template.part_vertices(eye)
        size = np.ptp(found[own], axis=0) / np.ptp(rest[own], axis=0)
        assert (size > 0.95).all() and (size <= 1).all()
        assert (room(rest[own], rest[rows]) < 0.9).any()


def test_room_is_the_share_of_a_ball_s_radius() -> None:
    ball = ball_scan(0.012, 8).vertices.astype(np.float64) + [0.0, 0.01, 0.0]
    at = np.array([[0.0, 0.01, 0.018], [0.006, 0.01, 0.0]])
    np.testing.assert_allclose(room(ball, at), [1.5, 0.5], rtol=0.02)
    np.testing.assert_allclose(room(ball, at, 0.006), [1.0, 0.0], atol=0.02)


def test_lids_meet_where_they_are_pulled() -> None:
    template = load_template()
    cage = cage_of(template)
    still = PlacedHead(STILL, np.zeros(0), template.vertices, np.zeros(0), 0.0)
    stencil, where = closing(template, still, cage)
    assert stencil.shape[0] > 40 and np.abs(stencil.sum(1)).max() < 1e-12
    open_, half = (stencil @ with_lids(template, still, b)[cage.of_template] for b in (0.0, 0.4))
    assert (open_[:, 1] > 0).all()  # the upper lid is the upper one
    assert np.linalg.norm(half - where, axis=1).mean() < 0.6 * np.linalg.norm(open_ - where, axis=1).mean()


def test_open_and_closed_eyes_are_told_apart() -> None:
    from pipeline.meshes import Mesh, triangles_of, vertex_normals

    template = load_template()
    cage = cage_of(template)
    still = PlacedHead(STILL, np.zeros(0), template.vertices, np.zeros(0), 0.0)
    skin = template.quads[template.parts["skin"]]
    for strength, closed in ((0.0, False), (0.5, True)):
        vertices = template.vertices + strength * blink(template)
        mesh = Mesh(vertices.astype(np.float32), vertex_normals(vertices, triangles_of(skin)), triangles_of(skin))
        assert lids_closed(template, still, cage, Scan(mesh, np.ones(len(vertices)))) == closed


def test_a_template_without_lids_has_nothing_to_close() -> None:
    ball = ball_template(4)
    still = PlacedHead(STILL, np.zeros(0), ball.vertices, np.zeros(0), 0.0)
    stencil, where = closing(ball, still, cage_of(ball))
    assert stencil.shape[0] == 0 and where.shape == (0, 3)
    scan = Scan(ball_scan(RADIUS, 10), np.ones(602))
    assert not lids_closed(ball, still, cage_of(ball), scan) and BLINK


def ball_head(levels: int = 1) -> Head:
    ball = ball_template(6, scalp=True)
    region = np.zeros(len(ball.quads), np.int64)
    region[ball.regions["scalp"]] = 1
    count = subdivided(ball.quads, len(ball.vertices), levels).stencil.shape[0]
    zero = np.zeros(count, np.float32)
    return Head(ball.vertices, ball.quads, ball.uvs, ball.uv_quads, region, 0 * region, zero, zero + 1, levels)


def test_a_head_s_file_gives_it_back(tmp_path: Path) -> None:
    head = ball_head()
    head.save(tmp_path / "h.npz")
    back = load_head(tmp_path / "h.npz")
    assert back.levels == 1 and all(
        (getattr(back, n) == getattr(head, n)).all() for n in ("vertices", "quads", "uvs", "uv_quads", "seen")
    )


def test_displacement_takes_the_limit_surface_to_the_scan() -> None:
    head = ball_head(2)
    points, normals, quads = head.surface()
    free = np.ones(len(quads), np.bool_)
    scan = Scan(ball_scan(0.1), np.ones(len(ball_scan(0.1).vertices)))
    moved, seen = displacement(points, normals, quads, free, scan, 1.0)
    assert np.allclose(np.linalg.norm(points + moved[:, None] * normals, axis=1), 0.1, atol=8e-5) and (seen == 1).all()
    free[:100] = False
    some, _ = displacement(points, normals, quads, free, scan, 1.0)
    assert not some[quads[:100]].any() and some.any()
    for unseen in (Scan(scan.mesh, 0 * scan.seen), Scan(ball_scan(0.12), scan.seen)):
        assert not displacement(points, normals, quads, np.ones(len(quads), np.bool_), unseen, 1.0)[0].any()


def test_displacement_is_taken_back_where_it_would_cross() -> None:
    """Two sheets, 1 mm apart, that face each other, and a scan that would exchange them."""
    n = 12
    x, z = np.meshgrid(np.linspace(0, 0.02, n), np.linspace(0, 0.02, n), indexing="ij")
    at = np.arange(n * n).reshape(n, n)
    quads = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], -1).reshape(-1, 4)
    low = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], 1)
    both = np.concatenate([low, low + [0, 1e-3, 0]])
    normals = np.repeat([[0.0, 1, 0], [0, -1, 0]], n * n, axis=0)
    faces = np.concatenate([quads, quads[:, ::-1] + n * n])
    from pipeline.meshes import Mesh, triangles_of
    from pipeline.registration.folds import piercing_edges

    wave = 1.2e-3 * (1 + np.sin(400 * x.ravel())) / 2
    target = np.concatenate([low + np.c_[0 * wave, wave, 0 * wave], low + [0, 1.0e-3, 0]])
    mesh = Mesh(target.astype(np.float32), normals.astype(np.float32), triangles_of(faces))
    moved, _ = displacement(both, normals, faces, np.ones(len(faces), np.bool_), Scan(mesh, np.ones(len(both))), 1.0)
    assert np.abs(moved).max() > 2e-4
    assert not len(piercing_edges(both + moved[:, None] * normals, triangles_of(faces)))


def test_figures_of_a_ball_beside_a_ball() -> None:
    head, names = ball_head(2), ("face", "scalp")
    points = limit_surface(head.vertices, head.fine())[0]
    radius = float(np.linalg.norm(points, axis=1).mean())
    mesh = ball_scan(radius + 0.001)
    found = distances(head, names, Scan(mesh, np.ones(len(mesh.vertices))), 1.0)
    assert set(found) == {"face", "scalp", "skin"}
    assert np.isclose(found["skin"].median, 1.0, atol=0.15) and found["skin"].median <= found["skin"].most
    assert np.isclose(found["skin"].displaced_median, 1.0, atol=0.15)  # it has no displacement
    far = ball_scan(radius + 0.006)
    assert "scalp" not in distances(head, names, Scan(far, np.ones(len(far.vertices))), 1.0)  # hair does not count
    assert np.isclose(seen_share(head, names), 1) and face_piercings(head, names) == 0


@pytest.mark.parametrize(("shape", "angle", "aspect"), [([1, 1, 1], 90, 1), ([3, 1, 1], 90, 3)])
def test_quads_have_their_angles(shape: list[float], angle: float, aspect: float) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]) * shape
    found = quad_quality(square, np.array([[0, 1, 2, 3]]))
    assert np.isclose(found.least, angle) and np.isclose(found.largest, angle) and np.isclose(found.aspect, aspect)
    skewed = quad_quality(
        square + [[0, 0, 0], [0, 0, 0], [1 * shape[0], 0, 0], [1 * shape[0], 0, 0]], np.array([[0, 1, 2, 3]])
    )
    assert skewed.least < 60 < 120 < skewed.largest
