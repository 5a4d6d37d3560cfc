"""The similarity and identity of the template from landmarks and surface points, against persons that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.errors import StageError
from pipeline.meshes import F64, vertex_normals
from pipeline.registration.identity_fit import Data, PlacedHead, _moves, _normal_equations, landmark_data, place
from pipeline.template.load import load_template
from pipeline.transforms import apply, similarity

TEMPLATE = load_template()
WORLD = similarity(1.57, Rotation.from_euler("xyz", [0.4, -1.1, 0.2]).as_matrix(), np.array([0.3, -0.2, 1.1]))


def person(seed: int = 3, size: float = 1.0) -> tuple[F64, F64]:
    """A person's weights, and its vertices in the world."""
    assert TEMPLATE.shape is not None
    weights = size * np.random.default_rng(seed).standard_normal(len(TEMPLATE.shape.basis))
    return weights, apply(WORLD, TEMPLATE.identity(weights))


def network(vertices: F64) -> F64:
    """(468, 3) the network's landmarks of a head; those that the template does not know are not finite."""
    out = np.full((468, 3), np.nan)
    out[TEMPLATE.landmarks.network] = TEMPLATE.landmark_points(vertices)
    return out


def face_rows() -> F64:
    regions = [TEMPLATE.regions[n] for n in ("face", "lips", "nose", "lids", "brows")]
    return np.unique(TEMPLATE.quads[np.concatenate(regions)])


def off(head: PlacedHead, truth: F64) -> F64:
    """Distances over the face, in the template's metres."""
    rows = face_rows()
    return np.linalg.norm(head.vertices[rows] - truth[rows], axis=1) / head.scale


def test_a_person_is_found_again_from_landmarks_alone() -> None:
    _, truth = person()
    head = place(TEMPLATE, (landmark_data(TEMPLATE, network(truth), 5e-4),))
    assert np.median(off(head, truth)) < 1.0e-3 and np.median(head.residual) < 5e-4
    start = place(TEMPLATE, (landmark_data(TEMPLATE, network(truth), 1.0),))  # no identity, only the similarity
    assert np.median(off(start, truth)) > 2 * np.median(off(head, truth))


def test_the_mean_head_at_its_own_landmarks_is_exact() -> None:
    truth = apply(WORLD, TEMPLATE.vertices)
    head = place(TEMPLATE, (landmark_data(TEMPLATE, network(truth), 1e-3),))
    np.testing.assert_allclose(head.vertices, truth, atol=1e-6)
    np.testing.assert_allclose(head.world_from_template, WORLD, atol=1e-6)
    assert np.abs(head.weights).max() < 1e-5 and head.scale == pytest.approx(1.57, abs=1e-6)


def test_surface_points_give_the_shape_that_landmarks_do_not() -> None:
    _, truth = person(5)
    marks = landmark_data(TEMPLATE, network(truth), 2e-3)
    first = place(TEMPLATE, (marks,))
    rows = face_rows()
    normals = vertex_normals(truth, TEMPLATE.triangles()).astype(np.float64)[rows]
    one = np.tile([1.0, 0.0, 0.0], (len(rows), 1))
    points = Data(np.stack([rows] * 3, 1), one, truth[rows], np.full(len(rows), 1e-3), normals)
    second = place(TEMPLATE, (marks, points), first)
    assert np.median(off(second, truth)) < 0.5 * np.median(off(first, truth))


def test_a_third_of_wrong_landmarks_hardly_moves_the_head() -> None:
    _, truth = person(7)
    marks = network(truth)
    clean = place(TEMPLATE, (landmark_data(TEMPLATE, marks, 2e-3),))
    rng = np.random.default_rng(0)
    wrong = rng.choice(TEMPLATE.landmarks.network, len(TEMPLATE.landmarks.network) // 3, replace=False)
    marks[wrong] += 1.57 * 0.05 * rng.standard_normal((len(wrong), 3))
    head = place(TEMPLATE, (landmark_data(TEMPLATE, marks, 2e-3),))
    assert np.median(off(head, truth)) < np.median(off(clean, truth)) + 1.5e-3


def test_the_normal_equations_are_those_of_finite_differences() -> None:
    """The gradient of E, by central differences of the residuals in float64."""
    assert TEMPLATE.shape is not None
    _, truth = person(9)
    marks = landmark_data(TEMPLATE, network(truth), 2e-3)
    basis = TEMPLATE.shape.basis * TEMPLATE.shape.deviation[:, None, None]
    weights = np.zeros(len(basis))
    world = similarity(1.5, Rotation.from_euler("xyz", [0.38, -1.05, 0.22]).as_matrix(), np.array([0.29, -0.2, 1.1]))
    _, right = _normal_equations(TEMPLATE, [_moves(basis, marks)], (marks,), world, weights)

    def residuals(step: F64) -> F64:
        turn = similarity(float(np.exp(step[6])), Rotation.from_rotvec(step[:3]).as_matrix(), step[3:6])
        there = apply(turn @ np.linalg.inv(world), marks.where)
        shape = TEMPLATE.identity(weights + step[7:])
        return np.asarray((shape[marks.corners] * marks.weights[..., None]).sum(1) - there, np.float64)

    start = residuals(np.zeros(7 + len(weights)))
    inlier = 1 / (1 + (np.linalg.norm(start, axis=1) / (2.0 * marks.sigma)) ** 2) / marks.sigma**2
    for k in (0, 2, 4, 6, 7, 20):
        step = np.zeros(7 + len(weights))
        step[k] = 1e-6
        slope = (residuals(step) - residuals(-step)) / 2e-6
        assert right[k] == pytest.approx(-float((inlier[:, None] * slope * start).sum()), rel=1e-5, abs=1e-6)


def test_the_scale_s_deviation_falls_with_more_certain_landmarks() -> None:
    _, truth = person(11)
    found = [place(TEMPLATE, (landmark_data(TEMPLATE, network(truth), s),)).scale_deviation for s in (5e-3, 5e-4)]
    assert 0 < found[1] < found[0] < 0.1


def test_too_few_and_broken_landmarks_are_refused() -> None:
    _, truth = person()
    marks = landmark_data(TEMPLATE, network(truth), 1e-3)
    few = Data(marks.corners[:5], marks.weights[:5], marks.where[:5], marks.sigma[:5])
    with pytest.raises(StageError, match="5 landmarks"):
        place(TEMPLATE, (few,))
    broken = Data(marks.corners, marks.weights, np.full_like(marks.where, np.nan), marks.sigma)
    with pytest.raises(StageError, match="not finite"):
        place(TEMPLATE, (broken,))
