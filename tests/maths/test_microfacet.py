"""kappa, alpha, energy and F0 against quadrature of the microfacet model itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.maths import ggx_width, microfacet
from pipeline.transforms import F64


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
    assert float(ggx_width.best_fit_alpha(10.0)) == pytest.approx(0.5407 * 8.483**-0.486, rel=1e-12)
    low, high = ggx_width.best_fit_alpha(2.1), ggx_width.best_fit_alpha(89.0)
    for kappa in (0.0, 1e-9, 1.0, 1.517, 2.0):
        assert ggx_width.best_fit_alpha(kappa) == low
    for kappa in (90.0, 1e6, np.inf):
        assert ggx_width.best_fit_alpha(kappa) == high
    assert 0.69 < low < 0.71 and 0.06 < high < 0.07
    kappa = np.linspace(2.1, 89, 500)
    assert (np.diff(ggx_width.best_fit_alpha(kappa)) < 0).all()
    assert np.abs(ggx_width.best_fit_alpha(kappa[kappa > 20]) - 0.707 / np.sqrt(kappa[kappa > 20])).max() < 0.04


@pytest.mark.parametrize("inv_kappa", [0.0, 1e-12, 1e-3, 0.05, 1.0, 1e9])
def test_roughness_is_finite_everywhere(inv_kappa: float) -> None:
    got = float(microfacet.roughness_from_inv_kappa(inv_kappa))
    assert 0.24 < got < 0.85


def test_roughness_squared_is_alpha() -> None:
    s = np.array([0.02, 0.1, 0.3])
    assert np.allclose(microfacet.roughness_from_inv_kappa(s) ** 2, ggx_width.best_fit_alpha(1 / s))


def test_f0_gives_back_the_energy_along_the_normal() -> None:
    inv_kappa = np.array([0.02, 0.1, 0.4])
    alpha = ggx_width.best_fit_alpha(1 / inv_kappa)
    f0 = microfacet.f0_from_lobe(np.full(3, 0.028), inv_kappa)
    assert np.allclose(f0 * [ggx_energy(float(a)) for a in alpha], 0.028, rtol=5e-3)
    assert (f0 > 0.028).all() and microfacet.f0_from_lobe(-1.0, 0.1) == 0


def hemisphere(steps: int = 700) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) half vectors and their solid angles, by the midpoint rule."""
    polar = (np.arange(steps) + 0.5) / steps * np.pi / 2
    turn = (np.arange(steps) + 0.5) / steps * 2 * np.pi
    t, p = np.meshgrid(polar, turn, indexing="ij")
    h = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    return h, (np.sin(t) * np.pi / 2 * 2 * np.pi / steps**2).ravel()


def reflected(cosine: float, alpha: float, f0: float) -> float:
    """Integral of D F G2 / (4 n.l n.v) n.l over the directions l, written over half vectors (dl = 4 h.v dh)."""
    h, weight = hemisphere()
    v = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    hv = h @ v
    out = 2 * hv * h[:, 2] - cosine
    good = (hv > 0) & (out > 0)
    hv, out, z, weight = hv[good], out[good], h[good, 2], weight[good]
    d = alpha**2 / (np.pi * ((alpha**2 - 1) * z**2 + 1) ** 2)
    smith = lambda c: 0.5 * (np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1)  # noqa: E731
    fresnel = f0 + (1 - f0) * (1 - hv) ** 5
    return float((d * fresnel / (1 + smith(cosine) + smith(out)) * hv / cosine * weight).sum())


@pytest.mark.parametrize("cosine, alpha", [(1.0, 0.3), (0.7, 0.3), (0.3, 0.2), (0.1, 0.4), (0.2, 0.7), (1.0, 0.7)])
@pytest.mark.parametrize("f0", [0.0, 0.04, 1.0])
def test_split_albedo_against_quadrature_over_half_vectors(cosine: float, alpha: float, f0: float) -> None:
    a, b = microfacet.split_albedo(cosine, alpha)
    assert float(f0 * a + b) == pytest.approx(reflected(cosine, alpha, f0), rel=6e-3, abs=2e-4)


def test_split_albedo_at_its_extremes() -> None:
    a, b = microfacet.split_albedo(np.array([1e-6, 1.0]), np.array([[0.01], [1.0]]))
    assert np.isfinite(a).all() and np.isfinite(b).all() and ((a + b) <= 1 + 1e-6).all()
    assert a[0, 1] == pytest.approx(1, abs=1e-3) and b[0, 1] == pytest.approx(0, abs=1e-3)  # a mirror, seen straight on


@pytest.fixture(scope="module")
def attenuations() -> tuple[F64, F64]:
    """Values of alpha, and for each what a GGX lobe, sampled by its visible normals at normal incidence, leaves of the
    bands 1 to 10."""
    from scipy.special import eval_legendre

    u = (np.arange(20_000) + 0.5) / 20_000

    def attenuation(alpha: float) -> F64:
        z = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))  # h.n of the distribution of normals, seen along n
        out = 2 * z * z - 1
        tangent = np.sqrt(np.maximum(1 / np.maximum(out, 1e-6) ** 2 - 1, 0))
        weight = np.where(out > 0, 2 / (1 + np.sqrt(1 + (alpha * tangent) ** 2)), 0.0)
        return np.array([(eval_legendre(band, out) * weight).sum() / weight.sum() for band in range(1, 11)])

    found = np.linspace(0.03, 0.9, 400)
    return found, np.stack([attenuation(float(x)) for x in found])


@pytest.mark.parametrize("kappa", [2.5, 5.0, 10.0, 20.0, 40.0, 80.0])
def test_alpha_is_the_width_that_blurs_light_of_order_10_alike(kappa: float, attenuations: tuple[F64, F64]) -> None:
    """The lobes against the model's attenuation: the alpha with the smallest squared difference under light whose
    bands hold power like 1 / (2 l + 1)."""
    found, left = attenuations
    bands = np.arange(1, 11)
    lobe = np.exp(-bands * (bands + 1) / 2 / kappa)
    misfit = ((left - lobe) ** 2 / (2 * bands + 1)).sum(1)
    assert float(ggx_width.best_fit_alpha(kappa)) == pytest.approx(found[int(np.argmin(misfit))], abs=0.016)
    if kappa >= 10:  # the other width is another relation: its squared error is more than twice as large
        wide = float(ggx_width.gauge_alpha(torch.tensor([1 / kappa]))[0])
        assert np.interp(wide, found, misfit) > 2 * np.interp(float(ggx_width.best_fit_alpha(kappa)), found, misfit)


def test_the_gauge_width_by_hand() -> None:
    """sqrt(1 / (2 kappa)) where the lobe is narrow, and tan^2 of a lobe's spread otherwise: s / (2 + s)."""
    found = ggx_width.gauge_alpha(torch.tensor([2e-4, 0.25, 2.0, 6.0], dtype=torch.float64))
    assert found.numpy() == pytest.approx(
        [0.02 + 0.98 * x for x in (0.0099995, 1 / 3, 0.70710678, 0.8660254)], rel=1e-5
    )
