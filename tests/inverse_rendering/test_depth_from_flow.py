"""Depth from optical flow: made-up flow of a displaced surface, and pictures that are shifted by known amounts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage

from pipeline.fields.geometry import GridSdf
from pipeline.transforms import inverse_rigid, project, projection_slope
from stages.inverse_rendering.depth_from_flow import F64, MOST, Flow, depth, flow_of, move_surface
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.registration import Pair
from stages.inverse_rendering.training_loop import run_fit
from tests.support import small_ball
from tests.support.textured_ball import camera_on_orbit

RADIUS, K = 0.1, np.array([[700.0, 0, 128], [0, 700.0, 128], [0, 0, 1]])
SIDE, SMALL = 160, np.array([[440.0, 0, 80], [0, 440.0, 80], [0, 0, 1]])  # of the pictures, and their camera
NONE = np.zeros(5)


def cap(count: int = 4000) -> F64:
    """Places on the front of a ball, evenly spread: unit normals (N, 3)."""
    i = np.arange(count) + 0.5
    z = 1 - 0.5 * i / count
    turn = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)


def poses(half: float, count: int = 12) -> list[F64]:
    """Cameras on an arc before the ball, and in turn 4 degrees above or below it."""
    return [camera_on_orbit(float(a), 4.0 * (-1) ** (i // 2), 0.6, np.zeros(3))
            for i, a in enumerate(np.linspace(-half, half, count))]  # fmt: skip


def flow(n: F64, u: F64, pose: F64, seed: int, noise: float = 0.0) -> Flow:
    """What a view tells if all that it shows is displaced by u (N, 3)."""
    random, x = np.random.default_rng(seed), RADIUS * n
    J = projection_slope(K, inverse_rigid(pose), NONE, x)
    f = np.einsum("nij,nj->ni", J, u) + noise * random.standard_normal((len(n), 2))
    return Flow(x, J, f, 0.1 * random.standard_normal((len(n), 2)))


def test_depth_is_found_and_the_texture_s_shift_is_not_depth() -> None:
    n = cap()
    d = 0.003 * np.exp(-((n[:, 0] - 0.2) ** 2 + n[:, 1] ** 2) / 0.1)
    along = np.cross(n, [0.0, 1.0, 0.0])
    u = d[:, None] * n + 0.002 * along
    found = depth([flow(n, u, p, i) for i, p in enumerate(poses(25))], RADIUS * n, n)
    inner = n[:, 2] > 0.7
    assert np.abs(found.d - d)[inner].max() < 4e-4 and found.used[inner & (d > 0.001)].min() > 0.9


def test_noise_and_what_half_of_the_views_contradict_move_little() -> None:
    n = cap()
    noisy = depth([flow(n, 0 * n, p, i, 1.0) for i, p in enumerate(poses(25))], RADIUS * n, n)
    assert np.sqrt((noisy.d**2).mean()) < 7e-5
    doubtful = depth([flow(n, 0.004 * n * (i % 2), p, i) for i, p in enumerate(poses(25))], RADIUS * n, n)
    assert np.abs(doubtful.d).max() < 1e-5 and doubtful.used.max() < 0.01


def test_views_from_one_place_tell_no_depth() -> None:
    n = cap()[:400]  # what faces the camera
    found = depth([flow(n, 0.003 * n, poses(0)[0], i) for i in range(12)], RADIUS * n, n)
    assert np.abs(found.d).max() < 4e-4


def test_a_wild_view_is_outvoted_and_no_flow_is_no_motion() -> None:
    n = cap()
    views = [flow(n, 0.002 * n, p, i) for i, p in enumerate(poses(25))]
    views[5] = Flow(views[5].x, views[5].J, views[5].f + 7, views[5].g)
    found = depth(views, RADIUS * n, n)
    assert np.abs(found.d - 0.002)[n[:, 2] > 0.7].max() < 5e-4
    nothing = Flow(*(np.zeros((0, *k)) for k in ((3,), (2, 3), (2,), (2,))))
    empty = depth([nothing] * 8, RADIUS * n, n)
    assert not empty.d.any() and not empty.used.any()
    far = depth([flow(n, 0.05 * n, p, i) for i, p in enumerate(poses(25))], RADIUS * n, n)
    assert np.abs(far.d).max() <= MOST


# ------------------------------------------------------------------ pictures
def picture(at: F64) -> F64:
    """A texture of the ball at points (N, 3): smooth noise."""
    noise = np.random.default_rng(0).random((48, 48, 48))
    smooth = ndimage.gaussian_filter(noise, 1.0, mode="wrap")
    smooth = 0.5 + 0.25 * (smooth - smooth.mean()) / smooth.std()
    return np.asarray(ndimage.map_coordinates(smooth, (at.T + 0.15) / 0.3 * 47, order=1, mode="wrap"))


def sight(pose: F64, shown: float, true: float) -> Pair:
    """The ball of radius `true` in the photo, and what a model of radius `shown` with the texture of the true ball, put
    on radially, shows there."""
    v, u = np.mgrid[:SIDE, :SIDE] + 0.5
    ray = np.stack([(u - 80) / 440, (v - 80) / 440, np.ones_like(u)], -1) @ pose[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    o = pose[:3, 3]
    pictures, points = [], []
    for radius in (true, shown):
        b = ray @ o
        inside = b * b - o @ o + radius * radius
        x = o + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * ray
        hit = inside > 0
        unit = x / np.linalg.norm(x, axis=-1, keepdims=True)
        pictures.append(np.where(hit, picture((0.1 * unit).reshape(-1, 3)).reshape(SIDE, SIDE).clip(0, 1), 0))
        points.append(np.where(hit[..., None], x, np.nan))
    usable = np.isfinite(points[0]).all(-1) & np.isfinite(points[1]).all(-1)
    return Pair(pictures[0].astype(np.float32), pictures[1].astype(np.float32), points[1], usable, SMALL,
                inverse_rigid(pose), NONE, 1)  # fmt: skip


def grid_and_views(radius: float, alpha: float) -> tuple[GridSdf, list[PhotoView]]:
    """A ball around the origin, and views of an arc whose masks are the same everywhere."""
    cell, count = 0.004, 60
    lo = np.full(3, -0.5 * cell * (count - 1))
    node = np.stack(np.meshgrid(*(lo[a] + cell * np.arange(count) for a in range(3)), indexing="ij"), -1)
    values = torch.from_numpy((np.linalg.norm(node, axis=-1) - radius).astype(np.float32))
    black, mask = np.zeros((SIDE, SIDE, 3), np.float32), np.full((SIDE, SIDE), alpha, np.float32)
    views = [PhotoView(i, black, mask, SMALL, p, NONE) for i, p in enumerate(poses(25))]
    return GridSdf(values, torch.from_numpy(lo.astype(np.float32)), cell), views


def test_flow_of_pictures_agrees_with_the_projection() -> None:
    pose = poses(20)[2]
    found = flow_of(sight(pose, 0.098, RADIUS))
    to = found.x * RADIUS / 0.098
    wanted = project(SMALL, inverse_rigid(pose), NONE, to)[0] - project(SMALL, inverse_rigid(pose), NONE, found.x)[0]
    assert len(found.x) > 3000 and np.median(np.linalg.norm(found.f - wanted, axis=1)) < 0.15
    np.testing.assert_allclose(found.J, projection_slope(SMALL, inverse_rigid(pose), NONE, found.x))
    dark = sight(pose, 0.098, RADIUS)
    dark.usable[:] = False
    assert len(flow_of(dark).x) == 0


@pytest.mark.parametrize("shown", [0.097, 0.103])
def test_a_ball_of_the_wrong_size_comes_to_the_right_one_in_front(shown: float) -> None:
    grid, views = grid_and_views(shown, 1.0)
    moved = move_surface(grid, views, lambda k: sight(views[k].world_from_cam, shown, RADIUS), SIDE)
    front = torch.from_numpy((RADIUS * cap()[cap()[:, 2] > 0.75]).astype(np.float32))
    back = torch.tensor([[0.0, 0.0, -shown]])
    with torch.no_grad():
        assert float(grid(front)[0].abs().median()) < 0.001 and float(grid(back)[0].abs().max()) < 0.0005
    assert moved > 0.001


def test_nothing_moves_out_of_the_masks() -> None:
    """The model is too small, but the masks show nothing, so that it does not grow."""
    shown = 0.097
    grid, views = grid_and_views(shown, 0.0)
    assert move_surface(grid, views, lambda k: sight(views[k].world_from_cam, shown, RADIUS), SIDE) < 1e-3
    with torch.no_grad():
        assert float(grid(torch.tensor([[0.0, 0.0, RADIUS]]))[0]) > 0.0025


@pytest.mark.slow
@pytest.mark.parametrize(("setting", "times"), [("on", 2), ("auto", 0), ("off", 0)])
def test_a_fit_follows_the_flow_when_asked(setting: str, times: int) -> None:
    """The stage turns auto into one of the others."""
    t = small_ball.trainer(small_ball.SMALL.changed(follow_flow=setting, steps=60))
    run_fit(t, small_ball.hooks())
    assert t.followed == times and t.surface_facts()["flow_moved_mm"] == 0  # the ball has no texture


def test_too_few_views_move_nothing() -> None:
    values = torch.ones((8, 8, 8))
    grid = GridSdf(values, torch.zeros(3), 0.1)
    assert move_surface(grid, [], lambda _: sight(poses(5)[0], 0.1, 0.1), SIDE) == 0
    assert torch.equal(grid.values, values)
