"""Factors of sparse positive definite matrices against dense solutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array, csr_array, diags_array, kron
from scipy.sparse.linalg import splu
from support.ball_head import ball_scan

from pipeline.maths.sparse import factorised
from pipeline.smoothing import laplacian


@pytest.mark.parametrize("kind", ["real", "complex"])
def test_solutions_are_those_of_dense_matrices(kind: str) -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(40, 40)) * (rng.random((40, 40)) < 0.1) + (
        1j * rng.normal(size=(40, 40)) if kind == "complex" else 0
    )
    matrix = a.conj().T @ a + 0.1 * np.eye(40)
    right = rng.normal(size=(40, 3)) + (1j * rng.normal(size=(40, 3)) if kind == "complex" else 0)
    for form in (csr_array, coo_array):
        np.testing.assert_allclose(factorised(form(matrix)).solve(right), np.linalg.solve(matrix, right), rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_of_a_surface_at_extreme_scales(scale: float) -> None:
    """A Laplacian plus a mass: the constant is its eigenvector."""
    mesh = ball_scan(0.1, 12)
    mass, k = laplacian(mesh)
    found = factorised(scale * (diags_array(mass) + 1e-4 * k)).solve(scale * mass)
    np.testing.assert_allclose(found, 1, rtol=1e-9)


def test_the_fill_in_is_far_less_than_the_default() -> None:
    """Of two coupled fields on a surface, as F0 and roughness are: .66 of it here, .40 on a head."""
    mass, k = laplacian(ball_scan(0.1, 24))
    system = kron([[1, -0.5], [-0.5, 1]], diags_array(mass) + 1e-4 * k).tocsc()
    own, default = factorised(system), splu(system)
    assert own.L.nnz + own.U.nnz < 0.75 * (default.L.nnz + default.U.nnz)
