"""Closed lips are held together; an open mouth is left as it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import eye_array
from scipy.sparse.linalg import splu
from support.ball_head import ball_template

from pipeline.registration.cage import cage_of
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.lips import CLOSED, GAP, INNER, SLIT, closing_lips, lips_closed, meeting, touching
from pipeline.registration.subdivision import limit
from pipeline.template.load import load_template

TEMPLATE = load_template()
CAGE = cage_of(TEMPLATE)


def placed(scale: float = 1.0) -> PlacedHead:
    world = np.diag([scale, scale, scale, 1.0])
    return PlacedHead(world, np.zeros(0), scale * TEMPLATE.vertices, np.zeros(0), 0.0)


def landmarks(apart: float) -> np.ndarray:
    out = np.full((468, 3), np.nan)
    out[INNER[0]], out[INNER[1]] = [0, apart / 2, 0.1], [0, -apart / 2, 0.1]
    return out


@pytest.mark.parametrize("scale", [1.0, 37.0])
def test_what_is_wanted_is_the_rest_without_its_slit(scale: float) -> None:
    """By geometry alone: each pull is a difference of limit points of two lips that face each other, and only its part
    along y changes."""
    head = placed(scale)
    rest = head.vertices[CAGE.of_template]
    stencil, where = closing_lips(TEMPLATE, head, CAGE, rest)
    assert len(where) > 10
    np.testing.assert_allclose(np.asarray(stencil.sum(1)).ravel(), 0, atol=1e-12)
    before = np.asarray(stencil @ rest)
    wanted = np.minimum(before[:, 1], GAP * scale)
    np.testing.assert_allclose(where[:, 1], wanted, rtol=1e-9)
    assert (wanted < before[:, 1]).any()
    np.testing.assert_allclose(where[:, [0, 2]], before[:, [0, 2]], atol=1e-12 * scale)
    assert np.abs(before[:, 1]).max() < 0.004 * scale and np.abs(before[:, 0]).max() < 1e-3 * scale


@pytest.mark.parametrize("far", [2e-3, -2e-3])
def test_lips_that_are_pulled_apart_or_together_meet_again(far: float) -> None:
    """A least-squares solution with a weak pull to a mouth whose lower lip has dropped, or gone into the upper one."""
    head = placed()
    rest = head.vertices[CAGE.of_template]
    stencil, where = closing_lips(TEMPLATE, head, CAGE, rest)
    drop = TEMPLATE.expression("jawOpen")[CAGE.of_template]
    moved = rest + far * drop / np.abs(drop[:, 1]).max()
    a = (stencil.T @ stencil + 1e-4 * eye_array(len(rest))).tocsc()
    x = splu(a).solve(stencil.T @ where + 1e-4 * moved)
    assert (np.abs(np.asarray(stencil @ moved - where)[:, 1]) > 0.9e-3).mean() > 0.5
    np.testing.assert_allclose(stencil @ x, where, atol=2e-5)


def test_the_ring_is_where_the_mean_head_touches() -> None:
    points = np.asarray(limit(CAGE.quads, len(CAGE.of_template)).point @ TEMPLATE.vertices[CAGE.of_template])
    rows = np.searchsorted(CAGE.of_template, touching(TEMPLATE))
    upper = points[rows[-TEMPLATE.expression("jawOpen")[touching(TEMPLATE), 1] < 1e-3]]
    lower = points[rows[-TEMPLATE.expression("jawOpen")[touching(TEMPLATE), 1] > 5e-3]]
    middle = [p[np.abs(p[:, 0]) < 0.008, 1].mean() for p in (upper, lower)]
    assert abs(middle[0] - middle[1]) < 1.5e-3


@pytest.mark.parametrize(
    ("apart", "closed"), [(0.0, True), (0.9 * CLOSED, True), (1.1 * CLOSED, False), (0.02, False), (np.nan, False)]
)
def test_an_open_mouth_is_left_open(apart: float, closed: bool) -> None:
    assert lips_closed(TEMPLATE, landmarks(apart), 1.0) is closed
    assert lips_closed(TEMPLATE, 9.0 * landmarks(apart), 9.0) is closed


def test_a_template_without_a_mouth_is_never_closed() -> None:
    assert not lips_closed(ball_template(4), landmarks(0.0), 1.0)


def sheets(gap: float, tilt: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and quads of two square sheets that face each other across `gap`; the upper one is tilted."""
    g = np.linspace(-0.01, 0.01, 9)
    x, z = (a.ravel() for a in np.meshgrid(g, g, indexing="ij"))
    at = np.arange(81).reshape(9, 9)
    patch = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    low = np.stack([x, np.zeros(81), z], 1)
    high = np.stack([x, gap + tilt * (z + 0.01), z], 1)
    down = np.array([0.0, -1.0, tilt]) / np.hypot(1, tilt)
    normals = np.concatenate([np.tile([0.0, 1.0, 0.0], (81, 1)), np.tile(down, (81, 1))])
    return np.concatenate([low, high]), normals, np.concatenate([patch[:, ::-1], patch + 81])


@pytest.mark.parametrize("unit", [1.0, 30.0])
@pytest.mark.parametrize(("gap", "closes"), [(0.5 * SLIT, True), (0.05 * SLIT, True), (1.2 * SLIT, False)])
def test_a_slit_between_lips_is_closed_and_a_mouth_is_not(unit: float, gap: float, closes: bool) -> None:
    points, normals, quads = sheets(gap * unit)
    points[:, [0, 2]] *= unit
    moved = meeting(points, normals, quads, unit)
    left = gap * unit - moved[:81] - moved[81:]
    inner = np.abs(points[:81, [0, 2]]).max(1) < 0.009 * unit
    assert (left > 0).all()
    np.testing.assert_allclose(left[inner], 0.008 * gap * unit if closes else gap * unit, rtol=0.05)


def test_lips_that_face_away_do_not_meet() -> None:
    points, normals, quads = sheets(0.5 * SLIT)
    assert not meeting(points, -normals, quads[:, ::-1], 1.0).any()
    turned = np.concatenate([quads[:64], quads[64:, ::-1]])  # the upper sheet shows the lower one its back
    assert not meeting(points, normals, turned, 1.0)[:81].any()
    assert not meeting(points, normals, quads[:0], 1.0).any()
    points, normals, quads = sheets(1e-4, tilt=2.0)  # 63 degrees: a corner, not a slit
    assert not meeting(points, normals, quads, 10.0)[:81].any()
    assert meeting(*sheets(1e-4, tilt=0.2), 10.0)[:81].any()
