"""Depth maps, their fusion and the choice of the start, against shapes that are known in closed form."""

from __future__ import annotations

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from pipeline import transforms
from stages.inverse_rendering import dense_stereo as dense
from stages.inverse_rendering import stereo_kernels as kernels
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.depth_fusion import closed, fused
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.stereo_choice import stereo_start, validation_views
from stages.inverse_rendering.stereo_scores import windowed

RADIUS, SIDE, DISTANCE = 0.1, 160, 0.5
DENT, DENT_AT = 0.05, np.array([0.0, 0.0, 0.11])  # a ball of this radius is taken out of the front: a bowl


def camera(index: int, views: int) -> tuple[np.ndarray, np.ndarray]:
    """K and world_from_cam of one of the cameras in front of the ball, about 12 degrees apart."""
    side = math.ceil(math.sqrt(views))
    across, up = (np.array([index % side, index // side]) - 0.5 * (side - 1)) * math.radians(12)
    centre = DISTANCE * np.array([math.sin(across) * math.cos(up), math.sin(up), math.cos(across) * math.cos(up)])
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    f = 2.1 * SIDE
    K = np.array([[f, 0, SIDE / 2], [0, f, SIDE / 2], [0, 0, 1]])
    return K, transforms.rigid(np.stack([x, np.cross(z, x), z], 1), centre)


def hits(o: np.ndarray, d: np.ndarray, bowl: bool) -> np.ndarray:
    """Distance along rays to the ball, or to the ball with a bowl in its front; NaN where they miss. Closed form."""
    near, _ = ball(o, d, np.zeros(3), RADIUS)
    if not bowl:
        return near
    enter, leave = ball(o, d, DENT_AT, DENT)
    return np.where((near > enter) & (near < leave), leave, near)


def ball(o: np.ndarray, d: np.ndarray, centre: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    b = d @ (o - centre)
    under = b * b - ((o - centre) @ (o - centre) - radius**2)
    root = np.sqrt(np.where(under > 0, under, np.nan))
    return -b - root, -b + root


def marks(p: np.ndarray) -> np.ndarray:
    """A pattern of many sizes in space."""
    rng = np.random.default_rng(3)
    out = np.full(len(p), 0.5)
    for scale in (100, 200, 420, 700):
        for _ in range(3):
            direction = rng.normal(size=3)
            out += 0.05 * np.sin(scale * p @ (direction / np.linalg.norm(direction)) + rng.uniform(0, 6))
    return out


@cache
def photo(index: int, views: int = 9, bowl: bool = False, blank: bool = False) -> PhotoView:
    """3 x 3 samples a pixel, each camera with its own exposure."""
    K, pose = camera(index, views)
    o, d = transforms.rays(K, pose, np.zeros(5), transforms.pixel_centres(3 * SIDE, 3 * SIDE) / 3)
    t = hits(o, d, bowl)
    p = o + np.nan_to_num(t)[:, None] * d
    value = np.where(np.isfinite(t), 0.4 if blank else marks(p), 0) * (0.8 + 0.05 * (index % 5))
    image, alpha = (x.reshape(SIDE, 3, SIDE, 3).mean((1, 3)).astype(np.float32) for x in (value, np.isfinite(t) * 1.0))
    return PhotoView(index, np.repeat(image[..., None], 3, -1), alpha, K, pose, np.zeros(5))


def photos(views: int = 9, bowl: bool = False, blank: bool = False) -> list[PhotoView]:
    return [photo(i, views, bowl, blank) for i in range(views)]


def hull(radius: float = 1.1 * RADIUS, cell: float = 0.005) -> Start:
    """A ball, like a hull somewhat too large and without the bowl."""
    n = 2 * int(radius / cell + 5) + 1
    lo = -cell * (n // 2)
    x = lo + cell * np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1)
    return Start((np.linalg.norm(x, axis=-1) - radius).astype(np.float32), np.full(3, lo, np.float32), cell)


@cache
def maps_of(views: int = 9, bowl: bool = False, blank: bool = False) -> dense.DepthMaps:
    return dense.depth_maps(hull(), photos(views, bowl, blank))


def depth_errors(maps: dense.DepthMaps, bowl: bool) -> np.ndarray:
    """Errors of all depths along their rays, as shares of the width of a pixel on the surface."""
    out = []
    for inverse, K, pose in zip(maps.inverse, maps.K, maps.world_from_cam, strict=True):
        rows, columns = np.nonzero(np.isfinite(inverse))
        o, d = transforms.rays(K, pose, np.zeros(5), np.stack([columns + 0.5, rows + 0.5], -1))
        z = hits(o, d, bowl) * (d @ pose[:3, 2])
        out.append((1 / inverse[rows, columns] - z) * K[0, 0] / z)
    return np.concatenate(out)


def along_axis(start: Start) -> float:
    """Height z at which the axis x = y = 0 enters the surface from the front."""
    n = start.values.shape[0] // 2
    line = start.values[n, n]
    k = int(np.flatnonzero(line < 0).max())
    return float(start.lo[2] + start.cell * (k + line[k] / (line[k] - line[k + 1])))


@pytest.mark.slow
def test_depths_of_a_marked_ball_are_right_to_less_than_a_pixel() -> None:
    maps = maps_of()
    error = depth_errors(maps, bowl=False)
    assert np.isfinite(maps.inverse[4]).sum() > 0.6 * dense.pictures_of(photos(), hull(), dense.FINE).usable[4].sum()
    # patches are planes, which lie a few tenths of a pixel behind the ball that they approximate
    assert np.nanmedian(np.abs(error)) < 0.5 and -0.1 < np.nanmedian(error) < 0.4
    assert np.nanpercentile(np.abs(error), 95) < 2.5


@pytest.mark.slow
def test_a_bowl_is_found_that_no_silhouette_shows() -> None:
    bottom = DENT_AT[2] - DENT
    assert along_axis(hull()) == pytest.approx(1.1 * RADIUS, abs=1e-4)
    found = fused(hull(), maps_of(bowl=True))
    assert along_axis(found) == pytest.approx(bottom, abs=0.5 * found.cell)


@pytest.mark.slow
def test_blank_photos_leave_the_hull() -> None:
    found = fused(hull(), maps_of(blank=True))
    assert np.array_equal(found.values, hull().values)


def test_two_views_leave_the_hull() -> None:
    found = fused(hull(), dense.depth_maps(hull(), photos()[:2]))
    assert np.array_equal(found.values, hull().values)


@pytest.mark.slow
def test_pixels_that_are_not_finite_get_no_depth() -> None:
    views = photos()
    rgb = views[4].rgb.copy()
    rgb[60:80, 60:80] = np.nan
    rgb[90, 90] = np.inf
    maps = dense.depth_maps(hull(), [*views[:4], dataclasses.replace(views[4], rgb=rgb), *views[5:]])
    error = depth_errors(maps, bowl=False)
    assert len(error) > 0 and np.nanpercentile(np.abs(error), 95) < 2.5
    scale = maps.K[4, 0, 0] / views[4].K[0, 0]
    at = ((np.array([70.0, 70.0]) - views[4].K[:2, 2]) * scale + maps.K[4, :2, 2]).astype(int)
    assert np.isnan(maps.inverse[4, at[1], at[0]])


def test_a_view_beside_the_subject_has_no_depths() -> None:
    """Its mask is empty: no neighbours are needed, and the others' maps stay."""
    views = [dataclasses.replace(photo(0), alpha=np.zeros((SIDE, SIDE), np.float32)), *photos()[1:4]]
    assert not np.isfinite(dense.pictures_of(views, hull(), dense.COARSE).nearest[0]).any()
    assert not np.isfinite(dense.depth_maps(hull(), views).inverse[0]).any()


# ------------------------------------------------------------------ parts
def test_the_range_of_a_ray_is_the_balls() -> None:
    K, pose = camera(4, 9)
    cell = 0.005
    nearest, farthest = dense.hull_range(hull(RADIUS, cell), K, pose, np.ones((SIDE, SIDE), bool))
    middle = SIDE // 2
    room = dense.MARGIN * cell
    assert 1 / nearest[middle, middle] == pytest.approx(DISTANCE - RADIUS - room, abs=1e-3)
    assert 1 / farthest[middle, middle] == pytest.approx(DISTANCE + RADIUS + room, abs=1e-3)
    assert np.isnan(nearest[0, 0]) and np.isnan(farthest[0, 0])


def test_a_pair_projects_like_the_cameras() -> None:
    (K, first), (_, second) = camera(0, 9), camera(5, 9)
    a, b = dense.pair(np.stack([K, K]), np.stack([first, second]), 0, np.array([1]))
    point = np.array([[0.02, -0.03, 0.05]])
    here, z = transforms.project(K, transforms.inverse_rigid(first), np.zeros(5), point)
    there, z2 = transforms.project(K, transforms.inverse_rigid(second), np.zeros(5), point)
    q = a[0] @ np.array([*here[0], 1]) + b[0] / z[0]
    assert np.allclose(q[:2] / q[2], there[0], atol=1e-9) and q[2] * z[0] == pytest.approx(z2[0])


def test_neighbours_lie_at_good_angles_and_never_alone() -> None:
    chosen = dense.neighbours_of(hull(), photos(), alone=(4,))
    assert all(4 not in c and n not in c and len(c) for n, c in enumerate(chosen))


def test_the_sweeps_correlation_is_numpys() -> None:
    """Two pictures of one camera: each plane maps a pixel onto itself."""
    rng = np.random.default_rng(0)
    one, two = (rng.random((20, 24)).astype(np.float32) for _ in range(2))
    mask = rng.random((20, 24)) > 0.2
    out = np.full(one.shape, np.nan, np.float32)
    kernels._plane_scores(one, mask, two, np.eye(3), np.zeros(3), 1.0, (0, 20, 0, 24), 2, 0.0, out)
    for y, x in ((5, 5), (10, 12), (2, 20)):
        window = np.s_[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
        inside = mask[window]
        inside &= (np.mgrid[window][0] < 19) & (np.mgrid[window][1] < 23)  # the last ones have no bilinear neighbour
        expected = np.corrcoef(one[window][inside], two[window][inside])[0, 1]
        assert out[y, x] == pytest.approx(expected, abs=1e-4)


def test_aggregation_follows_the_recursion_on_one_row() -> None:
    """Hirschmueller's eq. 13 on a row of three pixels, written out; columns and diagonals only repeat the cost."""
    cost = np.array([[[0.0, 1.0, 2.0], [1.0, 0.0, 0.5], [0.2, 0.9, 0.1]]], np.float32)
    p1, p2 = 0.1, 0.3

    def path(rows: np.ndarray) -> np.ndarray:
        out = [rows[0]]
        for c in rows[1:]:
            before = out[-1]
            options = [[before[e] + (0, p1, p2)[min(abs(d - e), 2)] for e in range(3)] for d in range(3)]
            out.append(c + np.min(options, 1) - before.min())
        return np.array(out)

    expected = path(cost[0]) + path(cost[0][::-1])[::-1] + 6 * cost[0]
    total = np.zeros_like(cost)
    kernels.aggregate(cost, np.ones((1, 3), bool), np.float32(p1), np.float32(p2), total)
    assert np.allclose(total[0], expected, atol=1e-6)


def test_small_regions_are_dropped() -> None:
    inverse = np.full((60, 60), np.nan, np.float32)
    inverse[5:40, 5:40] = 2.0
    inverse[50:53, 50:53] = 2.0
    inverse[20:23, 20:23] = 2.2
    kept = np.isfinite(dense.without_speckles(inverse, 0.005))
    assert kept[10, 10] and not kept[51, 51] and not kept[21, 21]
    empty = np.full((4, 4), np.nan, np.float32)
    assert np.isnan(dense.without_speckles(empty, 0.005)).all()


@pytest.mark.parametrize("tilt", [0.0, 0.8, 1.3])
def test_the_cosine_of_a_tilted_plane(tilt: float) -> None:
    K = np.array([[300.0, 0, 10], [0, 300.0, 10], [0, 0, 1]])
    normal = np.array([math.sin(tilt), 0, math.cos(tilt)])  # plane normal . X = cos(tilt): through (0, 0, 1)
    m = normal / normal[2] @ np.linalg.inv(K)
    plane = np.zeros((1, 20, 20, 3), np.float32)
    u, v = np.meshgrid(np.arange(20) + 0.5, np.arange(20) + 0.5)
    plane[0, ..., 0], plane[0, ..., 1], plane[0, ..., 2] = m[0] * u + m[1] * v + m[2], m[0], m[1]
    x, y = (u - 10) / 300, (v - 10) / 300
    ray = np.stack([x, y, np.ones_like(x)], -1) / np.sqrt(1 + x * x + y * y)[..., None]
    assert np.allclose(dense.cosines(plane, K[None])[0], ray @ normal, atol=1e-4)


def test_a_hole_in_a_plane_is_closed_by_the_plane_and_not_by_the_hull() -> None:
    """Data of a plane but for a square; a hull far above it. All nodes are free."""
    shape = (24, 24, 24)
    z = np.arange(24.0) - 12
    truth = np.broadcast_to(z, shape)
    near = np.abs(truth) < 3
    weight = np.where(near, 0.8, 0.0)
    weight[9:15, 9:15] = 0
    level = np.clip(np.broadcast_to(z - 4, shape), -3, 3)
    inside = np.ones(shape, bool)
    found = closed(level, inside, truth * near, weight)
    crossing = ndimage.map_coordinates(found, np.array([[12], [12], [12]]), order=1)[0]
    assert abs(crossing) < 1.0
    nothing = closed(level, inside, truth * 0, weight * 0)
    assert abs(nothing[12, 12, 16]) < 0.5


# ------------------------------------------------------------------ choice
def test_windowed_correlation() -> None:
    rng = np.random.default_rng(1)
    one = rng.random((30, 30)).astype(np.float32)
    mask = np.ones((30, 30), bool)
    assert np.allclose(windowed(one, 0.5 * one + 0.2, mask, 0.0), 1, atol=1e-5)
    assert np.allclose(windowed(one, -one, mask, 0.0), -1, atol=1e-5)
    blind = np.full_like(one, np.nan)
    assert (windowed(one, blind, mask, 1e-3) == 0).all()
    assert np.abs(windowed(np.ones_like(one), one, mask, 1e-3)).max() < 1e-3


@pytest.mark.parametrize("views", [8, 9, 43, 400])
def test_validation_views_leave_most_to_build_with(views: int) -> None:
    found = validation_views(views)
    assert 2 <= len(set(found)) == len(found) <= views // 4 and min(found) >= 0 and max(found) < views


@pytest.mark.slow
def test_a_bowl_is_that_of_the_depth_maps() -> None:
    start, facts = stereo_start(hull(), photos(16, bowl=True), "auto", "cpu")
    assert facts["start"] == "both" and facts["dense_correlation"] > facts["sweep_correlation"]
    assert facts["dense_share"] > 0.5 and facts["start_correlation"] > facts["dense_correlation"] - 0.02
    assert along_axis(start) < 0.5 * (1.1 * RADIUS + DENT_AT[2] - DENT)


@pytest.mark.slow
def test_a_choice_of_blank_photos_leaves_the_hull() -> None:
    start, facts = stereo_start(hull(), photos(9, blank=True), "auto", "cpu")
    assert abs(along_axis(start) - 1.1 * RADIUS) < 0.003 and facts["dense_share"] == pytest.approx(0.5, abs=0.2)


def test_few_views_give_no_choice() -> None:
    _, facts = stereo_start(hull(), photos()[:3], "auto", "cpu")
    assert facts == {"start": "sweep", "why": "fewer than 8 views"}


@pytest.mark.parametrize(
    ("given", "meant"), [(True, "auto"), ("false", "off"), (False, "off"), ("dense", "dense"), ("sweep", "sweep")]
)
def test_the_setting_reads_its_old_values(given: object, meant: str) -> None:
    assert Config.model_validate({"stereo": given}).stereo == meant


def test_an_unknown_kind_of_stereo_is_refused() -> None:
    with pytest.raises(ValueError, match="stereo"):
        Config.model_validate({"stereo": "psychic"})
