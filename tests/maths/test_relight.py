"""Other lights: projections against analytic lights, scipy's rotations and quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.demo import light as demo_light
from pipeline.maths import brdf, relight, sh
from tests.maths.test_sh import directions, sphere_quadrature


def known(order: int = 6, seed: int = 0) -> torch.Tensor:
    return torch.randn(sh.count(order), 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def painted(c: torch.Tensor, height: int = 96) -> torch.Tensor:
    d = relight.lat_long_directions(height, 2 * height)
    return sh.radiance(c, d.reshape(-1, 3)).reshape(height, 2 * height, 3)


def test_solid_angles_cover_the_sphere() -> None:
    for h, w in ((1, 1), (2, 4), (7, 13), (512, 1024)):
        area = relight.lat_long_solid_angles(h, w)
        assert float(area.sum() * w) == pytest.approx(4 * math.pi, rel=1e-12) and (area > 0).all()


def test_axes_are_the_conventions() -> None:
    """Row 0 up, the middle +Z, columns towards -X: as the demo's own code, which shares nothing with this."""
    d = relight.lat_long_directions(16, 32).numpy()
    assert np.allclose(d, demo_light.lat_long_directions(16), atol=1e-12)


def test_projection_gives_back_what_was_painted() -> None:
    c = known()
    found = relight.project_lat_long(painted(c), 10)
    assert (found[: len(c)] - c).abs().max() < 5e-3 and found[len(c) :].abs().max() < 5e-3
    finer = relight.project_lat_long(painted(c, 192), 10)
    assert (finer[: len(c)] - c).abs().max() < 0.3 * (found[: len(c)] - c).abs().max()


def test_an_even_light_is_exact_at_any_size() -> None:
    for h in (1, 2, 5, 33):
        c = relight.project_lat_long(torch.full((h, 2 * h, 3), 3.0), 0)
        assert torch.allclose(c, torch.full((1, 3), 3 * math.sqrt(4 * math.pi)), rtol=1e-6)


def test_energy_of_a_sun() -> None:
    """A pixel of 1e5 in a dim sky: the flux is kept to rounding, most of the power is beyond order 10, and it rings;
    a window takes the ringing away and leaves the flux."""
    sky = torch.full((64, 128, 3), 0.1)
    sky[20, 40] = 1e5
    lowest = {}
    for window in relight.WINDOWS:
        c = relight.project_lat_long(sky, 10, window)
        e = relight.energy_of(sky, c)
        assert torch.allclose(e.flux, e.kept_flux, rtol=1e-5)
        assert (e.kept_power < 0.05).all() and (e.kept_power > 0).all()
        lowest[window] = e.lowest
    assert lowest["none"] < -1 and lowest["hanning"] > 0.2 * lowest["none"] and lowest["lanczos"] > 0.5 * lowest["none"]


def test_parseval() -> None:
    c = known()
    e = relight.energy_of(painted(c), c)
    assert torch.allclose(e.kept_power, torch.ones(3, dtype=torch.float64), atol=2e-3)


def test_unknown_window_is_named() -> None:
    with pytest.raises(ValueError, match="hanning"):
        relight.window_of(3, "hann")


@pytest.mark.parametrize("order", [0, 1, 3, 10, 16])
def test_rotation_turns_the_light(order: int) -> None:
    c = known(order)
    r = torch.from_numpy(Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix())
    d = directions(40)
    turned = relight.rotate(c, r)
    assert torch.allclose(sh.radiance(turned, d @ r.T), sh.radiance(c, d), atol=1e-11)
    assert torch.allclose(relight.rotate(turned, r.T), c, atol=1e-11)
    assert torch.allclose((turned**2).sum(0), (c**2).sum(0))


def test_rotation_keeps_the_dtype() -> None:
    c = known(4).float()
    found = relight.rotate(c, torch.eye(3))
    assert found.dtype == torch.float32 and torch.allclose(found, c, atol=1e-6)


def test_a_distant_light_seen_through_a_lobe_is_the_lobe() -> None:
    """E times the vMF density, where the order is what the lobe lets through; quadrature of nothing: closed form."""
    for s in (0.02, 0.1, 0.5):
        order = relight.order_for(s, 1e-4)
        to, e = directions(1)[0], torch.tensor([2.0, 1.0, 0.5], dtype=torch.float64)
        c = relight.directional(to, e, order)
        w_r = torch.nn.functional.normalize(to + 0.4 * math.sqrt(s) * directions(30, 3), dim=-1)
        kappa = 1 / s
        density = kappa / (2 * math.pi * (1 - math.exp(-2 * kappa))) * torch.exp(kappa * (w_r @ to - 1))
        found = brdf.light_integral(w_r, torch.full((30,), s, dtype=torch.float64), c, "exact")
        assert torch.allclose(found, density[:, None] * e, rtol=0.02, atol=2e-3 * float(density.max()))


def test_a_distant_light_on_a_matt_sphere() -> None:
    to, e = directions(1)[0], torch.ones(3, dtype=torch.float64)
    n = directions(200, 4)
    found = sh.irradiance(relight.directional(to, e, 20), n)[:, 0]
    assert (found - (n @ to).clamp(min=0)).abs().max() < 0.02


def test_order_for_a_lobe() -> None:
    for s in (0.01, 0.05, 0.3, 2.0):
        order = relight.order_for(s)
        a = [math.exp(-l * (l + 1) * s / 2) for l in range(order + 2)]  # noqa: E741
        assert order == 2 or (a[order] >= 0.01 > a[order + 1])
    assert relight.order_for(0.0) == 64 and relight.order_for(1e-12) == 64 and relight.order_for(1e9) == 2


def test_a_lamp_falls_off_with_the_square_and_points_at_itself() -> None:
    x, power = torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    near, far = (relight.point(p * directions(1)[0], power, x, 8) for p in (0.5, 1.0))
    assert torch.allclose(near, 4 * far)
    d, w = sphere_quadrature(24)
    middle = (sh.radiance(far, d)[:, :1] * w[:, None] * d).sum(0)
    assert torch.allclose(torch.nn.functional.normalize(middle, dim=0), directions(1)[0], atol=1e-6)
    with pytest.raises(ValueError, match="lamp"):
        relight.point(x, power, x, 3)
