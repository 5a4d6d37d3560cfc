"""Margins of the lids: which vertices of the two lids face each other, and what closed ones hide."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.registration.cage import cage_of
from pipeline.registration.lids import RINGS, UPPER_LIDS, _loop, _margins, _rings, between, facing
from pipeline.template.load import load_template
from pipeline.template.model import Template


@pytest.fixture(scope="module")
def template() -> Template:
    return load_template()


def test_margins_run_from_corner_to_corner_around_each_eye(template: Template) -> None:
    found = _margins(template)
    assert len(found) == 2 * RINGS
    seen = [np.unique(np.concatenate(pair)) for pair in found]
    for ring in _rings(template):
        assert any(np.isin(s, ring).all() and len(s) == len(ring) // 2 for s in seen)
    for upper, lower in found:
        assert upper[0] == lower[0] and upper[-1] == lower[-1]
        assert len(np.intersect1d(upper, lower)) == 2
        for row in (upper, lower):
            step = np.linalg.norm(np.diff(template.vertices[row], axis=0), axis=1)
            assert step.max() < 0.006 and template.vertices[row[-1], 0] > template.vertices[row[0], 0]
        high, low = (template.vertices[row[1:-1], 1].mean() for row in (upper, lower))
        assert high > low + 0.002


def test_each_vertex_of_an_upper_lid_faces_a_place_of_the_lower_one(template: Template) -> None:
    stencil = facing(template).toarray()
    assert len(stencil) == sum(len(upper) - 2 for upper, _ in _margins(template))
    assert (stencil.max(1) == 1).all() and np.allclose(stencil.sum(1), 0)
    assert np.allclose(np.abs(stencil).sum(1), 2)
    across = stencil @ template.vertices[:, 0]
    assert np.abs(across).max() < 0.0015  # beside it, not around the corner
    left, right = facing(template, 1.0), facing(template, -1.0)
    assert left.shape[0] == right.shape[0] == len(stencil) // 2


def test_closed_margins_are_hidden_and_cheeks_are_not(template: Template) -> None:
    cage = cage_of(template)
    share = between(template, cage)
    hidden = np.flatnonzero(share > 0.6)
    assert 100 < len(hidden) < 800 and share.max() <= 1 + 1e-12 and share.min() >= -1e-12
    lids = template.vertices[np.unique(template.quads[template.regions["lids"]])]
    points = cage.points(template.vertices[cage.of_template])[hidden]
    assert (points.min(0) >= lids.min(0) - 1e-3).all() and (points.max(0) <= lids.max(0) + 1e-3).all()
    front = _rings(template)[-1]
    away = np.linalg.norm(points[:, None] - template.vertices[front][None], axis=2).min(1)
    assert away.max() < 0.008


def test_a_ring_that_is_not_one_closed_line_has_no_order() -> None:
    quads = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
    assert _loop(quads, np.arange(4)).tolist() in ([0, 1, 2, 3], [0, 3, 2, 1])
    assert not len(_loop(quads[:3], np.arange(4)))
    two = np.concatenate([quads, quads + 8])
    assert not len(_loop(two, np.r_[np.arange(4), np.arange(8, 12)]))


def test_the_upper_landmarks_are_those_of_the_template_too(template: Template) -> None:
    named = {n: int(i) for n, i in zip(template.landmarks.names, template.landmarks.network, strict=True)}
    upper = {i for n, i in named.items() if n.startswith("lid_upper")}
    assert len(upper) == 6 and upper <= set(UPPER_LIDS)
    assert not set(UPPER_LIDS) & {i for n, i in named.items() if not n.startswith("lid_upper")}
