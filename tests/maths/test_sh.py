"""Spherical harmonics against scipy, quadrature and float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.polynomial.legendre import leggauss
from scipy.special import sph_harm_y

from pipeline.maths import sh

ORDER = 10


def directions(n: int, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=torch.float64), dim=-1)


def scipy_basis(d: np.ndarray, order: int) -> np.ndarray:
    theta, phi = np.arccos(d[:, 2].clip(-1, 1)), np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for l in range(order + 1):  # noqa: E741
        for m in range(-l, l + 1):
            y = sph_harm_y(l, abs(m), theta, phi) * (-1) ** abs(m)
            columns.append(y.real if m == 0 else math.sqrt(2) * (y.real if m > 0 else y.imag))
    return np.stack(columns, 1)


def sphere_quadrature(n: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions and weights, exact for polynomials of degree 2 n - 1."""
    z, wz = leggauss(n)
    phi = 2 * np.pi * np.arange(2 * n) / (2 * n)
    s = np.sqrt(1 - z**2)
    d = np.stack([np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(z, np.ones(2 * n))], -1).reshape(-1, 3)
    return torch.from_numpy(d), torch.from_numpy(np.repeat(wz, 2 * n) * np.pi / n)


def test_basis_matches_scipy() -> None:
    d = directions(200)
    assert np.abs(sh.sh_basis(d, ORDER).numpy() - scipy_basis(d.numpy(), ORDER)).max() < 1e-13


def test_float32_error_is_small() -> None:
    d = directions(2000)
    error = sh.sh_basis(d.float(), ORDER).double() - sh.sh_basis(d.float().double(), ORDER)
    assert error.abs().max() < 5e-6


def test_orthonormal() -> None:
    d, w = sphere_quadrature()
    y = sh.sh_basis(d, ORDER)
    assert torch.allclose((y * w[:, None]).T @ y, torch.eye(121, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("pole", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0)])
def test_values_and_derivatives_at_the_poles(pole: tuple[int, int, int]) -> None:
    d = torch.tensor([pole], dtype=torch.float64, requires_grad=True)
    y = sh.sh_basis(d, ORDER)
    assert np.abs(y.detach().numpy() - scipy_basis(d.detach().numpy(), ORDER)).max() < 1e-12
    (g,) = torch.autograd.grad(y.sum(), d)
    assert torch.isfinite(g).all()


def test_derivatives_by_finite_differences() -> None:
    d = directions(3).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: sh.sh_basis(x, 6), d)


def test_clamped_cosine_is_the_lobes_projection() -> None:
    """[NeuFace eq. 15] against Gauss-Legendre quadrature of the half-cosine times P_l."""
    z, w = leggauss(200)
    z, w = 0.5 * (z + 1), 0.5 * w  # the hemisphere
    found = sh.clamped_cosine(ORDER)
    for l in range(ORDER + 1):  # noqa: E741
        expected = 2 * np.pi * (w * z * np.polynomial.legendre.Legendre.basis(l)(z)).sum()
        assert found[l * l : (l + 1) ** 2].numpy() == pytest.approx(expected, abs=1e-12)


def test_irradiance_against_an_integral_over_the_hemisphere() -> None:
    """[NeuFace eq. 14]-[NeuFace eq. 16] for random light: an integral that knows nothing of Funk and Hecke.

    The light is of order 10 but the cosine is not; only the first 11 bands of both meet, so the match is exact.
    """
    c = torch.randn(121, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    n = directions(5, 3)
    z, wz = leggauss(60)
    phi = 2 * np.pi * np.arange(64) / 64
    z, wz = 0.5 * (z + 1), 0.5 * wz
    s = np.sqrt(1 - z**2)
    local = np.stack([np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(z, np.ones(64))], -1).reshape(-1, 3)
    weight = np.repeat(z * wz, 64) * 2 * np.pi / 64
    for row, found in zip(n, sh.irradiance(c, n), strict=True):
        q, _ = np.linalg.qr(np.c_[row.numpy(), np.eye(3)[:, :2]])
        frame = np.stack([q[:, 1], q[:, 2], row.numpy()], 1)
        light = sh.radiance(c, torch.from_numpy(local @ frame.T)).numpy()
        assert found.numpy() == pytest.approx((weight[:, None] * light).sum(0), abs=1e-9)


def test_constant_light_gives_pi_times_its_radiance() -> None:
    c = torch.zeros(121, 3)
    c[0] = 2.0 * math.sqrt(4 * math.pi)
    assert torch.allclose(sh.irradiance(c, directions(4).float()), torch.full((4, 3), 2 * math.pi), rtol=1e-5)


@pytest.mark.parametrize("order", [1, 4, 10])
@pytest.mark.parametrize("n", [1, 128, 300])
def test_compiled_contraction_matches_the_reference(order: int, n: int) -> None:
    if sh.compiled is None:
        pytest.skip("numba is not installed: there is no compiled contraction")
    g = torch.Generator().manual_seed(order)
    c = torch.randn((order + 1) ** 2, 3, generator=g)
    d, upstream = directions(n).float().detach(), torch.randn(n, order + 1, 3, generator=g)
    results = []
    for function, kind in (
        (lambda c, d: sh.band_radiance(c, d), torch.float32),
        (lambda c, d: sh.band_radiance_reference(c, d, order), torch.float64),
    ):
        cc, dd = c.clone().to(kind).requires_grad_(), d.clone().to(kind).requires_grad_()
        out = function(cc, dd)
        (out * upstream).sum().backward()
        results.append((out.detach().double(), cc.grad.double(), dd.grad.double()))
    for found, expected in zip(*results, strict=True):
        assert (found - expected).abs().max() < 3e-6 * expected.abs().max()


def test_wrong_length_is_named() -> None:
    with pytest.raises(ValueError, match="120 SH coefficients"):
        sh.order_of(torch.zeros(120, 3))
