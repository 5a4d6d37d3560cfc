"""Shadows and bounces against closed forms: a convex body has none, and a spherical cavity has the same everywhere."""

from __future__ import annotations

import math

import pytest
import torch

from pipeline.fields.geometry import GridSdf
from pipeline.fields.shadowing import Shadowing, Surface, fibonacci, near_surface, solve, trilinear

HALF, CELL = 0.11, 0.0022
OUTER, INNER = 0.09, 0.06
WHITE = torch.zeros(9, 3)
WHITE[0] = math.sqrt(4 * math.pi)  # radiance 1 from everywhere


def geometry(cut: float | None, cell: float = CELL) -> GridSdf:
    """A ball; with `cut`, a bowl: its hollow is a sphere, open above z = cut."""
    lo = torch.full((3,), -HALF)
    axis = -HALF + cell * torch.arange(round(2 * HALF / cell) + 1)
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    r = x.norm(dim=-1)
    values = r - OUTER
    if cut is not None:
        values = torch.maximum(torch.maximum(values, INNER - r), x[..., 2] - cut)
    return GridSdf(values, lo, cell)


def solved(body: GridSdf, albedo: float, light: torch.Tensor = WHITE, bounces: int = 2) -> Shadowing:
    shadowing = Shadowing((-HALF,) * 3, (HALF,) * 3, cells=40)
    index, x, n = near_surface(shadowing, body)
    solve(shadowing, body, Surface(index, x, n, torch.full((len(x), 3), albedo)), light, 1024, bounces)
    return shadowing


def on_sphere(radius: float, highest: float, n: int = 200) -> torch.Tensor:
    d = fibonacci(2 * n)
    return radius * d[d[:, 2] < highest]


@pytest.mark.slow
def test_a_convex_body_hides_nothing() -> None:
    s = solved(geometry(None), 0.8)
    assert bool(s.solved)
    assert torch.allclose(s(on_sphere(OUTER, 1.0)), torch.ones(1), atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("cut", "albedo", "bounces"), [(0.0, 0.0, 0), (0.0, 0.6, 1), (0.0, 0.6, 3), (0.03, 0.5, 2)])
def test_a_spherical_hollow(cut: float, albedo: float, bounces: int) -> None:
    """Of a sphere's wall every point sees every part in proportion to its area, so that F, the share that is open, is
    (1 - cut / R) / 2 everywhere, and each bounce is s <- F + a (1 - F) s."""
    share = (1 - cut / INNER) / 2
    expected = share
    for _ in range(bounces):
        expected = share + albedo * (1 - share) * expected
    wall = on_sphere(INNER, cut / INNER - 0.35)
    coarse, fine = (solved(geometry(cut, c), albedo, bounces=bounces)(wall) for c in (2 * CELL, CELL))
    assert fine.std().item() < 0.06
    # rays start a cell above the wall: the error falls with the cell, so that two of them tell the limit
    assert (2 * fine - coarse).mean().item() == pytest.approx(expected, rel=0.025)


@pytest.mark.slow
def test_light_from_above_does_not_reach_below_an_edge() -> None:
    """The hollow turned away from the light: nothing arrives but what is scattered."""
    light = torch.zeros(9, 3)
    light[0], light[2] = math.sqrt(4 * math.pi), -1.5 * math.sqrt(4 * math.pi / 3)  # 1 - 1.5 z, clipped at 0
    dark, bright = (solved(geometry(0.0), 0.0, v)(torch.tensor([[0.0, 0.0, -INNER]])) for v in (light, WHITE))
    assert float(dark.mean()) < 0.5 * float(bright.mean())


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.0, 1e-12, 1e5])
def test_no_light_and_much_light(level: float) -> None:
    ratio = solved(geometry(0.0), 0.9, WHITE * level).ratio
    assert bool(torch.isfinite(ratio).all()) and float(ratio.min()) > 0
    if level == 0:
        assert bool((ratio == 1).all())


def test_an_empty_volume_is_left_alone() -> None:
    body = geometry(None)
    with torch.no_grad():
        body.values.fill_(1.0)
    left = solved(body, 0.5)
    assert not bool(left.solved) and torch.allclose(left(on_sphere(OUTER, 1.0)), torch.ones(1))


def test_trilinear_is_exact_for_a_plane_and_constant_outside() -> None:
    lo, cell = torch.tensor([-1.0, 0.0, 2.0]), 0.5
    axes = [lo[k] + cell * torch.arange(n) for k, n in enumerate((4, 5, 6))]
    grid = (torch.stack(torch.meshgrid(*axes, indexing="ij"), 0) * torch.tensor([1.0, 2, 3])[:, None, None, None]).sum(
        0
    )
    x = torch.tensor([[-0.3, 1.1, 3.3], [0.2, 0.05, 4.4]])
    assert torch.allclose(trilinear(grid[None], lo, cell, x)[:, 0], (x * torch.tensor([1.0, 2, 3])).sum(-1), atol=1e-5)
    assert float(trilinear(grid[None], lo, cell, torch.tensor([[-9.0, -9, -9]]))) == pytest.approx(float(grid[0, 0, 0]))
