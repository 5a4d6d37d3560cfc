"""The spline SDF against scipy's B-splines, finite differences and its own refinement."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from pipeline.maths import sdf

LO, CELL = torch.tensor([-1.0, 0.5, 2.0], dtype=torch.float64), 0.25


def grid(shape: tuple[int, int, int] = (9, 8, 7), seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def inside(n: int, shape: tuple[int, int, int] = (9, 8, 7), seed: int = 1) -> torch.Tensor:
    u = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return LO + CELL * (1.5 + u * (torch.tensor(shape) - 4))


def test_value_matches_scipy_tensor_product() -> None:
    v, x = grid(), inside(40)

    def row(u: float, n: int) -> np.ndarray:
        return np.array([np.nan_to_num(BSpline.basis_element(np.arange(4) - 1.5 + i, False)(u)) for i in range(n)])

    found, _ = sdf.spline_sdf(v, x, LO, CELL)
    for point, value in zip(((x - LO) / CELL).numpy(), found, strict=True):
        wx, wy, wz = (row(point[a], v.shape[a]) for a in range(3))
        assert float(value) == pytest.approx(np.einsum("xyz,x,y,z->", v.numpy(), wx, wy, wz), abs=1e-12)


def test_gradient_is_the_derivative_of_the_value() -> None:
    v, x = grid(), inside(30)
    _, g = sdf.spline_sdf(v, x, LO, CELL)
    h = 1e-6
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = h
        slope = (sdf.spline_sdf(v, x + step, LO, CELL)[0] - sdf.spline_sdf(v, x - step, LO, CELL)[0]) / (2 * h)
        assert torch.allclose(slope, g[:, axis], atol=1e-6)


def test_linear_functions_are_exact() -> None:
    n = torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64)
    i = torch.stack(torch.meshgrid(*[torch.arange(k) for k in (9, 8, 7)], indexing="ij"), -1).double()
    v = ((LO + CELL * i) * n).sum(-1)
    s, g = sdf.spline_sdf(v, inside(20), LO, CELL)
    assert torch.allclose(s, inside(20) @ n, atol=1e-12) and torch.allclose(g, n.expand(20, 3), atol=1e-12)


def test_refinement_keeps_the_function() -> None:
    v, x = grid(), inside(50)
    coarse, fine = sdf.spline_sdf(v, x, LO, CELL), sdf.spline_sdf(sdf.refine(v), x, LO - CELL / 4, CELL / 2)
    assert torch.allclose(coarse[0], fine[0], atol=1e-12) and torch.allclose(coarse[1], fine[1], atol=1e-10)


def test_far_outside_is_finite() -> None:
    """Beyond the grid the border's cell goes on as it is: the value and slope of the nearest place that it covers."""
    v = grid()
    far = torch.tensor([[1e6, -1e6, 0.0], [-9.0, 3.0, 1e9]], dtype=torch.float64)
    s, g = sdf.spline_sdf(v, far, LO, CELL)
    assert torch.isfinite(s).all() and torch.isfinite(g).all()
    assert s.abs().max() <= v.abs().max() and torch.equal(s, sdf.spline_sdf(v, 2 * far, LO, CELL)[0])


def test_unit_is_safe_at_zero() -> None:
    g = torch.zeros(2, 3, requires_grad=True)
    n = sdf.unit(g)
    n.sum().backward()
    assert torch.isfinite(n).all() and torch.isfinite(g.grad).all()
    assert torch.allclose(sdf.unit(torch.tensor([[3.0, 0, 4.0]])), torch.tensor([[0.6, 0, 0.8]]))
