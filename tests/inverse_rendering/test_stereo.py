"""The start from photos: a marked ball's hull is moved onto it, a blank one's stays, hidden views do not vote."""

from __future__ import annotations

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
import torch

from pipeline import transforms
from stages.inverse_rendering import stereo
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView

RADIUS, SIDE = 0.1, 192
LENS = (0.08, -0.02, 0.002, -0.001, 0.0)


def camera(index: int) -> tuple[np.ndarray, np.ndarray]:
    """K and world_from_cam of one of 24 cameras in two rings around the ball."""
    angle, height = 2 * math.pi * index / 12 + (0.2 if index >= 12 else 0), 0.22 if index >= 12 else -0.12
    centre = np.array([0.5 * math.sin(angle), height, 0.5 * math.cos(angle)])
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    f = 1.9 * SIDE
    K = np.array([[f, 0, SIDE / 2], [0, f, SIDE / 2], [0, 0, 1]])
    return K, transforms.rigid(np.stack([x, np.cross(z, x), z], 1), centre)


def marks(p: np.ndarray) -> np.ndarray:
    """A pattern of many sizes on the ball."""
    rng = np.random.default_rng(3)
    out = np.full(len(p), 0.5)
    for scale in (60, 120, 240, 420):
        for _ in range(3):
            direction = rng.normal(size=3)
            out += 0.05 * np.sin(scale * p @ (direction / np.linalg.norm(direction)) + rng.uniform(0, 6))
    return out


@cache  # most tests look at the same photos; none changes them
def photo(index: int, blank: bool = False, lens: tuple[float, ...] = (0.0,) * 5) -> PhotoView:
    """The ball from one camera, 3 x 3 samples a pixel, each camera with its own exposure."""
    K, pose = camera(index)
    distortion = np.array(lens)
    o, d = transforms.rays(K, pose, distortion, transforms.pixel_centres(3 * SIDE, 3 * SIDE) / 3)
    b = d @ o
    under = b * b - (o @ o - RADIUS**2)
    hit = under > 0
    p = o + (-b - np.sqrt(np.where(hit, under, 0)))[:, None] * d
    value = np.where(hit, 0.4 if blank else marks(p), 0) * (0.8 + 0.05 * (index % 5))
    image = value.reshape(SIDE, 3, SIDE, 3).mean((1, 3)).astype(np.float32)
    alpha = hit.reshape(SIDE, 3, SIDE, 3).mean((1, 3)).astype(np.float32)
    return PhotoView(index, np.repeat(image[..., None], 3, -1), alpha, K, pose, distortion)


def too_large(by: float) -> Start:
    """A ball that has, like a hull, a fill on one side: up to `by` outside of the true one."""
    lo, cell, n = -0.15, 0.005, 61
    x = lo + cell * np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1)
    r = np.linalg.norm(x, axis=-1)
    bump = by * np.exp(-(np.linalg.norm(x - [0.0, 0.02, 0.1], axis=-1) ** 2) / 0.05**2)
    return Start((r - RADIUS - bump).astype(np.float32), np.full(3, lo, np.float32), cell)


def misses(start: Start) -> np.ndarray:
    """|radius - true| of the zero set's points, within 60 degrees of the equator, where many views look."""
    p, _ = stereo.surface_points(start.values, start.lo, start.cell)
    r = np.linalg.norm(p, axis=1)
    return np.abs(r - RADIUS)[np.abs(p[:, 1]) < 0.8 * r]


@pytest.mark.parametrize("lens", [(0.0,) * 5, pytest.param(LENS, marks=pytest.mark.slow)], ids=["straight", "lens"])
@pytest.mark.slow
def test_a_fill_is_carved_away(lens: tuple[float, ...]) -> None:
    start = too_large(0.007)
    found = stereo.start_from_photos(start, [photo(i, lens=lens) for i in range(24)], "cpu")
    assert misses(start).max() > 5e-3
    assert np.percentile(misses(found), 99) < 1.5e-3 and misses(found).mean() < 4e-4


@pytest.mark.slow
def test_a_deep_fill_is_carved_away_from_clean_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    """13 mm on a ball of 200: more than the first sweep's reach, which would leave the middle of it standing."""
    start, photos = too_large(0.013), [photo(i) for i in range(24)]
    found = stereo.start_from_photos(start, photos, "cpu")
    assert np.percentile(misses(found), 99) < 2e-3 and misses(found).max() < 4e-3
    shallow = tuple(dataclasses.replace(s, inward_clean=s.inward) for s in stereo.SWEEPS)
    monkeypatch.setattr(stereo, "SWEEPS", shallow)
    assert misses(stereo.start_from_photos(start, photos, "cpu")).max() > 6e-3


@pytest.mark.slow
def test_blank_skin_stays_where_it_is() -> None:
    start = too_large(0.004)
    found = stereo.start_from_photos(start, [photo(i, blank=True) for i in range(24)], "cpu")
    assert abs(misses(found).max() - misses(start).max()) < 1.5e-3


def noisy(view: PhotoView, size: float) -> PhotoView:
    """A photo with noise of a standard deviation of `size` in the encoded values that stereo reads."""
    noise = np.random.default_rng(view.index).normal(0, size, view.rgb.shape[:2])[..., None]
    rgb = np.clip(view.rgb ** (1 / 2.2) + noise, 0, 1) ** 2.2
    return dataclasses.replace(view, rgb=rgb.astype(np.float32))


def test_noise_makes_no_craters_in_blank_skin() -> None:
    """Patches of noise agree now and then; the hull, which is right but for a fill, must not be dug into."""
    start = too_large(0.004)
    found = stereo.start_from_photos(start, [noisy(photo(i, blank=True), 0.015) for i in range(24)], "cpu")
    points, _ = stereo.surface_points(found.values, found.lo, found.cell)
    assert (RADIUS - np.linalg.norm(points, axis=1)).max() < 2.5e-3


