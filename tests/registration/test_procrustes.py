"""Similarities of corresponding points against scipy, and their mean over several shapes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation

from pipeline.registration.procrustes import averaged, generalised, on_planes, robust, weighted, weighted_median
from pipeline.transforms import apply, scale_of, similarity

RNG = np.random.default_rng(5)
SHAPE = RNG.normal(0, [0.07, 0.1, 0.09], (200, 3))
ONE = np.ones(len(SHAPE))


def pose(degrees: float, scale: float = 1.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    return similarity(scale, turn, rng.normal(0, 0.2, 3))


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 40.0, 170.0, 180.0])
def test_a_known_motion_is_found_with_any_angle(degrees: float) -> None:
    true = pose(degrees, 1.2)
    weights = RNG.uniform(0, 1, len(SHAPE))
    np.testing.assert_allclose(weighted(SHAPE, apply(true, SHAPE), weights, scaled=True), true, atol=1e-12)
    rigid = pose(degrees)
    np.testing.assert_allclose(weighted(SHAPE, apply(rigid, SHAPE), weights, scaled=False), rigid, atol=1e-12)


def test_the_rotation_is_scipys_of_weighted_vectors() -> None:
    target, weights = apply(pose(50.0), SHAPE) + RNG.normal(0, 0.01, SHAPE.shape), RNG.uniform(0, 1, len(SHAPE))
    w = weights / weights.sum()
    turn, _ = Rotation.align_vectors(target - w @ target, SHAPE - w @ SHAPE, weights=weights)
    found = weighted(SHAPE, target, weights, scaled=False)
    np.testing.assert_allclose(found[:3, :3], turn.as_matrix(), atol=1e-10)


def test_the_scale_is_that_of_least_squares() -> None:
    target, weights = apply(pose(50.0, 1.3), SHAPE) + RNG.normal(0, 0.01, SHAPE.shape), RNG.uniform(0, 1, len(SHAPE))

    def cost(p: np.ndarray) -> float:
        turn = Rotation.from_rotvec(p[1:4]).as_matrix()
        return float(weights @ ((apply(similarity(p[0], turn, p[4:]), SHAPE) - target) ** 2).sum(1))

    found = weighted(SHAPE, target, weights, scaled=True)
    turn = Rotation.from_matrix(found[:3, :3] / scale_of(found)).as_rotvec()
    here = np.concatenate([[scale_of(found)], turn, found[:3, 3]])
    assert minimize(cost, here, method="Powell", options={"xtol": 1e-10, "ftol": 1e-14}).fun >= cost(here) * (1 - 1e-9)


def test_a_mirrored_shape_is_turned_and_not_mirrored() -> None:
    found = weighted(SHAPE, SHAPE * [-1, 1, 1], ONE, scaled=False)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_the_scale_of_a_mirrored_shape_is_that_of_least_squares() -> None:
    """For the rotation found, the best scale is sum y . R x / sum x . x about the middles."""
    target = 1.3 * SHAPE * [-1, 1, 1]
    found = weighted(SHAPE, target, ONE, scaled=True)
    x, y = SHAPE - SHAPE.mean(0), target - target.mean(0)
    turned = x @ (found[:3, :3] / scale_of(found)).T
    assert scale_of(found) == pytest.approx(float((y * turned).sum() / (x * x).sum()))


@pytest.mark.parametrize("weights", [0 * ONE, np.eye(200)[0], np.eye(200)[0] + np.eye(200)[1]])
def test_too_few_points_have_no_rotation(weights: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"line|weight"):
        weighted(SHAPE, SHAPE, weights, scaled=False)


def test_a_third_of_the_points_may_be_wrong() -> None:
    true = pose(170.0)
    target = apply(true, SHAPE) + RNG.normal(0, 1e-4, SHAPE.shape)
    target[:66] += [0.03, 0.01, 0]
    found = robust(SHAPE, target, ONE, scaled=False, least=1e-6)
    plain = weighted(SHAPE, target, ONE, scaled=False)
    assert np.abs(apply(found.matrix, SHAPE) - apply(true, SHAPE)).max() < 1e-4
    assert np.abs(apply(plain, SHAPE) - apply(true, SHAPE)).max() > 5e-3
    assert found.weights[:66].max() < 0.01 < 0.1 < np.median(found.weights[66:])
    assert found.spread == pytest.approx(2e-4, rel=0.5)  # of lengths, with the wrong third above the median


@pytest.mark.parametrize("scaled", [False, True])
def test_planes_find_the_motion_of_a_surface_whose_points_slid(scaled: bool) -> None:
    """On an ellipsoid in closed form; against the true motion."""
    directions = RNG.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    axes = np.array([0.07, 0.1, 0.09])
    normals = directions / axes
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    slid = directions + 0.03 * np.sin(7 * directions[:, [1, 2, 0]])
    slid /= np.linalg.norm(slid, axis=1)[:, None]
    true = pose(170.0, 1.2 if scaled else 1.0)
    source = apply(np.linalg.inv(true), slid * axes)
    weights = np.ones(4000)
    start = robust(source, directions * axes, weights, scaled=scaled, least=1e-6).matrix
    found = on_planes(start, source, directions * axes, normals, weights, scaled=scaled, least=1e-6)
    off = [np.abs(apply(m, source) - slid * axes).max() for m in (start, found.matrix)]
    assert off[1] < 2e-4 and off[1] < 0.3 * off[0]
    assert found.spread < 1e-4


def test_planes_leave_an_exact_motion_as_it_is() -> None:
    true = pose(30.0)
    unit = SHAPE / np.linalg.norm(SHAPE, axis=1)[:, None]
    found = on_planes(true, SHAPE, apply(true, SHAPE), unit @ true[:3, :3].T, ONE, scaled=True, least=1e-6)
    np.testing.assert_allclose(found.matrix, true, atol=1e-12)


def test_two_shapes_have_scipys_disparity() -> None:
    other = apply(pose(60.0, 1.4), SHAPE) + RNG.normal(0, 0.01, SHAPE.shape)
    a, b, disparity = procrustes(SHAPE, other)
    matrix = weighted(other, SHAPE, ONE, scaled=True)
    residual = ((apply(matrix, other) - SHAPE) ** 2).sum() / ((SHAPE - SHAPE.mean(0)) ** 2).sum()
    assert residual == pytest.approx(disparity, rel=1e-9)


def test_the_mean_of_two_lies_between_both_after_alignment() -> None:
    other = SHAPE + RNG.normal(0, 0.002, SHAPE.shape)
    shapes = np.stack([SHAPE, apply(pose(170.0, 1.5), other)])
    found = generalised(shapes, np.ones((2, 200)), scaled=True, least=1.0)  # so wide a spread: least squares
    placed = [apply(m, x) for m, x in zip(found.matrices, shapes, strict=True)]
    np.testing.assert_allclose(found.mean, (placed[0] + placed[1]) / 2, atol=1e-9)
    a, b, disparity = procrustes(*shapes)
    unit = np.linalg.norm(placed[0] - placed[0].mean(0))
    apart = ((placed[0] - placed[1]) ** 2).sum() / unit**2
    assert apart == pytest.approx(disparity, rel=0.02)
    assert np.prod([scale_of(m) for m in found.matrices]) == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_allclose(scale_of(found.matrices[0]) ** 2, 1.5, rtol=5e-3)


def test_generalised_procrustes_has_the_least_sum_of_squares() -> None:
    """Against scipy's minimiser over all similarities, the scales' product held at one."""
    small = SHAPE[:12]
    shapes = np.stack(
        [apply(pose(30.0 * i, 1 + 0.1 * i, i), small + RNG.normal(0, 0.004, small.shape)) for i in range(3)]
    )
    found = generalised(shapes, np.ones((3, 12)), scaled=True, least=10.0)

    def cost(p: np.ndarray) -> float:
        logs = np.array([*p[:2], -p[:2].sum()])
        placed = []
        for i in range(3):
            q = p[2 + 6 * i : 8 + 6 * i]
            placed.append(apply(similarity(np.exp(logs[i]), Rotation.from_rotvec(q[:3]).as_matrix(), q[3:]), shapes[i]))
        x = np.stack(placed)
        return float(((x - x.mean(0)) ** 2).sum())

    start = [np.log(scale_of(m)) for m in found.matrices[:2]]
    for m in found.matrices:
        start += [*Rotation.from_matrix(m[:3, :3] / scale_of(m)).as_rotvec(), *m[:3, 3]]
    best = minimize(cost, np.array(start), method="BFGS", options={"gtol": 1e-12})
    assert cost(np.array(start)) <= best.fun * (1 + 2e-3)


def test_identical_shapes_and_a_single_one_are_their_own_mean() -> None:
    for count in (1, 3):
        found = generalised(np.stack([SHAPE] * count), np.ones((count, 200)), scaled=True, least=1e-6)
        np.testing.assert_allclose(found.mean, SHAPE, atol=1e-12)
        np.testing.assert_allclose(found.matrices, np.broadcast_to(np.eye(4), (count, 4, 4)), atol=1e-12)


def test_the_mean_is_robust_against_one_bad_part() -> None:
    shapes = np.stack([apply(pose(20.0 * i, 1.0, i), SHAPE) for i in range(5)])
    shapes[4, :40] += 0.05
    found = generalised(shapes, np.ones((5, 200)), scaled=True, least=1e-5)
    home = weighted(found.mean, SHAPE, ONE, scaled=True)
    assert np.abs(apply(home, found.mean) - SHAPE).max() < 1e-3


def test_a_point_without_weight_is_the_plain_mean() -> None:
    shapes = np.stack([SHAPE, SHAPE + 0.01])
    weights = np.ones((2, 200))
    weights[:, 0] = 0
    weights[1, 1] = 0
    found = averaged(shapes, np.stack([np.eye(4)] * 2), weights)
    np.testing.assert_allclose(found[:3] - SHAPE[:3], np.array([[0.005], [0.0], [0.005]]) * np.ones(3), atol=1e-12)


def test_the_weighted_median() -> None:
    values = RNG.normal(size=101)
    assert weighted_median(values, np.ones(101)) == np.median(values)
    assert weighted_median(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.1, 5.0])) == 3.0
    assert weighted_median(np.zeros(0), np.zeros(0)) == 0.0 == weighted_median(np.ones(2), np.zeros(2))
