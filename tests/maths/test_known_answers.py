"""Answers that are known without the code: furnaces, matt spheres, mirrors, slabs, and rays on simple shapes."""

from __future__ import annotations

import math

import pytest
import torch

from pipeline.maths import brdf, density, sh, tracing, vmf
from tests.maths.test_sh import directions, sphere_quadrature

F64 = torch.float64


def even_light(order: int = 10) -> torch.Tensor:
    c = torch.zeros(sh.count(order), 3, dtype=F64)
    c[0] = math.sqrt(4 * math.pi)
    return c


@pytest.mark.parametrize("kind", sorted(vmf.ATTENUATIONS))
@pytest.mark.parametrize("s", [1e-8, 0.02, 0.5, 10.0, 1e6])
def test_white_furnace(kind: str, s: float) -> None:
    """Under radiance 1 from everywhere a white matt skin sends 1, a perfect lobe 1, and skin whose diffuse and specular
    shares add up to at most 1 sends no more than 1, at every angle."""
    n, wo = directions(200), directions(200, 1)
    incident = brdf.light_integral(brdf.reflect(wo, n), torch.full((200,), s, dtype=F64), even_light(), kind)
    assert torch.allclose(incident, torch.ones_like(incident), atol=1e-9)
    white = brdf.diffuse(torch.ones(200, 3, dtype=F64), n, even_light())
    assert torch.allclose(white, torch.ones_like(white), atol=1e-9)
    share = torch.rand(200, generator=torch.Generator().manual_seed(0), dtype=F64)
    both = brdf.diffuse((1 - share)[:, None].expand(-1, 3), n, even_light()) + brdf.specular(
        share, torch.ones_like(share), incident
    )
    assert both.max() <= 1 + 1e-9


def test_matt_sphere_under_each_harmonic() -> None:
    """E(n) under every single Y_lm up to order 16, by quadrature over the hemisphere of each n."""
    d, w = sphere_quadrature(80)
    n = directions(6, 1)
    basis = sh.sh_basis(d, 16)
    expected = ((n @ d.T).clamp(min=0) * w) @ basis
    for k in range(sh.count(16)):
        one = torch.zeros(sh.count(16), 3, dtype=F64)
        one[k] = 1
        assert torch.allclose(sh.irradiance(one, n)[:, 0], expected[:, k], atol=5e-4)


@pytest.mark.parametrize("kind", sorted(vmf.ATTENUATIONS))
def test_mirror_limit(kind: str) -> None:
    """kappa -> infinity: the light itself, seen in the mirror's direction; at 0 exactly and at 1e-8 nearly."""
    c = 0.1 * torch.randn(121, 3, generator=torch.Generator().manual_seed(2), dtype=F64) + even_light() * 3
    n, wo = directions(50), directions(50, 1)
    w_r = brdf.reflect(wo, n)
    for s, atol in ((0.0, 1e-12), (1e-8, 1e-5)):
        found = brdf.light_integral(w_r, torch.full((50,), s, dtype=F64), c, kind)
        assert torch.allclose(found, sh.radiance(c, w_r).clamp(min=0), atol=atol)


def test_phong_attenuation_is_the_lobes() -> None:
    """E[P_l] under cos^p by quadrature, for lobes sharp enough for the published approximation."""
    from numpy.polynomial.legendre import Legendre, leggauss

    z, w = leggauss(400)
    for p in (30.0, 100.0):
        lobe = w * (z.clip(min=0) ** p)
        lobe /= lobe.sum()
        found = vmf.attenuation_phong(torch.tensor([1 / p], dtype=F64), 10)[0].numpy()
        for l in range(11):  # noqa: E741
            assert found[l] == pytest.approx((lobe * Legendre.basis(l)(z)).sum(), abs=0.07 if p < 50 else 0.03)


@pytest.mark.parametrize("sigma", [1e-3, 1.0, 50.0])
def test_slab_transmittance(sigma: float) -> None:
    """Beer and Lambert: 1 - T = 1 - exp(-sigma L), however the slab is cut, and w_i = the slices' shares."""
    for cut in (1, 7, 128):
        delta = torch.full((1, cut), 2.0 / cut, dtype=F64)
        w, tau = density.ray_weights(torch.full((1, cut), sigma, dtype=F64), delta)
        assert float(tau) == pytest.approx(2 * sigma) and float(w.sum()) == pytest.approx(-math.expm1(-2 * sigma))
        edge = torch.exp(-sigma * torch.linspace(0, 2, cut + 1, dtype=F64))
        assert torch.allclose(w[0], edge[:-1] - edge[1:], atol=1e-12)


# ------------------------------------------------------------------ aggressive sphere tracing
def ball(p: torch.Tensor) -> torch.Tensor:
    return p.norm(dim=-1) - 0.1


