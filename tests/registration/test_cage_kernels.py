"""The compiled solver against a dense solution by numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array, random_array

from pipeline.registration.cage_kernels import solved


@pytest.mark.parametrize("seed", [0, 1])
def test_solution_is_that_of_the_dense_system(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, rows = 30, 50
    some = random_array((count, count), density=0.2, rng=rng)
    alike = csr_array(some @ some.T + 0.5 * csr_array(np.eye(count)))
    stencil = csr_array(random_array((rows, count), density=0.15, rng=rng))
    normals = rng.normal(size=(rows, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights, right = rng.random(rows), rng.normal(size=(count, 3))
    lines = np.einsum("mv,mi->mvi", stencil.toarray(), normals).reshape(rows, -1)
    dense = np.kron(alike.toarray(), np.eye(3)) + lines.T @ (weights[:, None] * lines)
    wanted = np.linalg.solve(dense, right.ravel()).reshape(-1, 3)
    found, steps = solved(alike, stencil, normals, weights, right, np.zeros((count, 3)), 1e-10, 500)
    assert np.abs(found - wanted).max() < 1e-7 and 0 < steps < 500
    again, more = solved(alike, stencil, normals, weights, right, wanted, 1e-2, 500)
    assert np.abs(again - wanted).max() < 1e-6 and more < 500


def test_no_data_and_a_limit_of_steps() -> None:
    alike = csr_array(np.diag([1.0, 2.0, 4.0]))
    none = csr_array((0, 3))
    found, _ = solved(alike, none, np.zeros((0, 3)), np.zeros(0), np.ones((3, 3)), np.zeros((3, 3)), 1e-12, 10)
    assert np.allclose(found, [[1.0] * 3, [0.5] * 3, [0.25] * 3])
    still, steps = solved(alike, none, np.zeros((0, 3)), np.zeros(0), np.ones((3, 3)), np.zeros((3, 3)), 1e-12, 0)
    assert steps == 0 and not still.any()
