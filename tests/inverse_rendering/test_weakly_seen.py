"""Smoothing where photos hardly determine the surface: a ball with ripples, seen from one side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from pipeline.fields.geometry import GridSdf
from stages.inverse_rendering import fit
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.weakly_seen import (
    FACE,
    NOISE,
    RIPPLE,
    RIPPLES_AT,
    SMOOTH_AT,
    information,
    lengths,
    outlines,
    outside,
    smooth_weakly_seen,
    smoothing_shares,
)
from tests.support.small_ball import SMALL, trainer

F64 = npt.NDArray[np.float64]
SIDE = 320


def ball(radius: float, height: float = 0.0, cells: int = 64, count: int = 16) -> GridSdf:
    """A ball with so many ripples of a height around its z axis."""
    cell = 3 * radius / cells
    axis = (torch.arange(cells + 1) - cells / 2) * cell
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    r = x.norm(dim=-1)
    ripples = (
        height * torch.sin(count * torch.atan2(x[..., 1], x[..., 0])) * (x[..., :2].norm(dim=-1) / r.clamp(min=cell))
    )
    return GridSdf(r - radius - ripples, torch.full((3,), -1.5 * radius), cell)


def camera(direction: F64, distance: float) -> PhotoView:
    """A view of the origin from distance * direction; everything in it is subject."""
    back = direction / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-back, right), -back], 1)
    pose[:3, 3] = distance * back
    K = np.array([[1.5 * SIDE, 0, SIDE / 2], [0, 1.5 * SIDE, SIDE / 2], [0, 0, 1]])
    grey = np.full((SIDE, SIDE, 3), 0.5, np.float32)
    return PhotoView(0, grey, np.ones((SIDE, SIDE), np.float32), K, pose, np.zeros(5))


def around(degrees: list[float], distance: float) -> list[PhotoView]:
    """Views in the plane of x and y, at azimuths from +x."""
    turned = np.radians(degrees)
    return [camera(np.array([np.cos(a), np.sin(a), 0.0]), distance) for a in turned]


def test_two_views_determine_depth_as_two_rays_do() -> None:
    """At angles +-a to the normal: against the inverse of the normal equations of two rays, sum c (1 - d d^T)."""
    grid, far = ball(0.1), 1000.0  # far: both views see the point from their directions to the origin
    for a in (2.0, 10.0, 40.0):
        views = around([-a, a], far)
        c, d = np.cos(np.radians(a)), [v.world_from_cam[:3, 3] / far for v in views]
        equations = sum(c * (np.eye(3) - np.outer(k, k)) for k in d)
        expected = 1 / np.linalg.inv(equations)[0, 0]
        views = [PhotoView(0, v.rgb, v.alpha, scaled(v.K), v.world_from_cam, v.distortion) for v in views]
        found = information(grid, views, np.array([[0.1, 0, 0]]), np.array([[1.0, 0, 0]]))
        assert found == pytest.approx([expected], rel=2e-3)


def scaled(K: F64) -> F64:
    """A lens long enough for a ball of 0.1 at 1000."""
    out = K.copy()
    out[[0, 1], [0, 1]] *= 2000
    return out


def test_one_view_and_none_determine_nothing() -> None:
    grid = ball(0.1)
    x, n = np.array([[0.1, 0, 0], [-0.1, 0, 0]]), np.array([[1.0, 0, 0], [-1, 0, 0]])
    assert information(grid, around([10.0], 0.6), x, n) == pytest.approx([0, 0], abs=1e-9)
    assert information(grid, [], x, n) == pytest.approx([0, 0])
    seen = information(grid, around([-20.0, 20.0], 0.6), x, n)
    assert seen[0] > 0.1
    assert seen[1] == pytest.approx(0, abs=1e-9)  # behind the ball


def test_pixels_that_do_not_count_do_not_see() -> None:
    """Masks, the extent and doubtful places."""
    grid, x, n = ball(0.1), np.array([[0.1, 0, 0]]), np.array([[1.0, 0, 0]])
    a, b = around([-20.0, 20.0], 0.6)
    empty = np.zeros((SIDE, SIDE), np.float32)
    for other in (
        PhotoView(0, b.rgb, empty, b.K, b.world_from_cam, b.distortion),
        PhotoView(0, b.rgb, b.alpha, b.K, b.world_from_cam, b.distortion, asked=empty),
        PhotoView(0, b.rgb, b.alpha, b.K, b.world_from_cam, b.distortion, doubtful=empty == 0),
    ):
        assert information(grid, [a, other], x, n) == pytest.approx([0], abs=1e-9)
    assert information(grid, [a, b], x, n)[0] > 0.1


def test_lengths_follow_the_noise_and_the_worse_neighbours() -> None:
    x = np.random.default_rng(0).random((400, 3))
    even = lengths(np.full(400, 4.0), x, 0.001, 0.012)
    assert even == pytest.approx(NOISE * 0.001 / 2)
    assert lengths(np.zeros(400), x, 0.001, 0.012) == pytest.approx(0.012)
    assert lengths(np.full(400, 1e30), x, 0.001, 0.012).max() < 1e-15
    facet = np.zeros(400)
    facet[7] = 100.0  # one facet that faces the cameras in a place that they hardly see
    assert lengths(facet, x, 0.001, 0.012)[7] == pytest.approx(0.012)
    assert lengths(np.array([4.0]), x[:1], 0.001, 0.012) == pytest.approx(NOISE * 0.001 / 2)


def test_outlines_are_where_the_masks_end() -> None:
    """Of a ball that is seen along x: its points on the circle around the view, not its middle, not a point behind it
    at the same angle, no patch on the circle that faces the camera; none where the mask goes on or does not count."""
    view = camera(np.array([1.0, 0, 0]), 50.0)
    v, u = np.mgrid[:SIDE, :SIDE] + 0.5
    disc = (np.hypot(u - SIDE / 2, v - SIDE / 2) < 80).astype(np.float32)
    reach = 80 / 1.5 / SIDE * 50  # radius of a ball with this silhouette, seen from far away
    y = np.linspace(0, 2 * np.pi, 9)
    rim = reach * np.stack([np.zeros(9), np.cos(y), np.sin(y)], 1)
    x = np.concatenate([rim, [[reach, 0, 0]], 0.7 * rim[:1], rim[:1]])
    n = np.concatenate([rim / reach, [[1, 0, 0]], rim[:1] / reach, [[1, 0, 0]]])

    def counted(**changed: object) -> F64:
        return outlines([replace(view, **{"alpha": disc, **changed})] * 3, x, n, SIDE)

    assert counted() == pytest.approx([3] * 9 + [0, 0, 0])
    assert not counted(alpha=np.ones_like(disc)).any()
    assert not counted(asked=np.zeros_like(disc)).any()
    assert not counted(doubtful=disc >= 0).any()


def test_points_outside_of_the_masks_are_counted() -> None:
    """A disc of 80 pixels in three views: at its middle, beside it, beyond both sides of the photo, behind them."""
    view = camera(np.array([1.0, 0, 0]), 50.0)
    v, u = np.mgrid[:SIDE, :SIDE] + 0.5
    disc = (np.hypot(u - SIDE / 2, v - SIDE / 2) < 80).astype(np.float32)
    a_pixel = 50 / 1.5 / SIDE
    x = np.array([[0, 0, 0], [0, 81, 0], [0, 84, 0], [0, 0, -90], [0, 200, 0], [0, -200, 0], [900, 0, 0]]) * a_pixel
    views = [replace(view, alpha=disc)] * 3
    assert outside(views, x, SIDE).tolist() == [0, 0, 3, 3, 0, 0, 0]
    assert not outside([replace(v, asked=np.zeros_like(disc)) for v in views], x, SIDE).any()
    assert outside([], x, SIDE).tolist() == [0] * 7


def test_the_rim_of_a_thin_disc_stays_where_masks_show_it() -> None:
    """A disc of six cells, whose rim no photo determines but by its outline: smoothed without masks it shrinks by
    more than a cell, with them by less."""
    cell, radius = 0.005, 0.1
    axis = (torch.arange(65) - 32) * cell
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    inside = torch.stack([torch.hypot(y, z) - radius, x.abs() - 3 * cell]).max(0).values
    lo, front = torch.full((3,), -32 * cell), camera(np.array([1.0, 0, 0]), 0.8)

    def reach(view: PhotoView) -> float:
        grid = GridSdf(inside.clone(), lo, cell)
        smooth_weakly_seen(grid, [view], SIDE, 0.02)
        y = torch.linspace(0, 0.14, 2000)
        return float(y[(grid(torch.stack([0 * y, y, 0 * y], 1))[0] < 0)].max())

    v, u = np.mgrid[:SIDE, :SIDE] + 0.5
    mask = (np.hypot(u - SIDE / 2, v - SIDE / 2) < 1.5 * SIDE * radius / 0.8).astype(np.float32)
    assert reach(front) < radius - cell
    assert reach(replace(front, alpha=mask)) == pytest.approx(radius, abs=cell)


def test_a_slot_that_masks_show_open_is_not_filled() -> None:
    """A block with a slot of four cells: smoothed without masks its bottom rises, with the masks of two views that
    look through it hardly."""
    cell, half, slot = 0.005, 0.1, 2
    axis = (torch.arange(65) - 32) * cell
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    block = torch.stack([x.abs() - 6 * cell, y.abs() - half, z.abs() - half]).max(0).values
    open_above = torch.stack([z.abs() - slot * cell, -y]).max(0).values
    values, lo, front = (
        torch.maximum(block, -open_above),
        torch.full((3,), -32 * cell),
        camera(np.array([1.0, 0, 0]), 5),
    )

    def bottom(view: PhotoView) -> float:
        grid = GridSdf(values.clone(), lo, cell)
        smooth_weakly_seen(grid, [view, view], SIDE, 0.015)
        up = torch.linspace(-0.02, 0.09, 1000)
        return float(up[grid(torch.stack([0 * up, up, 0 * up], 1))[0] < 0].max())

    lens = front.K * np.array([[8], [8], [1]]) + np.array([[0, 0, -7 * SIDE / 2], [0, 0, -7 * SIDE / 2], [0, 0, 0]])
    front = replace(front, K=lens)
    v, u = (np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2) * 5 / (12 * SIDE)  # of the plane x = 0
    right, down = (front.world_from_cam[:3, k] for k in range(2))
    at = u[..., None] * right + v[..., None] * down
    hole = (np.abs(at[..., 2]) < slot * cell) & (at[..., 1] > 0)
    assert bottom(front) > 1.5 * cell
    assert bottom(replace(front, alpha=(~hole).astype(np.float32))) < 1.2 * cell


def radii(grid: GridSdf, azimuth: torch.Tensor, radius: float) -> torch.Tensor:
    """Distance of the zero set from the z axis, by bisection, over the radius."""
    d = torch.stack([torch.cos(azimuth), torch.sin(azimuth), torch.zeros_like(azimuth)], -1)
    low, high = torch.full_like(azimuth, 0.6 * radius), torch.full_like(azimuth, 1.4 * radius)
    for _ in range(40):
        middle = 0.5 * (low + high)
        outside = grid(middle[:, None] * d)[0].detach() > 0
        low, high = torch.where(outside, low, middle), torch.where(outside, middle, high)
    return low / radius


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_side_that_no_view_determines_is_smoothed(scale: float) -> None:
    """In the unit of the capture: the front keeps its ripples, the back loses them, and its radius stays."""
    radius, height = 0.1 * scale, 0.003 * scale
    grid = ball(radius, height)
    views = around(list(np.linspace(-50, 50, 40)), 0.6 * scale)
    front, back = torch.linspace(-0.3, 0.3, 100), torch.linspace(2.4, 3.9, 200)
    before = [radii(grid, a, radius) for a in (front, back)]
    share = smooth_weakly_seen(grid, views, SIDE, 0.2 * radius)
    after = [radii(grid, a, radius) for a in (front, back)]
    assert 0.2 < share < 0.95
    assert float((after[0] - before[0]).abs().max()) < 0.3 * height / radius
    assert float(after[1].std() / before[1].std()) < 0.25
    assert float(after[1].mean()) == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(("count", "least", "most"), [(8, 0.95, 1.02), (16, 0.88, 1.0), (40, 0.2, 0.55)])
def test_at_last_only_ripples_of_a_few_cells_go(count: int, least: float, most: float) -> None:
    """16.8, 8.4 and 3.4 cells long, where nobody looks: 1 / (1 + (RIPPLE k)^4) of a plane's, k in radians per cell, is
    1.00, .96 and .44."""
    grid = ball(0.1, 0.002, count=count)
    views = around(list(np.linspace(-50, 50, 40)), 0.6)
    back = torch.linspace(2.4, 3.9, 400)
    before = radii(grid, back, 0.1)
    smooth_weakly_seen(grid, views, SIDE, 0.02, RIPPLE)
    assert least < float(radii(grid, back, 0.1).std() / before.std()) < most


def test_a_part_alone_is_smoothed_and_by_its_own_noise() -> None:
    """A quarter of a ball: as much as its noise asks for; the surface elsewhere stays, also where nobody looks."""
    views = around(list(np.linspace(-50, 50, 40)), 0.6)
    front, elsewhere = torch.linspace(0.1, 0.5, 200), torch.linspace(3.3, 6.1, 400)
    left = []
    for noise in (0.01, 1.5, 6.0):
        grid = ball(0.1, 0.002, count=40)
        before, rest = radii(grid, front, 0.1), radii(grid, elsewhere, 0.1)
        smooth_weakly_seen(grid, views, SIDE, 0.02, 1.0, noise, lambda x: x[:, 1] > 0)
        left.append(float(radii(grid, front, 0.1).std() / before.std()))
        assert float((radii(grid, elsewhere, 0.1) - rest).abs().max()) < 1e-3
    assert left[0] > 0.99 and left[2] < 0.7 and left[2] < left[1] <= left[0]


def test_without_views_nothing_changes() -> None:
    grid = ball(0.1, 0.003)
    before = grid.values.detach().clone()
    assert smooth_weakly_seen(grid, [], SIDE, 0.01) == 0
    assert torch.equal(before, grid.values.detach())


def test_long_fits_are_smoothed_again() -> None:
    assert smoothing_shares(1300) == smoothing_shares(1) == SMOOTH_AT  # a draft
    for steps, count in ((2200, 1), (8000, 4), (12_000, 6), (10**7, 8)):
        shares = smoothing_shares(steps)
        assert len(shares) == 2 + count and shares[:2] == SMOOTH_AT
        assert list(shares) == sorted(shares) and shares[-1] == pytest.approx(0.9) and shares[-1] < RIPPLES_AT
        assert np.diff(shares[1:]).min() * steps > 699


@pytest.mark.parametrize("arc", [False, True])
def test_the_last_smoothing_of_a_fit_is_of_ripples_alone(monkeypatch: pytest.MonkeyPatch, arc: bool) -> None:
    """And of a face before an arc of photos, of longer ripples of its plain skin."""
    t, asked = trainer(SMALL), list[tuple[object, ...]]()

    def plain(x: F64) -> npt.NDArray[np.bool_]:
        return np.ones(len(x), np.bool_)

    def smoothed(grid: GridSdf, views: object, side: int, longest: float, *more: object) -> float:
        asked.append(more)
        return 0.5

    t.know_head(plain, plain if arc else None)
    monkeypatch.setattr(fit, "smooth_weakly_seen", smoothed)
    for share in (0.2, 0.36, 0.37, 0.6, 0.92, 0.94, 0.99):
        monkeypatch.setattr(Trainer, "share", lambda _, now=share: now)
        t.smooth()
    assert asked == [(), (), (RIPPLE,), *([(*FACE, plain)] if arc else [])]