def shoot(o: list[float], d: list[float], sdf: object = ball, **kw: float) -> tuple[float, bool, float]:
    origin = torch.tensor([o], dtype=F64)
    way = torch.nn.functional.normalize(torch.tensor([d], dtype=F64), dim=-1)
    near, far = tracing.sphere_interval(origin, way, torch.zeros(3, dtype=F64), 0.2)
    t, hit, s = tracing.aggressive_trace(
        sdf, origin, way, near, far, threshold=5e-5, truncation=0.05, **kw  # type: ignore[arg-type]
    )  # fmt: skip
    return float(t), bool(hit), float(s)


def test_straight_on() -> None:
    t, hit, s = shoot([0, 0, 1], [0, 0, -1])
    assert hit and t == pytest.approx(0.9, abs=6e-5) and abs(s) < 5e-5


@pytest.mark.parametrize("x", [0.05, 0.09, 0.0999, 0.09999])
def test_slanting_and_nearly_grazing(x: float) -> None:
    t, hit, s = shoot([x, 0, 1], [0, 0, -1])
    assert hit and abs(s) < 5e-5
    assert t == pytest.approx(1 - math.sqrt(0.01 - x * x), abs=4e-3 if x > 0.099 else 2e-4)


def test_passing_by() -> None:
    t, hit, s = shoot([0.12, 0, 1], [0, 0, -1])
    assert not hit and s == pytest.approx(0.02, abs=0.004) and t == pytest.approx(1, abs=0.05)


def test_touching_counts_as_a_hit_or_a_near_miss_but_ends() -> None:
    t, hit, s = shoot([0.1, 0, 1], [0, 0, -1])
    assert abs(s) < 1e-3 and math.isfinite(t)


def test_a_start_inside_is_unhit() -> None:
    """The paper's rule for the prior's back space."""
    assert not shoot([0, 0, 0.05], [0, 0, -1])[1]
    assert not shoot([0, 0, 0], [0, 0, 1])[1]


def test_missing_the_sphere_of_the_prior() -> None:
    origin, way = torch.tensor([[0.3, 0, 1.0]]).double(), torch.tensor([[0.0, 0, -1]]).double()
    near, far = tracing.sphere_interval(origin, way, torch.zeros(3, dtype=F64), 0.2)
    assert (far <= near).all() and torch.isfinite(near).all() and torch.isfinite(far).all()


def test_an_overshooting_step_comes_back() -> None:
    """Factor 1.2 steps through a wall and returns; an SDF half as steep, and one a fifth too steep, converge too."""
    for slope in (0.5, 1.0, 1.2):
        t, hit, _ = shoot([0, 0, 1], [0, 0, -1], lambda p, k=slope: k * (p[:, 2] - 0.03))
        assert hit and t == pytest.approx(0.97, abs=2e-4)


def test_the_clamp_keeps_a_first_step_from_jumping_over_a_thin_head() -> None:
    """A distance three times too long, as networks give far from the surface: without the clamp the far side is hit or
    the ray gets lost."""

    def thin(p: torch.Tensor) -> torch.Tensor:
        s = p[:, 2].abs() - 0.01
        return torch.where(s > 0.08, 3 * s, s)

    t, hit, _ = shoot([0, 0, 1], [0, 0, -1], thin)
    assert hit and t == pytest.approx(0.99, abs=1e-3)
    origin, way = torch.tensor([[0.0, 0, 1.0]]).double(), torch.tensor([[0.0, 0, -1]]).double()
    near, far = tracing.sphere_interval(origin, way, torch.zeros(3, dtype=F64), 0.2)
    t, hit, _ = tracing.aggressive_trace(thin, origin, way, near, far, threshold=5e-5, truncation=10.0)
    assert not bool(hit) or float(t) != pytest.approx(0.99, abs=1e-3)


@pytest.mark.parametrize("radius", [0.01, 1.0, 50.0])
def test_the_sphere_is_met_up_to_its_edge_at_any_size(radius: float) -> None:
    """At 0.99 of the radius beside the axis the chord is 2 sqrt(1 - 0.99^2) radii long, at 1.01 there is none."""
    o = radius * torch.tensor([[0.99, 0, 3.0], [1.01, 0, 3.0]], dtype=F64)
    d = torch.tensor([[0.0, 0, -1]], dtype=F64).expand(2, 3)
    near, far = tracing.sphere_interval(o, d, torch.zeros(3, dtype=F64), radius)
    assert ((far - near) / radius).tolist() == pytest.approx([2 * math.sqrt(1 - 0.99**2), 0], abs=1e-9)


def test_sphere_interval_is_exact_from_far_away() -> None:
    """A camera at 1,000 radii, in float32: |o|^2 - b^2 would have no digits left."""
    o, d = torch.tensor([[0.1, 0, 200.0]]), torch.tensor([[0.0, 0, -1]])
    near, far = tracing.sphere_interval(o, d, torch.zeros(3), 0.2)
    half = math.sqrt(0.04 - 0.01)
    assert float(far - near) == pytest.approx(2 * half, rel=1e-3)
