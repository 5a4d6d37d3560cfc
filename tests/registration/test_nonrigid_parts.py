"""A repair moves what is around a fault, and leaves the rest where it was."""

from __future__ import annotations

import numpy as np
from registration.test_nonrigid import none, whole
from scipy.sparse import csr_array
from support.ball_head import RADIUS, ball_template

from pipeline.registration.cage import cage_of, part_of, points_of
from pipeline.registration.nonrigid import STEPS, Guides, _around, _grown, _Part, _part, _steps, _with_guides
from pipeline.registration.outgrown import candidates

TEMPLATE = ball_template(8)
CAGE = cage_of(TEMPLATE)
REST = TEMPLATE.vertices[CAGE.of_template]
CAP = REST[:, 2] > 0.6 * RADIUS


def test_a_part_has_the_points_and_springs_that_need_no_other_vertex() -> None:
    part = part_of(CAGE, CAP)
    rows = points_of(CAGE, CAP)
    moved = REST + 0.01 * np.random.default_rng(0).normal(size=REST.shape)
    assert 0 < len(rows) < len(CAGE.shown) and len(part.shown) == len(rows)
    np.testing.assert_allclose(part.points(moved[CAP]), CAGE.points(moved)[rows], atol=1e-12)
    np.testing.assert_allclose(part.normals(moved[CAP]), CAGE.normals(moved)[rows], atol=1e-9)
    inner = abs(CAGE.difference) @ CAP.astype(float) == 2
    np.testing.assert_allclose(part.difference @ moved[CAP], (CAGE.difference @ moved)[inner], atol=1e-12)
    assert (part.stiffness == CAGE.stiffness[inner]).all() and (part.of_template == CAGE.of_template[CAP]).all()
    np.testing.assert_array_equal(np.flatnonzero(CAP)[part.quads], CAGE.quads[CAP[CAGE.quads].all(1)])


def test_what_is_free_meets_the_scan_and_the_rest_stays() -> None:
    """The cap starts 3 mm inside of a larger ball that everything else lies on already."""
    scan, near = whole(RADIUS), _around(CAGE)
    everything = np.ones(len(REST), bool)
    root = _Part(CAGE, REST, none(CAGE), candidates(CAGE.points(REST)[CAGE.grows], scan, 0.0, 1.0), everything)
    damping = np.ones(len(REST))
    settled = _steps(root, REST, scan, damping, 1.0, STEPS, lambda: None)
    started = np.where(CAP[:, None], 0.97 * settled, settled)
    keep = _grown(CAP, near, 3)
    part = _part(root, scan, started, CAP, keep)
    assert keep.sum() < len(REST) and (part.free == CAP[keep]).all()
    found = started.copy()
    found[keep] = _steps(part, started[keep], scan, damping[keep], 1.0, STEPS, lambda: None)
    assert np.abs(found - settled)[~CAP].max() < 1e-7
    away = np.linalg.norm(CAGE.points(found), axis=1) - RADIUS
    assert np.abs(away).max() < 2e-4
    whole_again = _steps(root, started, scan, damping, 1.0, STEPS, lambda: None)
    assert np.abs(found - whole_again)[CAP].max() < 3e-4


def test_vertices_that_a_guide_joins_move_together() -> None:
    pair = csr_array((np.array([1.0, -1.0]), (np.array([0, 0]), np.array([3, 40]))), shape=(1, len(REST)))
    some = np.zeros(len(REST), bool)
    some[3] = True
    assert set(np.flatnonzero(_with_guides(some, Guides(pair, np.zeros((1, 3)), np.ones(1))))) == {3, 40}
    some[3], some[5] = False, True
    assert set(np.flatnonzero(_with_guides(some, Guides(pair, np.zeros((1, 3)), np.ones(1))))) == {5}
