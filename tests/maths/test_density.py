"""Density, weights and opacity against scipy and integrals, and at the extremes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import laplace

from pipeline.maths import density


def test_density_is_the_laplace_cdf() -> None:
    s, beta = np.linspace(-5, 5, 101), 0.7
    found = density.laplace_density(torch.from_numpy(s), torch.tensor(beta, dtype=torch.float64)).numpy()
    assert found == pytest.approx(laplace.cdf(-s, scale=beta) / beta, abs=1e-14)


@pytest.mark.parametrize("beta", [1e-9, 1e-3, 1e3])
def test_density_and_its_gradient_at_the_extremes(beta: float) -> None:
    s = torch.tensor([-1e6, -1.0, 0.0, 1.0, 1e6], requires_grad=True)
    b = torch.tensor(beta, requires_grad=True)
    sigma = density.laplace_density(s, b)
    sigma.sum().backward()
    at, width = s.detach().double().numpy(), float(b.detach())
    assert np.allclose(sigma.detach().numpy(), laplace.cdf(-at, scale=width) / width, rtol=1e-6)
    slope = -laplace.pdf(at, scale=width) / width
    slope[2] = 0  # at 0 itself autograd takes the slope of |s|, which is 0
    assert np.allclose(s.grad.numpy(), slope, rtol=1e-5)
    by_width = -at / width**2 * laplace.pdf(at, scale=width) * -1 / width - laplace.cdf(-at, scale=width) / width**2
    assert float(b.grad) == pytest.approx(by_width.sum(), rel=1e-4)


def test_ray_weights_are_the_integral_of_eq_18() -> None:
    """Fine quadrature of sigma T against scipy's, for a ray that crosses a soft surface at t = 1."""
    beta = torch.tensor(0.05, dtype=torch.float64)

    def sigma(t: float) -> float:
        return float(density.laplace_density(torch.tensor(1 - t, dtype=torch.float64), beta))

    t = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000 * 1.2
    w, tau = density.ray_weights(density.laplace_density(1 - t, beta)[None], torch.full((1, 4000), 0.0003).double())
    expected_tau = quad(sigma, 0, 1.2, points=[1.0])[0]
    assert float(tau) == pytest.approx(expected_tau, rel=1e-4)
    mean_t = float((w * t).sum())
    expected = quad(lambda x: x * sigma(x) * math.exp(-quad(sigma, 0, x)[0]), 0, 1.2, points=[0.9, 1.0], limit=60)[0]
    assert mean_t == pytest.approx(expected, rel=1e-3)
    assert float(w.sum()) == pytest.approx(1 - math.exp(-expected_tau), rel=1e-4)


@pytest.mark.parametrize("length", [0.001, 0.01, 0.1])
def test_grazing_opacity_does_not_depend_on_the_path(length: float) -> None:
    """A ray that touches the zero set is half covered, however flat the surface: the Laplace density is not."""
    beta = torch.tensor(0.0006, dtype=torch.float64)
    x = torch.linspace(-0.02, 0.02, 2001, dtype=torch.float64)[None]
    s = x * x / length  # distance along a line that touches a surface of this curvature
    _, tau = density.crossing_weights(s, beta)
    assert float(-torch.expm1(-tau)) == pytest.approx(0.5, abs=1e-9)


def test_laplace_density_is_biased_at_grazing_by_what_is_stated() -> None:
    beta, span = 0.0006, 0.02
    offset = beta * math.log(span / (1.4 * beta))
    sigma = density.laplace_density(torch.full((1, 1), offset).double(), torch.tensor(beta).double())
    _, tau = density.ray_weights(sigma, torch.full((1, 1), span).double())
    assert float(-torch.expm1(-tau)) == pytest.approx(0.5, abs=0.02)


def test_mean_crossing_lies_on_the_zero_set() -> None:
    beta = torch.tensor(0.05, dtype=torch.float64)
    t = torch.linspace(0, 2, 401, dtype=torch.float64)[None]
    for slope in (1.0, 0.3):
        w, tau = density.crossing_weights(slope * (1 - t), beta)
        assert float((w * t).sum() / w.sum()) == pytest.approx(1.0, abs=2e-3)
        assert float(w.sum()) == pytest.approx(float(-torch.expm1(-tau)), abs=1e-6)


def test_only_the_first_surface_counts() -> None:
    s = torch.tensor([[1.0, 0.5, -0.5, -1.0, -0.5, 0.5, 1.0, -1.0]], dtype=torch.float64)
    w, _ = density.crossing_weights(s, torch.tensor(0.05, dtype=torch.float64))
    assert float(w[0, :4].sum() / w.sum()) > 0.9999


def test_crossing_is_finite_deep_inside_and_far_outside() -> None:
    s = torch.tensor([[1e6, 1e6], [-1e6, -1e6], [1e-9, -1e-9]], requires_grad=True)
    w, tau = density.crossing_weights(s, torch.tensor(1e-4))
    (w.sum() + tau.sum()).backward()
    assert torch.equal(w[0], torch.zeros(2)) and float(tau[0]) == 0, "nothing is met"
    # in the solid from the start: all weight at once, and as deep as float32 can say, -ln of its smallest number
    assert float(w[1].sum()) == 1 and float(tau[1]) == pytest.approx(126 * math.log(2), rel=1e-3)
    assert float(tau[2]) == pytest.approx(math.log(2) + 1e-5, rel=1e-4) and torch.isfinite(s.grad).all()


def test_cross_entropy_matches_the_textbook_form() -> None:
    tau = torch.tensor([0.01, 0.3, 2.0, 3.4], dtype=torch.float64)
    alpha = torch.tensor([0.0, 0.25, 0.5, 1.0], dtype=torch.float64)
    expected = torch.nn.functional.binary_cross_entropy(-torch.expm1(-tau), alpha, reduction="none")
    assert torch.allclose(density.opacity_cross_entropy(tau, alpha), expected, atol=1e-12)


def test_cross_entropy_keeps_its_gradient_where_opacity_saturates() -> None:
    tau = torch.tensor([0.0, 1e-30, 60.0, 1e4], requires_grad=True)
    loss = density.opacity_cross_entropy(tau, torch.tensor([1.0, 0.5, 0.0, 0.0]))
    loss.sum().backward()
    assert torch.isfinite(loss).all() and torch.isfinite(tau.grad).all()
    assert (tau.grad[2:] == 1).all()


def test_a_covered_ray_asks_for_nothing() -> None:
    tau = torch.tensor([3.6, 50.0], requires_grad=True)
    density.opacity_cross_entropy(tau, torch.ones(2)).sum().backward()
    assert (tau.grad == 0).all()
