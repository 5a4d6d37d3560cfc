"""Outgoing radiance against integrals that know nothing of the closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipeline.maths import brdf, sh
from tests.maths.test_sh import directions, sphere_quadrature


def test_diffuse_of_an_even_light() -> None:
    """[NeuFace eq. 16]: albedo a under radiance L sends out a L."""
    c = torch.zeros(121, 3)
    c[0] = 3.0 * math.sqrt(4 * math.pi)
    albedo = torch.tensor([[0.2, 0.5, 1.0]])
    assert torch.allclose(brdf.diffuse(albedo, torch.tensor([[0.0, 1, 0]]), c), 3 * albedo, rtol=1e-5)


def test_diffuse_is_never_negative() -> None:
    c = torch.zeros(121, 3)
    c[2] = 5.0  # a light that pulls from -z
    assert (brdf.diffuse(torch.ones(1, 3), torch.tensor([[0.0, 0, -1]]), c) == 0).all()


def test_mirror_direction() -> None:
    wo, n = directions(20), directions(20, 1)
    w_r = brdf.reflect(wo, n)
    assert torch.allclose(w_r.norm(dim=-1), torch.ones(20, dtype=torch.float64))
    assert torch.allclose((w_r * n).sum(-1), (wo * n).sum(-1))
    assert torch.allclose(brdf.reflect(w_r, n), wo)


@pytest.mark.parametrize("kappa", [0.5, 3.0, 12.0])
def test_light_integral_is_the_lobes_mean(kappa: float) -> None:
    """[NeuFace eq. 11] with the exact attenuation: quadrature of vMF times light."""
    c = 0.1 * torch.randn(121, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    c[0] += 5
    w_r = directions(4, 7)
    d, w = sphere_quadrature(48)
    density = kappa / (2 * math.pi * (1 - math.exp(-2 * kappa))) * torch.exp(kappa * (w_r @ d.T - 1))
    expected = (density * w) @ sh.radiance(c, d)
    s = torch.full((4,), 1 / kappa, dtype=torch.float64)
    assert torch.allclose(brdf.light_integral(w_r, s, c, "exact"), expected, atol=2e-5)
    near = brdf.light_integral(w_r, s, c, "exponential")
    assert (near - expected).abs().max() < 0.075 * c[1:].abs().sum()


def test_specular_scales_with_intensity_and_basis() -> None:
    """[NeuFace eq. 12]."""
    found = brdf.specular(torch.tensor([0.5]), torch.tensor([0.4]), torch.tensor([[1.0, 2.0, 3.0]]))
    assert found.numpy() == pytest.approx(np.array([[0.2, 0.4, 0.6]]))


def test_gradients_are_finite_at_grazing_and_at_the_mirror() -> None:
    """They are those of float64, which has digits to spare."""

    def gradients(dtype: torch.dtype) -> list[torch.Tensor]:
        c = torch.randn(121, 3, generator=torch.Generator().manual_seed(0)).to(dtype).requires_grad_()
        n = torch.tensor([[0.0, 0, 1], [0, 0, 1], [1, 0, 0]], dtype=dtype, requires_grad=True)
        wo = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 0, -1]], dtype=dtype)
        s = torch.tensor([0.0, 1e6, 1e-9], dtype=dtype, requires_grad=True)
        out = brdf.light_integral(brdf.reflect(wo, n), s, c) + brdf.diffuse(torch.full((3, 3), 0.5).to(dtype), n, c)
        return [x.double() for x in torch.autograd.grad(out.sum(), [c, n, s])]

    for short, long in zip(gradients(torch.float32), gradients(torch.float64), strict=True):
        assert torch.allclose(short, long, rtol=1e-3, atol=1e-4 * float(long.abs().max())) and long.abs().max() > 0
