"""kappa, alpha, energy and F0 against quadrature of the microfacet model itself."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.maths import microfacet


def ggx_energy(alpha: float) -> float:
    """E_ss at n.v = 1: the integral of D (h.n) G2 over half vectors whose mirror direction is above the surface."""
    h = np.linspace(0, np.pi / 4, 100_001)
    d = alpha**2 / (np.pi * (np.cos(h) ** 2 * (alpha**2 - 1) + 1) ** 2)
    slope = np.tan(np.minimum(2 * h, np.pi / 2 - 1e-9))
    shadow = 0.5 * (np.sqrt(1 + (alpha * slope) ** 2) - 1)
    return float(np.trapezoid(d * np.cos(h) * 2 * np.pi * np.sin(h) / (1 + shadow), h))


@pytest.mark.parametrize("alpha", [0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75])
def test_energy_table_is_ggx(alpha: float) -> None:
    assert float(microfacet.energy(alpha)) == pytest.approx(ggx_energy(alpha), abs=5e-3)


def test_alpha_at_known_points_and_beyond() -> None:
    assert float(microfacet.alpha_from_kappa(10.0)) == pytest.approx(0.5407 * 8.483**-0.486, rel=1e-12)
    low, high = microfacet.alpha_from_kappa(2.1), microfacet.alpha_from_kappa(89.0)
    for kappa in (0.0, 1e-9, 1.0, 1.517, 2.0):
        assert microfacet.alpha_from_kappa(kappa) == low
    for kappa in (90.0, 1e6, np.inf):
        assert microfacet.alpha_from_kappa(kappa) == high
    assert 0.69 < low < 0.71 and 0.06 < high < 0.07
    kappa = np.linspace(2.1, 89, 500)
    assert (np.diff(microfacet.alpha_from_kappa(kappa)) < 0).all()
    assert np.abs(microfacet.alpha_from_kappa(kappa[kappa > 20]) - 0.707 / np.sqrt(kappa[kappa > 20])).max() < 0.04


@pytest.mark.parametrize("inv_kappa", [0.0, 1e-12, 1e-3, 0.05, 1.0, 1e9])
def test_roughness_is_finite_everywhere(inv_kappa: float) -> None:
    got = float(microfacet.roughness_from_inv_kappa(inv_kappa))
    assert 0.24 < got < 0.85


def test_roughness_squared_is_alpha() -> None:
    s = np.array([0.02, 0.1, 0.3])
    assert np.allclose(microfacet.roughness_from_inv_kappa(s) ** 2, microfacet.alpha_from_kappa(1 / s))


def test_f0_gives_back_the_energy_along_the_normal() -> None:
    inv_kappa = np.array([0.02, 0.1, 0.4])
    alpha = microfacet.alpha_from_kappa(1 / inv_kappa)
    f0 = microfacet.f0_from_lobe(np.full(3, 0.028), inv_kappa)
    assert np.allclose(f0 * [ggx_energy(float(a)) for a in alpha], 0.028, rtol=5e-3)
    assert (f0 > 0.028).all() and microfacet.f0_from_lobe(-1.0, 0.1) == 0