@pytest.mark.slow
def test_marks_are_found_beneath_noise() -> None:
    start = too_large(0.007)
    found = stereo.start_from_photos(start, [noisy(photo(i), 0.015) for i in range(24)], "cpu")
    assert misses(found).mean() < 0.5 * misses(start).mean()


@pytest.mark.parametrize("size", [0.002, 0.01, 0.05])
def test_noise_is_told_from_shading(size: float) -> None:
    y, x = np.mgrid[:200, :200] / 200
    shading = 0.5 + 0.3 * np.sin(3 * x + y) * np.cos(2 * y)
    noise = np.random.default_rng(0).normal(0, size, shading.shape)
    inside = (x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.16
    found = stereo.noise_of((shading + noise).astype(np.float32), inside)
    assert found == pytest.approx(size, rel=0.05)
    assert stereo.noise_of(shading.astype(np.float32), inside) < 1e-4
    assert stereo.noise_of(shading.astype(np.float32), np.zeros_like(inside)) == 0.0


def test_two_views_change_nothing() -> None:
    start = too_large(0.004)
    found = stereo.start_from_photos(start, [photo(i) for i in range(2)], "cpu")
    assert np.array_equal(found.values, start.values)


@pytest.mark.slow
def test_twice_the_same(all_cores: None) -> None:
    views = [photo(i) for i in range(12)]
    a, b = (stereo.start_from_photos(too_large(0.004), views, "cpu") for _ in range(2))
    assert np.array_equal(a.values, b.values)


@pytest.mark.slow
def test_views_behind_do_not_see() -> None:
    """Every view that is kept faces the point; the order is by how squarely."""
    start = too_large(0.0)
    p, n = stereo.surface_points(start.values, start.lo, start.cell)
    photos = stereo.photos_of([photo(i) for i in range(24)], "cpu")
    order, seen, pixel = stereo.best_views(p, n, start, photos)
    way = torch.nn.functional.normalize(photos.centre[order] - torch.from_numpy(p)[:, None].float(), dim=-1)
    cosine = (way * torch.from_numpy(n)[:, None].float()).sum(-1)
    assert (cosine[seen] > stereo.MIN_COSINE - 1e-4).all()
    assert (cosine.diff(dim=1)[seen[:, 1:]] <= 1e-4).all()
    assert pixel == pytest.approx(0.4 / (1.9 * SIDE), rel=0.15)


def test_a_hidden_view_gives_way_to_the_next() -> None:
    """Against segments and spheres, point by point: a second ball stands before the first one."""
    start, centre, radius = too_large(0.0), np.array([0.0, 0.0, 0.13]), 0.012
    x = start.lo + start.cell * np.stack(np.meshgrid(*[np.arange(n) for n in start.values.shape], indexing="ij"), -1)
    values = np.minimum(start.values, np.linalg.norm(x - centre, axis=-1) - radius).astype(np.float32)
    rng = np.random.default_rng(0)
    n = rng.normal(size=(300, 3)) * [0.5, 0.5, 0.2] + [0, 0, 1]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    photos = stereo.photos_of([photo(i) for i in range(24)], "cpu")
    order, seen, _ = stereo.best_views(RADIUS * n, n, Start(values, start.lo, start.cell), photos)
    eyes = photos.centre.numpy().astype(np.float64)
    way = eyes - RADIUS * n[:, None]
    along = np.clip((((centre - RADIUS * n)[:, None] * way).sum(-1) / (way**2).sum(-1)), 0, 1)
    miss = np.linalg.norm(RADIUS * n[:, None] + along[..., None] * way - centre, axis=-1)
    cosine = (way * n[:, None]).sum(-1) / np.linalg.norm(way, axis=-1)
    wanted = (cosine > stereo.MIN_COSINE) & (miss > radius)
    clear = (np.abs(miss - radius) > start.cell).all(1) & (np.abs(cosine - stereo.MIN_COSINE) > 1e-3).all(1)
    assert clear.sum() > 100 and ((~wanted) & (cosine > stereo.MIN_COSINE))[clear].any()
    for i in np.flatnonzero(clear):
        best = np.argsort(-np.where(wanted[i], cosine[i], -1), kind="stable")[: min(stereo.VIEWS, wanted[i].sum())]
        assert (
            sorted(order[i][seen[i]].tolist()) == sorted(best.tolist())
            or np.ptp(np.sort(cosine[i][order[i][seen[i]]]) - np.sort(cosine[i][best])) < 1e-5
        )


def test_normals_of_a_ball() -> None:
    p, n = stereo.surface_points(*[getattr(too_large(0.0), k) for k in ("values", "lo", "cell")])
    assert np.abs(np.linalg.norm(p, axis=1) - RADIUS).max() < 1e-3
    assert ((p / np.linalg.norm(p, axis=1, keepdims=True) * n).sum(1) > 0.999).all()


def test_a_sweep_that_has_only_ends_moves_nothing() -> None:
    """Coarse photos: one offset, two; then fewer points than there are voters."""
    points = np.random.default_rng(0).normal(size=(40, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    for count in (1, 2):
        scores = np.ones((40, count), np.float32)
        offset, confidence = stereo.vote(points, normals, scores, np.linspace(0.1, 0, count), 8)
        assert not offset.any() and not confidence.any()
    peaked = np.array([[0, 1, 0]], np.float32)
    offset, confidence = stereo.vote(points[:1], normals[:1], peaked, np.array([0.1, 0.0, -0.1]), 8)
    assert offset == pytest.approx(0.0) and confidence[0] == pytest.approx(1.0)
