"""Attenuation under a vMF lobe against Bessel ratios and quadrature, over the whole range of 1 / kappa."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.polynomial.legendre import leggauss
from scipy.special import ive

from pipeline.maths import brdf, sh, vmf
from tests.maths.test_sh import directions

ORDER = 10
KAPPAS = [1e-6, 1e-3, 0.1, 0.5, 1.44, 2.0, 5.0, 20.0, 100.0, 1e4, 1e8]


@pytest.mark.parametrize("kappa", KAPPAS)
def test_exact_matches_the_bessel_ratio(kappa: float) -> None:
    l = np.arange(ORDER + 1)  # noqa: E741
    expected = ive(l + 0.5, kappa) / ive(0.5, kappa)
    found = vmf.attenuation_exact(torch.tensor([1 / kappa], dtype=torch.float64), ORDER)[0].numpy()
    assert found == pytest.approx(expected, abs=5e-6)
    assert vmf.attenuation_exact(torch.tensor([1 / kappa]), ORDER)[0].numpy() == pytest.approx(expected, abs=8e-6)


@pytest.mark.parametrize("kappa", [0.5, 2.0, 20.0, 200.0])
def test_exact_is_the_mean_of_legendre_under_the_lobe(kappa: float) -> None:
    """[NeuFace eq. 26] by quadrature: E[P_l(w . w_r)] for the density of [NeuFace eq. 25]."""
    z, w = leggauss(400)
    density = np.exp(kappa * (z - 1))
    density /= (w * density).sum()
    found = vmf.attenuation_exact(torch.tensor([1 / kappa], dtype=torch.float64), ORDER)[0].numpy()
    for l in range(ORDER + 1):  # noqa: E741
        assert found[l] == pytest.approx((w * density * np.polynomial.legendre.Legendre.basis(l)(z)).sum(), abs=5e-6)


def test_ends_of_the_range() -> None:
    for function in vmf.ATTENUATIONS.values():
        mirror = function(torch.tensor([0.0]), ORDER)[0]
        assert torch.equal(mirror, torch.ones(ORDER + 1))
        rough = function(torch.tensor([1e12]), ORDER)[0]
        assert rough[0] == 1 and rough[1:].max() < 1e-6 and torch.isfinite(rough).all()
        infinite = torch.tensor([float("inf")], requires_grad=True)
        even = function(infinite, ORDER)[0]
        assert even.tolist() == [1.0] + [0.0] * ORDER
        (slope,) = torch.autograd.grad(even.sum(), infinite)
        assert float(slope) == 0


@pytest.mark.parametrize("kind", ["exponential", "exact"])
def test_falls_with_order_and_with_width(kind: str) -> None:
    a = vmf.ATTENUATIONS[kind](torch.logspace(-6, 4, 200, dtype=torch.float64), ORDER)
    assert (a.diff(dim=1) <= 0).all() and (a.diff(dim=0) <= 1e-15).all() and a.min() >= 0 and a.max() <= 1


@pytest.mark.parametrize("kind", ["exponential", "exact"])
def test_derivative(kind: str) -> None:
    s = torch.tensor([1e-3, 0.05, 0.7, 3.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: vmf.ATTENUATIONS[kind](x, ORDER), s)
    edge = torch.tensor([0.0, 1e-30, 1e30], requires_grad=True)
    (g,) = torch.autograd.grad(vmf.ATTENUATIONS[kind](edge, ORDER).sum(), edge)
    assert torch.isfinite(g).all()


def test_the_published_form_of_phongs_attenuation() -> None:
    """log A_l = -l^2 / 2 p, by numbers: p = 1/2 gives e^-1, e^-4, e^-9, p = 2 their fourth roots."""
    for p in (0.5, 2.0):
        found = vmf.attenuation_phong(torch.tensor([1 / p], dtype=torch.float64), 3)[0].numpy()
        assert found == pytest.approx(np.array([1.0, 0.36787944, 0.01831564, 0.00012341]) ** (0.5 / p), rel=1e-4)


def test_error_of_the_papers_form_is_as_stated() -> None:
    """The docstring's bound, and the O(kappa^-2) of the paper: kappa^2 x error tends to l (l + 1) / 4."""
    s = torch.logspace(-2, 2, 2000, dtype=torch.float64)
    error = (vmf.attenuation_exponential(s, ORDER) - vmf.attenuation_exact(s, ORDER)).abs()
    assert 0.07 < error.max() < 0.0755
    large = torch.tensor([1e-4], dtype=torch.float64)
    found = (vmf.attenuation_exact(large, 1) - vmf.attenuation_exponential(large, 1)).abs()[0, 1] / large[0] ** 2
    assert float(found) == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("inv_kappa", [0.02, 0.1, 0.5, 1e3])
def test_a_distant_light_through_a_lobe_is_the_lobes_density(inv_kappa: float) -> None:
    """[NeuFace eq. 10]: light E from one direction alone has c_lm = E Y_lm there; through the lobe it is E D(w_r), the
    vMF density in closed form. At 1/kappa = 1,000 nothing of the direction is left: E / (4 pi) from everywhere."""
    order = 40 if inv_kappa < 0.05 else 20
    to, e = directions(1)[0], torch.tensor([2.0, 1.0, 0.5], dtype=torch.float64)
    c = sh.sh_basis(to[None], order).T * e
    w_r = torch.nn.functional.normalize(to + 0.4 * min(inv_kappa, 1) ** 0.5 * directions(30, 3), dim=-1)
    kappa = 1 / inv_kappa
    density = kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * torch.exp(kappa * (w_r @ to - 1))
    found = brdf.light_integral(w_r, torch.full((30,), inv_kappa, dtype=torch.float64), c, "exact")
    assert torch.allclose(found, density[:, None] * e, rtol=0.005, atol=5e-4 * float(density.max()))
