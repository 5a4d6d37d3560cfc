"""Measured expressions of persons whose expressions and poses are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import nnls

from pipeline.errors import StageError
from pipeline.registration.measured import (
    HARD,
    LEAST_SEEN,
    REACH,
    aligned,
    combination,
    dense,
    faded,
    measured,
)
from pipeline.registration.shapes import load_shapes, save_shapes, sparse, with_shapes
from pipeline.registration.still import UNSEEN, counted, evidence, movement, outside, still_weights
from pipeline.registration.subdivision import edges_of
from tests.support.ball_head import ball_quads
from tests.support.persons import SHIFT, SMILE, TURN, degrees_between, expression, head, names, person, rig, template

REGIONS, PARTS = names()
NEUTRAL = person(1)
FACE = np.unique(template().quads[np.concatenate([template().regions[n] for n in ("face", "lips", "nose", "lids")])])
NOISE = 1e-4  # metres, of every registered vertex


def smiling(noise: float = NOISE, shares: dict[str, float] | None = None) -> np.ndarray:
    offsets = expression(SMILE if shares is None else shares)
    return np.asarray(NEUTRAL + offsets + np.random.default_rng(2).normal(0, noise, NEUTRAL.shape))


def found(neutral: object, other: object, metric: bool = True):  # type: ignore[no-untyped-def]
    return measured(neutral, other, rig(), REGIONS, PARTS, 1.0, metric=metric)  # type: ignore[arg-type]


def off_mm(offsets: np.ndarray, shares: dict[str, float], rows: np.ndarray = FACE) -> np.ndarray:
    return np.asarray(1000 * np.linalg.norm(offsets - expression(shares), axis=1)[rows])


# ------------------------------------------------------------------ what is still
def test_what_no_expression_moves_counts_fully_and_the_lips_do_not() -> None:
    weights = still_weights(head(NEUTRAL), REGIONS, rig().expressions, 1.0)
    of = {n: weights[np.unique(template().quads[q])] for n, q in template().regions.items()}
    assert np.median(of["scalp"]) == 1.0 and np.median(of["ears"]) > 0.9
    assert of["lips"].max() < 1e-4 and np.median(of["lids"]) < 0.01
    assert all(of[n].max() == 0 for n in ("eyes", "teeth", "tongue", "lashes")) and np.median(of["neck"]) == 0
    assert np.median(of["brows"]) < 0.01


def test_movement_is_the_largest_offset_of_all() -> None:
    e = rig().expressions
    every = np.linalg.norm(dense(e, len(NEUTRAL)), axis=2)
    np.testing.assert_array_equal(movement(e, len(NEUTRAL)), every.max(0))


def test_evidence_is_of_the_outer_skin_and_of_its_neighbours() -> None:
    assert set(np.unique(evidence(head(NEUTRAL), REGIONS))) == {0.0, 1.0}
    assert evidence(head(NEUTRAL, 0.0), REGIONS).max() == 0
    assert evidence(head(NEUTRAL, 0.25), REGIONS).max() == pytest.approx(0.5)
    one = np.zeros(len(NEUTRAL))
    row = FACE[np.argmax(template().vertices[FACE, 2])]
    one[row] = 1
    seen = evidence(head(NEUTRAL, one), REGIONS)
    ends = edges_of(template().quads, len(NEUTRAL)).ends
    assert list(np.flatnonzero(seen)) == [row] and seen[row] == pytest.approx(1 / (1 + (ends == row).sum()))
    dark = evidence(head(NEUTRAL, 1 - one), REGIONS)
    assert dark[row] == 0 and 0.5 < dark[ends[(ends == row).any(1)]].max(1).min() < 1


def test_what_nobody_saw_counts_little() -> None:
    still = np.array([1.0, 0.5, 0.0])
    np.testing.assert_allclose(counted(still, np.ones(3), np.array([0.0, 1.0, 1.0])), [UNSEEN, 0.5, 0.0])


# ------------------------------------------------------------------ the motion
@pytest.mark.parametrize("degrees", [0.0, 14.0, 170.0])
def test_the_motion_of_the_skull_is_found_under_a_smile(degrees: float) -> None:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.8, 0.0])).as_matrix()
    other = head(smiling(), turn=turn, shift=SHIFT)
    weights = counted(still_weights(head(NEUTRAL), REGIONS, rig().expressions, 1.0), np.ones(len(NEUTRAL)))
    matrix = aligned(head(NEUTRAL), other, weights, 1.0, scaled=False).matrix
    assert degrees_between(matrix[:3, :3] @ turn, np.eye(3)) < 0.02
    assert np.linalg.norm(matrix[:3, :3] @ SHIFT + matrix[:3, 3]) < 5e-5


def test_a_head_whose_hair_lies_otherwise_is_aligned_all_the_same() -> None:
    vertices = smiling()
    top = np.unique(template().quads[template().regions["scalp"]])
    top = top[NEUTRAL[top, 1] > np.quantile(NEUTRAL[top, 1], 0.6)]
    vertices[top] += [0, 0.006, 0]
    made = found(head(NEUTRAL), head(vertices, turn=TURN, shift=SHIFT))
    assert not made.refused and np.quantile(off_mm(made.offsets, SMILE), 0.95) < 0.4


def test_a_template_that_slid_along_the_skull_does_not_turn_the_head() -> None:
    """Two registrations of one scalp differ along it; across it they agree."""
    from pipeline.registration.procrustes import robust
    from pipeline.registration.subdivision import limit

    normals = limit(template().quads, len(NEUTRAL)).normals(NEUTRAL)
    slide = np.array([0.0025, 0.0, 0.0]) * np.ones((len(NEUTRAL), 1))
    slide -= (slide * normals).sum(1)[:, None] * normals
    weights = still_weights(head(NEUTRAL), REGIONS, rig().expressions, 1.0)
    other = head(smiling() + slide, turn=TURN, shift=SHIFT)
    surface = aligned(head(NEUTRAL), other, weights, 1.0, scaled=False).matrix
    plain = robust(other.vertices, NEUTRAL, weights, scaled=False, least=1e-4).matrix
    back = TURN @ NEUTRAL.mean(0) + SHIFT
    away = [1000 * np.linalg.norm(m[:3, :3] @ back + m[:3, 3] - NEUTRAL.mean(0)) for m in (surface, plain)]
    assert away[0] < 0.3 and away[1] > 3 * away[0]
    made = found(head(NEUTRAL), other)
    top = np.unique(template().quads[template().regions["scalp"]])
    assert np.median(np.linalg.norm(made.offsets[top], axis=1)) < 1e-5  # what is still stays


# ------------------------------------------------------------------ the offsets
@pytest.mark.parametrize("shares", [SMILE, {"jawOpen": 0.6}, {"browInnerUp": 1.0, "noseSneerLeft": 0.5}])
def test_the_offsets_are_the_true_ones(shares: dict[str, float]) -> None:
    made = found(head(NEUTRAL), head(smiling(shares=shares), turn=TURN, shift=SHIFT))
    off = off_mm(made.offsets, shares)
    assert not made.refused
    assert np.median(off) < 0.25 and np.quantile(off, 0.95) < 0.4  # the noise alone: 0.15 and 0.28
    assert made.figures["turn_degrees"] == pytest.approx(degrees_between(TURN, np.eye(3)), abs=0.05)
    assert made.figures["still_mm"] < 0.2 and made.figures["seen"] > 0.95
    assert made.figures["size"] == pytest.approx(1.0, abs=1e-3)
    assert made.figures["explained"] > 0.9


def test_an_expression_that_the_template_has_not_is_measured_too() -> None:
    cheek = FACE[np.argmin(np.linalg.norm(NEUTRAL[FACE] - [0.04, -0.04, 0.06], axis=1))]
    bump = 0.004 * np.exp(-(((NEUTRAL - NEUTRAL[cheek]) / 0.02) ** 2).sum(1))
    offsets = np.zeros_like(NEUTRAL)
    offsets[:, 0] = bump
    made = found(head(NEUTRAL), head(NEUTRAL + offsets, turn=TURN))
    assert 1000 * np.abs(made.offsets - offsets)[FACE].max() < 0.4  # less what is still of the temple
    assert made.figures["explained"] < 0.9


def test_what_no_photo_shows_moves_as_the_transferred_expressions_do() -> None:
    """The left cheek and half of the mouth are not seen: no measurement may enter from there."""
    hidden = NEUTRAL[:, 0] > 0.012
    spoiled = smiling()
    spoiled[hidden] += 0.02  # whatever the registration made of it
    made = found(head(NEUTRAL), head(spoiled, np.where(hidden, 0.0, 1.0), TURN, SHIFT))
    deep = FACE[NEUTRAL[FACE, 0] > 0.03]
    ghost = np.linalg.norm(expression(SMILE), axis=1)[deep] > 0.002
    assert not made.refused and ghost.sum() > 20
    off = off_mm(made.offsets, SMILE, deep[ghost])
    size = 1000 * np.linalg.norm(expression(SMILE), axis=1)[deep[ghost]]
    assert np.median(off / size) < 0.75 and off.max() < size.max() and off.max() < 10
    right = FACE[NEUTRAL[FACE, 0] < -0.005]
    assert np.quantile(off_mm(made.offsets, SMILE, right), 0.95) < 0.4


def test_without_expressions_an_unseen_part_fades_to_rest() -> None:
    hidden = NEUTRAL[:, 1] < -0.02
    bare = replace(rig(), expressions=sparse((), [], 1.0))
    made = measured(
        head(NEUTRAL), head(NEUTRAL + [0, 0, 0.0], np.where(hidden, 0.0, 1.0)), bare, REGIONS, PARTS, 1.0, metric=True
    )
    assert np.abs(made.offsets).max() < 1e-9


def test_beyond_the_reach_nothing_of_what_is_seen_is_left() -> None:
    h, seen = head(NEUTRAL), np.where(NEUTRAL[:, 1] > 0.05, 1.0, 0.0)
    skin = np.zeros(len(NEUTRAL), np.bool_)
    skin[template().quads[template().parts["skin"]]] = True
    field = faded(h, np.full_like(NEUTRAL, 0.01), seen, skin, 1.0)
    np.testing.assert_allclose(field[skin & (seen == 1)], 0.01, rtol=0.02)
    below = NEUTRAL[:, 1] < 0.05 - 5 * REACH
    assert below[skin].any() and np.abs(field[below & skin]).max() < 3e-4
    assert np.abs(field[~skin]).max() == 0


def test_the_field_has_the_least_energy() -> None:
    """Against least squares with one row for each term."""
    directions, quads = ball_quads(3)
    h = replace(head(NEUTRAL), vertices=0.1 * directions, quads=quads)
    rng = np.random.default_rng(0)
    seen, rest = rng.uniform(0, 1, len(directions)), rng.normal(size=(len(directions), 3))
    seen[:10], seen[10:20] = 0, 1
    field = faded(h, rest, seen, np.ones(len(directions), np.bool_), 1.0)
    ends = edges_of(quads, len(directions)).ends
    length = np.linalg.norm(h.vertices[ends[:, 0]] - h.vertices[ends[:, 1]], axis=1)
    mean = length.mean()
    mass = [sum(length[i] for i, e in enumerate(ends) if v in e) * mean / (2 * REACH) ** 2 for v in range(len(seen))]
    rows, right = [], []
    for v in range(len(directions)):
        one = np.eye(len(directions))[v]
        rows += [one * np.sqrt(seen[v] / (1 - seen[v] + HARD)), one * np.sqrt((1 - seen[v]) * mass[v])]
        right += [rest[v] * np.sqrt(seen[v] / (1 - seen[v] + HARD)), np.zeros(3)]
    for (a, b), far in zip(ends, length, strict=True):
        weight = (1 - min(seen[a], seen[b])) * mean / far
        rows.append((np.eye(len(directions))[a] - np.eye(len(directions))[b]) * np.sqrt(weight))
        right.append(np.zeros(3))
    np.testing.assert_allclose(field, np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0], atol=1e-9)


def test_the_combination_is_that_of_bounded_least_squares() -> None:
    rng = np.random.default_rng(1)
    basis, weights = rng.normal(size=(4, 30, 3)), rng.uniform(0.1, 1, 30)
    true = np.array([0.2, 0.0, 0.9, 0.4])
    found_shares = combination(basis, np.tensordot(true, basis, 1), weights)
    np.testing.assert_allclose(found_shares, true, atol=1e-3)
    wanted = rng.normal(size=(30, 3)) * 0.2
    root = np.sqrt(weights)[:, None]
    positive, _ = nnls((root * basis).reshape(4, -1).T, (root * wanted).ravel())
    assert positive.max() < 1
    np.testing.assert_allclose(combination(basis, wanted, weights), positive, atol=1e-3)
    assert combination(basis, np.tensordot(5 * true, basis, 1), weights).max() <= 1
    assert not combination(basis, wanted, np.zeros(30)).any() and combination(basis[:0], wanted, weights).shape == (0,)


def test_the_border_of_the_neck_the_eyes_and_the_lashes_stay() -> None:
    shifted = smiling(0.0)
    shifted[NEUTRAL[:, 1] < -0.1] += [0, 0, 0.01]  # the head was turned against the shoulders
    shifted += expression({"eyeLookOutLeft": 1.0})
    made = found(head(NEUTRAL), head(shifted))
    assert np.abs(made.offsets[np.argsort(NEUTRAL[:, 1])[:10]]).max() == 0
    for part in ("eye_left", "eye_right", "lashes_left", "lashes_right"):
        assert np.abs(made.offsets[np.unique(template().quads[template().parts[part]])]).max() == 0, part


def test_teeth_and_tongue_follow_the_jaw() -> None:
    shares = {"jawOpen": 0.6}
    made = found(head(NEUTRAL), head(smiling(0.0, shares), turn=TURN))
    teeth = np.unique(template().quads[template().parts["teeth_lower"]])
    assert off_mm(made.offsets, shares, teeth).max() < 1.0


# ------------------------------------------------------------------ extremes
def test_identical_heads_make_an_expression_without_offsets() -> None:
    made = found(head(NEUTRAL), head(NEUTRAL))
    assert np.abs(made.offsets).max() < 1e-9 and not made.refused and made.figures["explained"] == 1.0


@pytest.mark.parametrize("side", ["neutral", "other", "both"])
def test_heads_that_nobody_saw_are_refused(side: str) -> None:
    blind = {"neutral": (0.0, 1.0), "other": (1.0, 0.0), "both": (0.0, 0.0)}[side]
    made = found(head(NEUTRAL, blind[0]), head(smiling(), blind[1]))
    assert f"only 0 % of the skin that expressions move (at least {100 * LEAST_SEEN:.0f} %)" in made.refused
    assert np.isfinite(made.offsets).all()


def test_a_head_of_another_size_is_refused_unless_the_unit_is_unknown() -> None:
    larger = head(1.3 * smiling(), turn=TURN, shift=SHIFT)
    assert "1.30 times as large" in found(head(NEUTRAL), larger).refused
    made = found(head(NEUTRAL), larger, metric=False)
    assert not made.refused and made.figures["scale"] == pytest.approx(1 / 1.3, rel=1e-3)
    assert np.quantile(off_mm(made.offsets, SMILE), 0.95) < 0.4


def test_another_person_is_refused() -> None:
    made = found(head(NEUTRAL), head(person(7) * 1.02 + np.random.default_rng(0).normal(0, 0.005, NEUTRAL.shape)))
    assert "mm apart" in made.refused


def test_another_topology_is_a_bug_and_no_shape() -> None:
    with pytest.raises(ValueError, match="topologies"):
        found(head(NEUTRAL), replace(head(NEUTRAL), quads=template().quads[:, [1, 2, 3, 0]]))


def test_the_skin_outside_is_without_neck_and_mouth() -> None:
    mask = outside(head(NEUTRAL), REGIONS)
    for name in ("neck", "mouth_inside", "sockets", "eyes"):
        assert not mask[np.unique(template().quads[template().regions[name]])].any(), name
    assert mask[FACE].mean() > 0.6


# ------------------------------------------------------------------ the file
def test_shapes_come_back_from_their_file_and_go_into_the_rig(tmp_path: Path) -> None:
    made = found(head(NEUTRAL), head(smiling())).offsets
    shapes = sparse(("measured_smile", "measured_still"), [made, 0 * made], 1.0)
    save_shapes(tmp_path / "m.npz", shapes)
    back = load_shapes(tmp_path / "m.npz")
    whole = with_shapes(rig(), back, tmp_path / "m.npz").expressions
    assert whole.names == (*rig().expressions.names, "measured_smile", "measured_still")
    every = dense(whole, len(NEUTRAL))
    np.testing.assert_allclose(every[52], made, atol=1e-6)
    np.testing.assert_array_equal(every[:52], dense(rig().expressions, len(NEUTRAL)))
    assert not every[53].any()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"vertices": np.array([99999])}, "vertex 99999 of 5040"),
        ({"vertices": np.array([-1])}, "vertex -1"),
        ({"offsets": np.full((1, 3), np.nan)}, "numbers below 1"),
        ({"starts": np.array([0, 2])}, "rows"),
        ({"names": ("smile",)}, "names other"),
        ({"names": ("measured_a/../b",)}, "names other"),
    ],
)
def test_a_file_that_does_not_fit_is_named(change: dict[str, object], said: str, tmp_path: Path) -> None:
    good = sparse(("measured_smile",), [np.eye(len(NEUTRAL), 3) * 0.01], 1.0)
    good = replace(good, vertices=good.vertices[:1], offsets=good.offsets[:1], starts=np.array([0, 1]))
    save_shapes(tmp_path / "m.npz", replace(good, **change))  # type: ignore[arg-type]
    with pytest.raises(StageError, match=said):
        with_shapes(rig(), load_shapes(tmp_path / "m.npz"), tmp_path / "m.npz")


def test_a_file_of_something_else_is_named(tmp_path: Path) -> None:
    (tmp_path / "m.npz").write_bytes(b"PK no")
    with pytest.raises(StageError, match="no measured expressions"):
        load_shapes(tmp_path / "m.npz")
    np.savez(tmp_path / "n.npz", names=np.array(["a"]))
    with pytest.raises(StageError, match="KeyError"):
        load_shapes(tmp_path / "n.npz")
    save_shapes(tmp_path / "o.npz", sparse(("measured_smile",), [np.zeros_like(NEUTRAL)], 1.0))
    twice = with_shapes(rig(), load_shapes(tmp_path / "o.npz"), tmp_path / "o.npz")
    with pytest.raises(StageError, match="second shape measured_smile"):
        with_shapes(twice, load_shapes(tmp_path / "o.npz"), tmp_path / "o.npz")
