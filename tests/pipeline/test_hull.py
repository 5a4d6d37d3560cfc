"""The visual hull against bodies whose silhouettes and volumes are known in closed form."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.hull import Cloud, Hull, cloud, hull_bounds, hull_sdf, render_silhouette, surface_points, visual_hull
from pipeline.silhouettes import signed_pixels
from pipeline.transforms import matrix, pixel_centres, rays, rigid, rows

F32 = npt.NDArray[np.float32]
LENS = (-0.35, 0.1, 0.004, -0.003, 0.0)
SIZE, RADIUS, CELL = 128, 0.1, 0.008


def looking_at(
    centre: list[float] | npt.NDArray[np.float64],
    index: int = 0,
    focal: float = 300.0,
    distortion: tuple[float, float, float, float, float] = (0, 0, 0, 0, 0),
    size: int = SIZE,
) -> Camera:
    """A camera at `centre` with its axis through the origin."""
    centre = np.asarray(centre, np.float64)
    z = -centre / np.linalg.norm(centre)
    x = np.cross(z, [0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    world_from_cam = rigid(np.stack([x, np.cross(z, x), z], 1), centre)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera(index=index, name=f"{index}.png", width=size, height=size, K=rows(K),
                  world_from_cam=rows(world_from_cam), distortion=distortion)  # fmt: skip


def around(count: int, distance: float = 1.0, **more: object) -> list[Camera]:
    """Cameras spread evenly over a sphere (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    y, turn = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - y * y)
    points = distance * np.stack([ring * np.cos(turn), y, ring * np.sin(turn)], 1)
    return [looking_at(p, k, **more) for k, p in enumerate(points)]  # type: ignore[arg-type]


def sphere_alpha(camera: Camera, radius: float = RADIUS, centre: tuple[float, float, float] = (0, 0, 0)) -> F32:
    """Share of every pixel that the sphere fills, from the distance at which its central ray passes the centre."""
    uv = pixel_centres(camera.width, camera.height)
    origin, d = rays(matrix(camera.K), matrix(camera.world_from_cam), np.array(camera.distortion, np.float64), uv)
    to = np.asarray(centre, np.float64) - origin
    along = d @ to
    passed = np.sqrt(np.maximum(to @ to - along**2, 0))
    pixel = np.maximum(along, 1e-9) / camera.K[0][0]  # a pixel's edge at that depth
    alpha = np.where(along > 0, (0.5 + (radius - passed) / pixel).clip(0, 1), 0)
    return np.asarray(alpha.reshape(camera.height, camera.width), np.float32)


def box_alpha(camera: Camera, half: npt.NDArray[np.float64]) -> F32:
    n = 2
    uv = pixel_centres(camera.width * n, camera.height * n) / n
    origin, d = rays(matrix(camera.K), matrix(camera.world_from_cam), np.array(camera.distortion, np.float64), uv)
    a, b = (-half - origin) / d, (half - origin) / d
    hit = np.minimum(a, b).max(1) < np.maximum(a, b).min(1)
    return np.asarray(hit.reshape(camera.height, n, camera.width, n).mean((1, 3)), np.float32)


def cube(edge: float = 0.16) -> tuple[list[float], list[float]]:
    return [-edge] * 3, [edge] * 3


@pytest.fixture(scope="module")
def ball() -> tuple[list[Camera], list[F32], Hull]:
    cameras = around(40)
    alphas = [sphere_alpha(c) for c in cameras]
    return cameras, alphas, visual_hull(cameras, alphas, *cube(), CELL)


def test_sphere_volume_and_surface(ball: tuple[list[Camera], list[F32], Hull]) -> None:
    hull = ball[2]
    volume = (hull.level <= 0).sum() * CELL**3 / (4 / 3 * np.pi * RADIUS**3)
    assert 0.99 < volume < 1.04  # a hull of 40 cones is a little larger than the ball, never smaller
    radius = np.linalg.norm(surface_points(hull), axis=1)
    assert radius.min() > RADIUS - 0.12 * CELL
    assert np.abs(np.median(radius) - RADIUS) < 0.12 * CELL
    assert radius.max() < RADIUS + 0.9 * CELL


