"""Expressions on a person: against the problem as the paper states it, on the template itself, and at its extremes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.registration.expressions import MOST, blink_scale, gradients, transferred, triangles
from pipeline.registration.lids import BLINK, GAP, facing
from pipeline.registration.neck import neck_share
from pipeline.registration.rig import jaw_axis, load_rig, rig_of
from pipeline.template.load import load_template
from pipeline.template.model import Expressions, Template
from tests.support.ball_head import ball_template

TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])  # a rotation
SCALE, SHIFT = 1.7, np.array([0.3, -0.2, 0.5])


@pytest.fixture(scope="module")
def template() -> Template:
    return load_template()


def offsets_of(e: Expressions, name: str, count: int) -> np.ndarray:
    i, out = e.names.index(name), np.zeros((count, 3))
    own = slice(int(e.starts[i]), int(e.starts[i + 1]))
    out[e.vertices[own]] = e.offsets[own]
    return out


def without_lashes(template: Template) -> np.ndarray:
    lashes = [template.part_vertices(p) for p in template.parts if p.startswith("lashes")]
    return np.setdiff1d(np.arange(len(template.vertices)), np.concatenate(lashes))


def small_template() -> tuple[Template, np.ndarray]:
    """A ball with one expression that moves its front, and a person of another shape."""
    ball = ball_template(4)
    front = np.flatnonzero(ball.vertices[:, 2] > 0.02)
    moved = 0.02 * np.sin(40 * ball.vertices[front]) + [0.005, 0.0, 0.01]
    given = Expressions(("puff",), np.array([0, len(front)]), front, moved)
    person = ball.vertices * [1.2, 0.9, 1.1] + 0.004 * np.cos(30 * ball.vertices[:, [1, 2, 0]])
    return replace(ball, expressions=given), person


def as_the_paper_states_it(template: Template, person: np.ndarray) -> np.ndarray:
    """Dense least squares over the moved vertices and a fourth vertex of each triangle [Sumner and Popovic 2004, eq. 8
    to 10], triangles weighted by their area."""
    faces = np.concatenate([template.quads[:, c] for c in ([0, 1, 2], [0, 2, 3], [1, 2, 3], [1, 3, 0])])
    x, moves = template.vertices, template.expressions
    assert moves is not None

    def frame(v: np.ndarray) -> np.ndarray:
        a, b = v[1] - v[0], v[2] - v[0]
        n = np.cross(a, b)
        return np.stack([a, b, n / np.sqrt(np.linalg.norm(n))], 1)

    free = {int(v): i for i, v in enumerate(moves.vertices)}
    after = x.copy()
    after[moves.vertices] += moves.offsets
    rows, right = [], []
    width = len(free) + len(faces)
    for t, f in enumerate(faces):
        wanted = frame(after[f]) @ np.linalg.inv(frame(x[f]))
        inverse, weight = (
            np.linalg.inv(frame(person[f])),
            np.sqrt(np.linalg.norm(np.cross(*np.diff(person[f], axis=0)))),
        )
        for k in range(3):  # column k of V~ V^-1: sum over the corners of (corner - first) inverse[corner, k]
            row, known = np.zeros(width), np.zeros(3)
            for vertex, c in zip(f, [-inverse[:, k].sum(), inverse[0, k], inverse[1, k]], strict=True):
                if int(vertex) in free:
                    row[free[int(vertex)]] += c
                else:
                    known += c * person[vertex]
            row[len(free) + t] = inverse[2, k]
            rows.append(weight * row)
            right.append(weight * (wanted[:, k] - known))
    solved = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    return solved[: len(free)] - person[moves.vertices]


def test_it_solves_the_papers_problem() -> None:
    template, person = small_template()
    found = transferred(template, person, np.eye(4))
    np.testing.assert_array_equal(found.vertices, template.expressions.vertices)  # type: ignore[union-attr]
    wanted = as_the_paper_states_it(template, person)
    np.testing.assert_allclose(found.offsets, wanted, atol=2e-7)
    assert np.abs(found.offsets - template.expressions.offsets).max() > 1e-3  # type: ignore[union-attr]


def test_on_the_template_itself_it_gives_the_shapes_back(template: Template) -> None:
    found, kept = transferred(template, template.vertices, np.eye(4)), without_lashes(template)
    assert found.names == template.expressions.names and len(found.names) == 52  # type: ignore[union-attr]
    for name in set(found.names) - set(BLINK):
        wanted = template.expression(name) * neck_share(template)[:, None]
        np.testing.assert_allclose(offsets_of(found, name, len(wanted))[kept], wanted[kept], atol=2e-7)


def test_on_a_similar_head_it_gives_the_transformed_shapes(template: Template) -> None:
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = SCALE * TURN, SHIFT
    here = transferred(template, template.vertices, np.eye(4))
    there = transferred(template, SCALE * template.vertices @ TURN.T + SHIFT, placed)
    np.testing.assert_array_equal(there.vertices, here.vertices)
    np.testing.assert_allclose(there.offsets, SCALE * here.offsets @ TURN.T, atol=1e-9)


@pytest.mark.parametrize(("name", "side"), list(zip(BLINK, (1.0, -1.0), strict=True)))
def test_a_blink_closes_open_and_half_closed_eyes(template: Template, name: str, side: float) -> None:
    margins = facing(template, side)
    for closed in (0.0, 0.5):
        person = template.vertices + closed * template.expression(name)
        blink = offsets_of(transferred(template, person, np.eye(4)), name, len(person))
        before, after = ((margins @ x)[:, 1] for x in (person, person + blink))
        assert np.abs(after - GAP).max() < 3e-4 and np.abs(before - GAP).max() > 1.5e-3
        other = facing(template, -side) @ blink
        assert np.abs(other).max() == 0


def test_the_scale_of_a_blink_is_that_of_least_squares(template: Template) -> None:
    margins, blink = facing(template, 1.0), template.expression(BLINK[0])
    found = blink_scale(margins, template.vertices, blink)
    cost = [np.sum(((margins @ (template.vertices + (found + h) * blink))[:, 1] - GAP) ** 2) for h in (-1e-3, 0, 1e-3)]
    assert cost[1] < cost[0] and cost[1] < cost[2]
    assert blink_scale(margins, template.vertices, 1e-3 * blink) == MOST
    assert blink_scale(margins, template.vertices, 0 * blink) == 1.0


def test_gradients_are_those_of_affine_maps() -> None:
    vertices, A = ball_template(3).vertices, np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.2]])
    t = triangles(vertices, ball_template(3).quads)
    S = gradients(vertices, vertices @ A.T, t.corners)
    np.testing.assert_allclose(S @ t.frame, np.broadcast_to(A, S.shape) @ t.frame, atol=1e-10)
    field = (t.gradient @ (vertices @ A.T)).reshape(-1, 2, 3).transpose(0, 2, 1)
    np.testing.assert_allclose(field, A @ t.frame, atol=1e-10)
    assert t.area.sum() == pytest.approx(4 * np.pi * 0.1**2, rel=0.1)  # both cuts together count once


def test_extremes_stay_finite() -> None:
    template, person = small_template()
    collapsed = person.copy()
    collapsed[template.quads[0]] = collapsed[template.quads[0, 0]]
    assert np.isfinite(transferred(template, collapsed, np.eye(4)).offsets).all()
    whole = Expressions(("all",), np.array([0, len(person)]), np.arange(len(person)), np.full_like(person, 0.01))
    moved = transferred(replace(template, expressions=whole), person, np.eye(4))
    np.testing.assert_allclose(moved.offsets, 0.01, atol=1e-6)  # nothing is held: all of it moves
    assert transferred(replace(template, expressions=None), person, np.eye(4)).names == ()


# ------------------------------------------------------------------ joints
def test_the_jaw_turns_teeth_and_tongue_about_its_axis(template: Template) -> None:
    rig, found = rig_of(template, template.vertices, np.eye(4)), jaw_axis(template)
    assert rig is not None and found is not None and rig.joints == ("head", "jaw", "eye_left", "eye_right")
    np.testing.assert_allclose(rig.weights.sum(1), 1, atol=1e-12)
    assert rig.weights.min() >= 0
    turn, on_axis = found
    np.testing.assert_allclose(rig.places[1], on_axis, atol=1e-9)
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(24, abs=1)
    turned = (template.vertices - on_axis) @ turn.T + on_axis - template.vertices
    opened, jaw = template.expression("jawOpen"), rig.weights[:, 1:2]
    for part, most in (("teeth_lower", 0.001), ("skin", 0.015)):
        rows = template.part_vertices(part)
        assert np.linalg.norm(jaw[rows] * turned[rows] - opened[rows], axis=1).max() < most
    assert (jaw[template.part_vertices("teeth_upper")] == 0).all()
    assert (rig.weights[template.part_vertices("eye_left"), 2] == 1).all()


def test_eyes_turn_as_rigid_balls_on_a_person(template: Template) -> None:
    person = template.vertices.copy()
    own = template.part_vertices("eye_left")
    middle = person[own].mean(0)
    person[own] = middle + 0.8 * (person[own] - middle) + [0.001, 0.002, 0.0]
    for name in ("eyeLookInLeft", "eyeLookDownLeft"):
        moved = offsets_of(transferred(template, person, np.eye(4)), name, len(person))[own]
        size = np.linalg.norm(person[own] - person[own].mean(0), axis=1)
        after = person[own] + moved
        assert np.abs(np.linalg.norm(after - after.mean(0), axis=1) - size).max() < 3e-4
        assert np.linalg.norm(moved, axis=1).max() > 0.003


def test_a_rig_survives_its_file(template: Template, tmp_path) -> None:
    rig = rig_of(template, template.vertices, np.eye(4))
    assert rig is not None
    rig.save(tmp_path / "rig.npz")
    found = load_rig(tmp_path / "rig.npz")
    assert found.expressions.names == rig.expressions.names and found.joints == rig.joints
    np.testing.assert_allclose(found.expressions.offsets, rig.expressions.offsets, atol=1e-8)
    np.testing.assert_allclose(found.weights, rig.weights, atol=1e-7)
    assert rig_of(replace(template, joints={}), template.vertices, np.eye(4)) is None
