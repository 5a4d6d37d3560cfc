"""Harmonics as sums of powers, against the recurrence, quadrature, and what is known of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.maths.sh import sh_basis
from pipeline.maths.sh_monomials import monomials


def values(order: int, d: np.ndarray) -> np.ndarray:
    """(N, (order + 1)^2) by the terms alone."""
    return np.stack([sum(c * np.prod(d ** np.array(p), axis=1) for c, *p in terms) for terms in monomials(order)], 1)


@pytest.mark.parametrize("order", [0, 3, 5])
def test_they_are_those_of_the_recurrence(order: int) -> None:
    d = np.random.default_rng(1).normal(size=(200, 3))
    d = np.concatenate([d / np.linalg.norm(d, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    np.testing.assert_allclose(values(order, d), sh_basis(torch.from_numpy(d), order).numpy(), atol=1e-6)


def test_they_are_orthonormal() -> None:
    """Quadrature: Gauss-Legendre in z, even steps around, exact for these degrees."""
    z, wz = np.polynomial.legendre.leggauss(12)
    turn = 2 * np.pi * np.arange(24) / 24
    ring = np.sqrt(1 - z * z)
    d = np.stack([np.outer(ring, np.cos(turn)), np.outer(ring, np.sin(turn)), np.outer(z, np.ones(24))], -1)
    y = values(5, d.reshape(-1, 3))
    weights = np.repeat(wz, 24) * 2 * np.pi / 24
    np.testing.assert_allclose(y.T @ (weights[:, None] * y), np.eye(36), atol=1e-12)


def test_the_first_are_a_constant_and_y_z_x() -> None:
    first, second, third, fourth = monomials(1)
    assert first == [(pytest.approx(0.282095, abs=1e-6), 0, 0, 0)]
    axis = pytest.approx(0.488603, abs=1e-6)
    assert (second, third, fourth) == ([(axis, 0, 1, 0)], [(axis, 0, 0, 1)], [(axis, 1, 0, 0)])