def test_occupied_never_loses_the_body(ball: tuple[list[Camera], list[F32], Hull]) -> None:
    hull = ball[2]
    distance = np.linalg.norm(hull.centres(np.ones(hull.occupied.shape, bool)), axis=1).reshape(hull.occupied.shape)
    assert hull.occupied[distance < RADIUS + 0.3 * CELL].all()
    assert not hull.occupied[distance > RADIUS + 2 * CELL].any()
    assert (hull.occupied >= (hull.level <= 0)).all()


def test_coarse_to_fine_equals_every_voxel_asked(ball: tuple[list[Camera], list[F32], Hull]) -> None:
    """Voxels one by one through the public projection: no shortcut of the octree may change a sign."""
    from pipeline.silhouettes import outside, silhouette

    cameras, alphas, hull = ball
    points = hull.centres(np.ones(hull.occupied.shape, bool))
    worst = np.full(len(points), -np.inf)
    for c, a in zip(cameras, alphas, strict=True):
        value, sees, _ = outside(silhouette(c, a, np.zeros(3), CELL), points, 0.0)
        worst = np.where(sees, np.maximum(worst, value), worst)
    assert ((worst <= 0) == (hull.level <= 0).ravel()).all()
    near = np.abs(worst) < CELL
    assert np.abs(worst[near] - hull.level.ravel()[near]).max() < 1e-6


