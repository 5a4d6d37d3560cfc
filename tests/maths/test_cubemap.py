"""The cube map: its geometry by itself, lookups across every edge, blurs against the sphere; and GGX's table."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipeline.fields.paper.cubemap import CubemapLight
from pipeline.maths import cubemap, ggx_width, microfacet, sh, split_sum, vmf
from tests.maths.test_microfacet import ggx_energy
from tests.maths.test_sh import directions


@pytest.mark.parametrize("size", [1, 2, 7, 16])
def test_texels_tile_the_sphere(size: int) -> None:
    area, d = cubemap.solid_angles(size), cubemap.texel_directions(size)
    assert float(area.sum()) == pytest.approx(4 * math.pi) and (area > 0).all()
    assert (area[:, None] * d).sum(0).abs().max() < 1e-12
    face, u, v = cubemap.project(d)
    assert torch.equal(face, torch.arange(6).repeat_interleave(size * size))
    assert u.abs().max() < 1 and v.abs().max() < 1


def test_solid_angles_are_exact() -> None:
    """Against counting random directions."""
    d = torch.nn.functional.normalize(torch.randn(400_000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    face, u, v = cubemap.project(d.double())
    at = (face * 3 + ((v + 1) * 1.5).long().clamp(max=2)) * 3 + ((u + 1) * 1.5).long().clamp(max=2)
    counted = torch.bincount(at, minlength=54).double() / len(d) * 4 * math.pi
    assert torch.allclose(counted, cubemap.solid_angles(3), rtol=0.05)


def jump_at_edges(size: int = 8) -> float:
    """Largest step of a smooth map across the edges of the cube."""
    c = 0.3 * torch.randn(16, 3, generator=torch.Generator().manual_seed(1)).double()
    smooth = sh.radiance(c, cubemap.texel_directions(size))[None]
    edge = torch.tensor([[1.0, 1, t] for t in np.linspace(-0.99, 0.99, 50)], dtype=torch.float64)
    zero, found = torch.zeros(50, dtype=torch.float64), 0.0
    for k in range(3):
        a, b = edge.roll(k, 1).clone(), edge.roll(k, 1).clone()
        a[:, k] += 1e-4
        b[:, k] -= 1e-4
        found = max(found, float((cubemap.lookup(smooth, a, zero) - cubemap.lookup(smooth, b, zero)).abs().max()))
    return found


def test_lookup_at_centres_and_without_seams(monkeypatch: pytest.MonkeyPatch) -> None:
    values = torch.randn(1, 6 * 64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    centres = cubemap.texel_directions(8)
    found = cubemap.lookup(values, centres, torch.zeros(len(centres), dtype=torch.float64))
    assert torch.allclose(found, values[0], atol=1e-9)
    joined = jump_at_edges()
    inner = torch.arange(6 * 64).reshape(6, 8, 8)
    ends = torch.arange(-1, 9).clamp(0, 7)
    monkeypatch.setattr(cubemap, "padded", lambda size: inner[:, ends][:, :, ends])
    assert joined < 0.4 * jump_at_edges(), "the border of the neighbouring face does not help"


def test_extremes_of_a_lookup() -> None:
    """Levels beyond the last are the last, in between is in between, lengths do not count, and at 1e-20, 1e4 and at the
    cube's corners the value is a mean of texels."""
    values = torch.rand(3, 24, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    d = torch.tensor([[1.0, 0, 0], [1, 1, 1], [-1, 1, -1], [1e-20, 0, 1e-20], [0, 0, -1e4]], requires_grad=True)
    level = torch.tensor([0.0, 1, 2, 5, 0.5], requires_grad=True)
    out = cubemap.lookup(values, d, level)
    out.sum().backward()
    assert all(x is not None and bool(torch.isfinite(x).all()) for x in (values.grad, d.grad, level.grad))
    exact, unit = values.detach().double(), torch.nn.functional.normalize(d.detach().double(), dim=-1)
    each = [cubemap.lookup(exact[k : k + 1], unit, torch.zeros(5).double()) for k in range(3)]
    expected = [each[0][0], each[1][1], each[2][2], each[2][3], (each[0][4] + each[1][4]) / 2]
    assert torch.allclose(out.detach().double(), torch.stack(expected), atol=1e-5)
    assert all(m.min() >= exact[k].min() and m.max() <= exact[k].max() for k, m in enumerate(each))
    assert float(values.grad.sum()) == pytest.approx(15, rel=1e-5), "weights of each of 5 lookups add up to 1"


def lit(c: torch.Tensor, lobe: str = "vmf", size: int = 16) -> CubemapLight:
    light = CubemapLight(size, 1.0, lobe)
    radiance = sh.radiance(c, cubemap.texel_directions(size)).float()
    with torch.no_grad():
        light.raw.copy_(torch.log(torch.expm1(radiance)))
    return light


def test_a_map_of_harmonics_shades_as_the_harmonics() -> None:
    """The same light as a map and as coefficients: projection, irradiance, and lobes of every width agree."""
    c = 0.2 * torch.randn(16, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    c[0] += 8
    light = lit(c)
    d = directions(300).float()
    with torch.no_grad():
        assert (light()[:16] - c).abs().max() < 0.03 and light()[16:].abs().max() < 0.03
        assert torch.allclose(light.irradiance(d), sh.irradiance(c.float(), d), rtol=0.01)
        for s in (0.0, 0.05, 0.3, 1.2):
            bands = sh.band_radiance(c.float(), d)
            expected = (vmf.attenuation_exact(torch.full((300,), s), 3)[..., None] * bands).sum(1)
            assert torch.allclose(light.reflected(d, torch.full((300,), s)), expected, rtol=0.03)


@pytest.mark.parametrize("lobe", ["vmf", "ggx"])
def test_an_even_map_is_a_furnace(lobe: str) -> None:
    light = CubemapLight(6, 2.0, lobe)
    d = directions(100).float()
    for width in (0.0, 1e-8, 0.2, 0.9, 1e6):
        out = light.reflected(d, torch.full((100,), width))
        assert torch.allclose(out, torch.full_like(out, 2.0), rtol=1e-5)
    assert torch.allclose(light.irradiance(d), torch.full((100, 3), 2 * math.pi), rtol=1e-4)


def test_every_texel_can_learn() -> None:
    """Under an even light each texel's gradient is in proportion to its solid angle, seen from all directions."""
    light = CubemapLight(4, 1.0, "vmf")
    light.reflected(directions(40_000).float(), torch.full((40_000,), 0.02)).square().mean().backward()
    assert light.raw.grad is not None
    share = cubemap.solid_angles(4) / (4 * math.pi) * 2 / 3 * (1 - math.exp(-1.0))  # softplus' slope where it is 1
    assert torch.allclose(light.raw.grad.double(), share[:, None].expand(-1, 3), rtol=0.25)
    assert float(light.raw.grad.sum()) == pytest.approx(2 * (1 - math.exp(-1.0)), rel=1e-3)


# ------------------------------------------------------------------ GGX's table
@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.5, 0.7])
def test_table_is_the_integral_along_the_normal(alpha: float) -> None:
    """F0 = 1 at n.v near 1: the directional albedo, by a quadrature that shares no code."""
    found = split_sum.environment_brdf(torch.ones(1, 3), torch.ones(1), torch.tensor([alpha]))
    assert float(found[0, 0]) == pytest.approx(ggx_energy(alpha), abs=0.012)
    assert float(found[0, 0]) == pytest.approx(float(microfacet.energy(alpha)), abs=0.015)


