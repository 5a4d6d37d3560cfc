"""Pairs with a ball whose surface is known."""

from __future__ import annotations

import numpy as np
from support.ball_head import ball_quads, ball_scan

from pipeline.registration.scan import Scan


def scan(radius: float = 0.1, seen: float = 1.0) -> Scan:
    mesh = ball_scan(radius)
    return Scan(mesh, np.full(len(mesh.vertices), seen))


def test_distance_along_the_normal_is_signed_and_that_of_the_ball() -> None:
    out = ball_quads(3)[0]
    for offset in (-0.004, 0.0, 0.003):
        away, seen = scan().along((0.1 - offset) * out, out, 0.01)
        assert np.allclose(away, offset, atol=6e-5) and np.allclose(seen, 1)


def test_nothing_beyond_the_reach_and_nothing_that_faces_away() -> None:
    out = ball_quads(3)[0]
    away, seen = scan().along(0.08 * out, out, 0.01)
    assert np.isnan(away).all() and not seen.any()
    away, _ = scan().along(0.099 * out, -out, 0.01)
    assert np.isnan(away).all()
    assert not scan().pairs(0.099 * out, -out, 0.01).weight.any()


def test_pairs_have_the_plane_s_distance_and_the_weight_of_what_is_seen() -> None:
    out = ball_quads(3)[0]
    pairs = scan(seen=0.4).pairs(0.102 * out, out, 0.01)
    assert np.allclose(pairs.distance, 0.002, atol=1e-4) and np.allclose(pairs.weight, 0.4)
    assert np.allclose(pairs.normals @ np.eye(3), pairs.where / 0.1, atol=1e-4)
    assert not scan(seen=0.0).pairs(0.102 * out, out, 0.01).weight.any()
    far = scan().pairs(0.15 * out, out, 0.01)
    assert not far.weight.any() and np.isinf(far.distance).all()


def test_nearest_vertex() -> None:
    where, away = scan().nearest(np.array([[0.0, 0.0, 0.2]]))
    assert np.allclose(where, [[0, 0, 0.1]], atol=1e-6) and np.isclose(away[0], 0.1, atol=1e-6)


def test_under_hair_only_what_lies_outside_counts() -> None:
    """A ball whose upper half is hair with the skin 3 mm beneath: a place outside of that is paired with it."""
    ball = ball_scan(0.1)
    hair = ball.vertices[:, 1] > 0
    scan = Scan(ball, (~hair).astype(float), np.where(hair, 0.003, 0.0))
    way = np.array([[0.0, 1, 0], [0, 1, 0], [0, 1, 0], [0, -1, 0]])
    points = way * np.array([[0.101], [0.098], [0.095], [0.095]])
    pairs = scan.pairs(points, way, 0.02)
    np.testing.assert_allclose(pairs.weight, [1, 1, 0, 1])
    np.testing.assert_allclose(np.linalg.norm(pairs.where, axis=1), [0.097, 0.097, 0.097, 0.1], atol=1e-6)
    np.testing.assert_allclose(pairs.distance, [0.004, 0.001, 0.002, 0.005], atol=1e-6)
    assert pairs.hair.tolist() == [True, True, True, False]
    sunk = scan.over(points, way, 0.02)
    np.testing.assert_allclose(sunk, [0.004, 0.001, 0, 0], atol=1e-6)
    assert not Scan(ball, np.ones(len(hair))).over(points, way, 0.02).any()
    assert not scan.over(10 * points, way, 0.02).any()


def test_a_surface_that_is_seen_otherwise_answers_as_a_new_one() -> None:
    ball = ball_scan(0.1)
    first = Scan(ball, np.ones(len(ball.vertices)))
    seen, beneath = (ball.vertices[:, 0] > 0).astype(float), np.where(ball.vertices[:, 1] > 0, 0.002, 0.0)
    points = 1.02 * ball.vertices[::7].astype(float)
    normals = ball.normals[::7].astype(float)
    same, new = (
        first.shown_as(seen, beneath).pairs(points, normals, 0.01),
        Scan(ball, seen, beneath).pairs(points, normals, 0.01),
    )
    for a, b in ((same.where, new.where), (same.weight, new.weight), (same.hair, new.hair)):
        np.testing.assert_array_equal(a, b)
    assert first.beneath is None and (first.seen == 1).all()