def test_sdf_of_sphere(ball: tuple[list[Camera], list[F32], Hull]) -> None:
    hull = ball[2]
    sdf = hull_sdf(hull)
    distance = np.linalg.norm(hull.centres(np.ones(sdf.shape, bool)), axis=1).reshape(sdf.shape) - RADIUS
    assert sdf.dtype == np.float32 and sdf[tuple(n // 2 for n in sdf.shape)] < 0 < sdf[0, 0, 0]
    error = sdf - distance
    near = np.abs(distance) < 2 * CELL
    assert np.abs(error[near]).mean() < 0.15 * CELL
    assert np.abs(error).max() < 1.0 * CELL


def test_sdf_of_empty_and_full() -> None:
    level = np.full((3, 4, 5), 0.1, np.float32)
    empty = Hull(level <= 0, level, np.zeros((3, 4, 5), np.int16), np.zeros(3), 0.1)
    assert (hull_sdf(empty) > 0).all()
    full = Hull(level > 0, -level, np.zeros((3, 4, 5), np.int16), np.zeros(3), 0.1)
    assert (hull_sdf(full) < 0).all()


def test_box_volume_with_axes_and_bounds() -> None:
    half = np.array([0.06, 0.09, 0.03])
    cameras = around(30, distance=3.0, focal=900.0) + [
        looking_at(p, 50, focal=900.0) for p in ([3.0, 0, 0], [0, 3.0, 0], [0, 0, 3.0])
    ]
    alphas = [box_alpha(c, half) for c in cameras]
    hull = visual_hull(cameras, alphas, [-0.1, -0.12, -0.08], [0.1, 0.12, 0.08], CELL)
    assert hull.occupied.shape == (25, 30, 20)  # indexed x, y, z
    assert (hull.level <= 0).sum() * CELL**3 / (8 * half.prod()) == pytest.approx(1, abs=0.12)
    lo, hi = hull_bounds(cameras, alphas, 0.12, margin=0.0)
    cell = 2 * 1.6 * 0.12 / 64
    assert np.abs(hi - half).max() < 1.6 * cell and np.abs(lo + half).max() < 1.6 * cell
    wide = hull_bounds(cameras, alphas, 0.12, margin=0.05)
    assert np.allclose(wide[1] - hi, 0.05 * (hi - lo).max())


def test_bounds_search_a_reach_beyond_the_region_of_interest() -> None:
    """A cube of 1.6 * 0.04 cuts the box at 0.064 of its 0.09; a reach that holds the box finds all of it."""
    half = np.array([0.06, 0.09, 0.03])
    cameras = around(12, distance=3.0, focal=900.0)
    cameras += [looking_at(p, 50, focal=900.0) for p in ([3.0, 0, 0], [0, 3.0, 0], [0, 0, 3.0])]
    alphas = [box_alpha(c, half) for c in cameras]
    short = hull_bounds(cameras, alphas, 0.04, margin=0.05)
    assert short[1][1] == pytest.approx(0.064) and short[0][1] == pytest.approx(-0.064)
    reach = np.array([-0.01, -0.02, -0.01]), np.array([0.01, 0.15, 0.01])  # smaller than the cube in some directions
    lo, hi = hull_bounds(cameras, alphas, 0.04, margin=0.0, reach=reach)
    cell = (0.15 + 0.064) / 64
    assert hi[1] == pytest.approx(half[1], abs=1.6 * cell)
    assert lo[1] == pytest.approx(-0.064, abs=cell) and abs(hi[0] - half[0]) < 1.6 * cell  # the cube still counts


def test_distortion_is_respected() -> None:
    cameras = around(24, distance=0.5, distortion=LENS, focal=120.0)
    centre = (0.05, 0.03, -0.04)  # off the axis, where the lens matters
    alphas = [sphere_alpha(c, 0.06, centre) for c in cameras]
    hull = visual_hull(cameras, alphas, *cube(), CELL)
    radius = np.linalg.norm(surface_points(hull) - centre, axis=1)
    assert radius.min() > 0.06 - 0.15 * CELL and abs(np.median(radius) - 0.06) < 0.2 * CELL
    straight = [c.model_copy(update={"distortion": (0.0,) * 5}) for c in cameras]
    wrong = np.linalg.norm(surface_points(visual_hull(straight, alphas, *cube(), CELL)) - centre, axis=1)
    assert wrong.min() < 0.06 - 0.3 * CELL  # without the lens the ball is eaten into: the test would notice


def test_a_view_that_does_not_see_a_point_has_no_opinion() -> None:
    cameras = around(20)
    alphas = [sphere_alpha(c) for c in cameras]
    # a camera beside the ball, looking past it, and one that looks away: their frames are all background
    past = looking_at([0.0, 0.0, 1.0], 90, focal=300.0)
    shifted = matrix(past.world_from_cam)
    shifted[0, 3] += 0.5
    past = past.model_copy(update={"world_from_cam": rows(shifted)})
    turned = matrix(cameras[0].world_from_cam)
    turned[:3, :3] = turned[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    away = cameras[0].model_copy(update={"world_from_cam": rows(turned)})
    nothing = np.zeros((SIZE, SIZE), np.float32)
    with_them = visual_hull([*cameras, past, away], [*alphas, nothing, nothing], *cube(), CELL)
    assert ((with_them.level <= 0) == (visual_hull(cameras, alphas, *cube(), CELL).level <= 0)).all()


def test_body_cut_by_the_frame_stays_whole() -> None:
    """Close-ups that show only part of the ball must not carve what lies outside their frames."""
    wide, close = around(24), around(24, focal=1500.0)
    alphas = [sphere_alpha(c) for c in wide + close]
    hull = visual_hull(wide + close, alphas, *cube(), CELL)
    assert (hull.level <= 0).sum() * CELL**3 / (4 / 3 * np.pi * RADIUS**3) > 0.99


def test_unseen_space_is_empty_and_min_views_counts() -> None:
    cameras = [looking_at([0, 0, 1.0], 0), looking_at([1.0, 0, 0], 1)]
    alphas = [sphere_alpha(c) for c in cameras]
    assert not visual_hull(cameras, alphas, *cube(), CELL).occupied.any()
    two = visual_hull(cameras, alphas, *cube(), CELL, min_views=2)
    assert two.occupied.any() and two.seen[tuple(n // 2 for n in two.seen.shape)] == 2
    beyond = visual_hull(cameras, alphas, [-1.0, 0.5, -0.2], [-0.5, 0.9, 0.2], 0.05, min_views=0)
    assert beyond.occupied.all()  # nobody sees it, nobody may say that it is empty


def test_tolerance_for_wrong_views() -> None:
    cameras = around(40)
    alphas = [sphere_alpha(c) for c in cameras]
    alphas[7] = np.zeros_like(alphas[7])
    assert not visual_hull(cameras, alphas, *cube(), CELL).occupied.any()
    kept = visual_hull(cameras, alphas, *cube(), CELL, max_outside=1)
    assert (kept.level <= 0).sum() * CELL**3 / (4 / 3 * np.pi * RADIUS**3) == pytest.approx(1.02, abs=0.05)
    strict = visual_hull(cameras, alphas, *cube(), CELL, max_outside=1, outside_share=0.02)  # 0.02 * 40 < 1
    assert not strict.occupied.any()


def test_thin_part_survives_coarse_voxels() -> None:
    """A plate of a third of a voxel, off the voxel centres."""
    half = np.array([0.08, 0.08, 0.0013])
    cameras = around(16, distance=3.0, focal=1800.0, size=256)
    alphas = [box_alpha(c, half) for c in cameras]
    hull = visual_hull(cameras, alphas, *cube(), CELL)
    middle = hull.occupied[11:29, 11:29]
    assert middle.any(2).mean() > 0.95


def test_silhouette_matches_the_photo(ball: tuple[list[Camera], list[F32], Hull]) -> None:
    hull = ball[2]
    for camera in (looking_at([0.5, 0.4, 0.8]), looking_at([0.3, -0.7, 0.6], distortion=LENS)):
        truth = sphere_alpha(camera) >= 0.5
        for size in (SIZE, 2 * SIZE):
            found = render_silhouette(cloud(hull), camera, size, size)
            assert found.dtype == np.float32 and found.shape == (size, size)
            scaled = np.kron(truth, np.ones((size // SIZE, size // SIZE), bool))
            assert ((found >= 0.5) & scaled).sum() / ((found >= 0.5) | scaled).sum() > 0.955
    behind = looking_at([0.0, 0.0, 1.0])
    turned = matrix(behind.world_from_cam)
    turned[:3, :3] = turned[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    assert not render_silhouette(cloud(hull), behind.model_copy(update={"world_from_cam": rows(turned)}), 64, 64).any()


@pytest.mark.parametrize("edge", [0.16, 0.05])  # the ball, and a cube in it: all of its surface is the grid's border
def test_the_shell_covers_what_all_voxels_cover(edge: float) -> None:
    cameras = around(40)
    hull = visual_hull(cameras, [sphere_alpha(c) for c in cameras], *cube(edge), CELL)
    points = cloud(hull)
    assert len(points.shell) < 0.5 * len(points.inside)
    every = Cloud(points.inside, points.inside, points.cell)
    for camera in (
        *around(5),
        looking_at([0.3, -0.2, 0.25], focal=150.0),
        looking_at([0.5, 0.1, 1.0], distortion=LENS),
    ):
        found = render_silhouette(points, camera, SIZE, SIZE)
        assert found.any()
        assert (found == render_silhouette(every, camera, SIZE, SIZE)).all()


def test_an_empty_hull_has_no_silhouette() -> None:
    level = np.full((3, 4, 5), 0.1, np.float32)
    empty = Hull(level <= 0, level, np.zeros((3, 4, 5), np.int16), np.zeros(3), 0.1)
    assert not render_silhouette(cloud(empty), looking_at([0.0, 0.0, 1.0]), 32, 32).any()


def test_signed_pixels_are_sub_pixel() -> None:
    ramp = np.zeros((9, 20), np.float32)
    ramp[:, 10:] = 1
    ramp[:, 10] = 0.8  # the edge lies 0.2 pixels inside column 10: at x = 10.2
    distance = signed_pixels(ramp)[4]
    expected = 10.2 - (np.arange(20) + 0.5)
    assert np.abs(distance - expected).max() < 0.06
    assert (signed_pixels(np.zeros((4, 5), np.float32)) > 6).all()
    assert (signed_pixels(np.ones((4, 5), np.float32)) < -6).all()


@pytest.mark.parametrize(
    ("cameras", "lo", "hi", "cell", "word"),
    [
        (0, [-1, -1, -1], [1, 1, 1], 0.1, "no silhouettes"),
        (3, [1, -1, -1], [1, 1, 1], 0.1, "box is empty"),
        (3, [-1, -1, -1], [1, 1, 1], 0.0, "box is empty"),
        (3, [-1, -1, float("nan")], [1, 1, 1], 0.1, "box is empty"),
        (3, [-1, -1, -1], [1, 1, 1], 1e-4, "too many voxels"),
    ],
)
def test_bad_input(cameras: int, lo: list[float], hi: list[float], cell: float, word: str) -> None:
    views = around(3)[:cameras]
    with pytest.raises(StageError, match=word):
        visual_hull(views, [np.ones((8, 8), np.float32)] * cameras, lo, hi, cell)


def test_bounds_of_nothing() -> None:
    cameras = around(5)
    with pytest.raises(StageError, match="the visual hull is empty"):
        hull_bounds(cameras, [np.zeros((16, 16), np.float32)] * 5, 0.1)
