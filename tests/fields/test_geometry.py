"""The SDF grid: smoothing where no ray touched it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.fields.geometry import GridSdf


def ball_with_ripples(radius: float, height: float, cells: int = 48) -> GridSdf:
    """A ball of a tenth of a metre with ripples of a given height, whose coefficients are its values (the spline then
    smooths them a little)."""
    cell = 3 * radius / cells
    axis = (torch.arange(cells + 1) - cells / 2) * cell
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    r = x.norm(dim=-1)
    ripples = height * torch.sin(12 * torch.atan2(x[..., 1], x[..., 0])) * (x[..., :2].norm(dim=-1) / r.clamp(min=cell))
    return GridSdf(r - radius - ripples, torch.full((3,), -1.5 * radius), cell)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_only_what_no_ray_touched_is_smoothed(scale: float) -> None:
    """A ripple of k radians per metre is damped by exp(-(k width)^2 / 2), the factor of a Gaussian, and the ball
    shrinks by width^2 / R; what was touched is the same to the last bit."""
    radius, width = 0.1 * scale, 0.012 * scale
    grid = ball_with_ripples(radius, 0.002 * scale)
    touched = torch.zeros(grid.shape, dtype=torch.bool)
    touched[: grid.shape[0] // 2 - 8] = True  # x below -0.05
    grid.v[touched] = 1.0
    grid.steps = 5
    azimuth = torch.linspace(-3.14, 3.14, 400)
    d = torch.stack([torch.cos(azimuth), torch.sin(azimuth), torch.zeros_like(azimuth)], -1)

    def radii() -> torch.Tensor:
        low, high = torch.full_like(azimuth, 0.5 * radius), torch.full_like(azimuth, 1.4 * radius)
        for _ in range(40):
            middle = 0.5 * (low + high)
            outside = grid(middle[:, None] * d)[0].detach() > 0
            low, high = torch.where(outside, low, middle), torch.where(outside, middle, high)
        return low / radius

    before = radii()
    grid.smooth_untouched(width)
    after = radii()
    kept, free = torch.cos(azimuth) < -0.65, torch.cos(azimuth) > 0.3
    assert torch.equal(before[kept], after[kept])
    assert after[free].std() / before[free].std() == pytest.approx(np.exp(-((12 * width / radius) ** 2) / 2), rel=0.1)
    assert after[free].mean() == pytest.approx(1 - (width / radius) ** 2, abs=0.004)


def test_a_surface_that_no_ray_touched_at_all_is_left_as_it_is() -> None:
    grid = ball_with_ripples(0.1, 0.002)
    before = grid.values.detach().clone()
    grid.smooth_untouched(0.01)
    assert torch.equal(before, grid.values.detach())