def test_table_never_reflects_more_than_comes_in() -> None:
    t = split_sum.table()
    assert (t >= 0).all() and t.sum(-1).max() <= 1.001
    dark = split_sum.environment_brdf(torch.full((32, 3), 0.04), torch.linspace(0, 1, 32), torch.full((32,), 0.2))
    assert dark[0, 0] > 3 * dark[-1, 0], "no rise at grazing"


def test_alpha_grows_with_the_lobe() -> None:
    a = ggx_width.gauge_alpha(torch.tensor([0.0, 1e-8, 1e-3, 0.05, 1.0, 1e6]))
    assert (a.diff() >= 0).all() and float(a[0]) >= 0.02 and float(a[-1]) <= 1.0
    assert float(ggx_width.gauge_alpha(torch.tensor([1e-3]))[0]) == pytest.approx(0.02 + 0.98 * 0.02236, rel=1e-2)


@pytest.mark.parametrize("alpha", [0.1, 0.5, 0.9])
def test_smiths_masking_is_the_share_of_facets_that_a_view_sees(alpha: float) -> None:
    """1 / (1 + Lambda) makes the facets' projected areas add up to the view's: the integral over half vectors of
    D max(v.h, 0) is (1 + Lambda) n.v, by quadrature; and 0.16144 at 60 degrees for alpha = 1/2."""
    theta, phi = np.meshgrid((np.arange(2000) + 0.5) * np.pi / 4000, (np.arange(400) + 0.5) * 2 * np.pi / 400)
    d = alpha**2 / (np.pi * (np.cos(theta) ** 2 * (alpha**2 - 1) + 1) ** 2)
    for angle in (0.0, np.pi / 6, np.pi / 3, 1.4):
        v = np.sin(angle) * np.sin(theta) * np.cos(phi) + np.cos(angle) * np.cos(theta)
        area = (d * v.clip(min=0) * np.sin(theta)).sum() * (np.pi / 4000) * (2 * np.pi / 400)
        found = float(split_sum.smith(torch.tensor([np.cos(angle)]), torch.tensor([alpha]))[0])
        assert (1 + found) * np.cos(angle) == pytest.approx(area, rel=2e-3)
    assert float(split_sum.smith(torch.tensor([0.5]), torch.tensor([0.5]))[0]) == pytest.approx(0.16144, abs=1e-5)
