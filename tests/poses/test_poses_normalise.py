"""Centre, axes, scale and radius of the region of interest, for given and for solved cameras."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts import Camera
from pipeline.errors import StageError
from pipeline.faces.landmarks3d import HeadFrame
from pipeline.transforms import F64, apply, matrix, project, rescale_camera, rows, similarity
from stages.poses.normalise import NOMINAL_ROI, Normalisation, least_turn, nearest_point, normalise, robust_direction
from stages.poses.scale import Eyes, Scale
from stages.poses.write_cameras import in_asset
from tests.support.textured_ball import camera_on_orbit

SIZE = (400, 300)
FOCAL = 800.0
TARGET = np.array([0.3, -0.2, 0.5])
TRUE_ROI = 150 / FOCAL * 1.0  # half the smaller field of view at a distance of 1


def camera(i: int, world_from_cam: F64) -> Camera:
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    return Camera(
        index=i, name=f"{i}.jpg", width=SIZE[0], height=SIZE[1], K=rows(K), world_from_cam=rows(world_from_cam),
        distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip


def orbit(elevations: tuple[float, ...] = (-20, 10, 35), spread: float = 100) -> list[F64]:
    return [camera_on_orbit(a, e, 1.0, TARGET) for e in elevations for a in np.linspace(-spread, spread, 9)]


def cameras(poses: list[F64], through: F64 | None = None) -> list[Camera]:
    through = np.eye(4) if through is None else through
    return [camera(i, rescale_camera(through, p)) for i, p in enumerate(poses)]


def head_points(count: int = 2000) -> F64:
    rng = np.random.default_rng(0)
    d = rng.normal(size=(count, 3))
    return TARGET + d / np.linalg.norm(d, axis=1, keepdims=True) * [0.08, 0.12, 0.1]


def check_rigid(found: Normalisation) -> None:
    s = found.capture_from_asset[:3, :3]
    scale = np.cbrt(np.linalg.det(s))
    assert scale > 0
    np.testing.assert_allclose(s @ s.T, np.eye(3) * scale**2, atol=1e-9 * scale**2)


def test_metric_cameras_keep_their_world() -> None:
    found = normalise(cameras(orbit()), given=True)
    assert found.metric and found.warnings == ()
    assert found.roi_radius == pytest.approx(TRUE_ROI, rel=1e-9)
    np.testing.assert_allclose(found.capture_from_asset, similarity(1, np.eye(3), TARGET), atol=1e-9)


@pytest.mark.parametrize(("unit", "factor"), [("millimetres", 1e3), ("centimetres", 1e2)])
def test_other_units_are_recognised_and_told(unit: str, factor: float) -> None:
    found = normalise(cameras(orbit(), similarity(factor, np.eye(3), np.zeros(3))), given=True)
    assert found.metric and unit in found.warnings[0]
    assert found.roi_radius == pytest.approx(TRUE_ROI)
    np.testing.assert_allclose(found.capture_from_asset, similarity(factor, np.eye(3), TARGET * factor), rtol=1e-9)


@pytest.mark.parametrize("factor", [1e-3, 12.0, 1e5])
def test_implausible_units_are_scaled_to_a_nominal_head(factor: float) -> None:
    found = normalise(cameras(orbit(), similarity(factor, np.eye(3), np.zeros(3))), given=True)
    assert not found.metric and "unknown" in found.warnings[0]
    assert found.roi_radius == pytest.approx(NOMINAL_ROI)
    np.testing.assert_allclose(apply(found.capture_from_asset, np.zeros((1, 3)))[0], TARGET * factor, rtol=1e-6)
    check_rigid(found)


def test_a_guessed_size_counts_only_where_it_is_a_head_s_and_none_is_known() -> None:
    through = similarity(12.0, np.eye(3), np.zeros(3))
    args = {"given": False, "points": apply(through, head_points())}
    plain = normalise(cameras(orbit(), through), **args)
    radius = plain.roi_radius / np.cbrt(np.linalg.det(np.linalg.inv(plain.capture_from_asset)[:3, :3]))
    found = normalise(cameras(orbit(), through), **args, guess=lambda: Scale(0.15 / radius, "guessed"))
    assert found.roi_radius == pytest.approx(0.15) and found.scale == "guessed" and not found.metric
    huge = normalise(cameras(orbit(), through), **args, guess=lambda: Scale(9.0 / radius, "guessed"))
    assert huge.roi_radius == pytest.approx(NOMINAL_ROI) and huge.scale != "guessed"
    known = normalise(cameras(orbit(), through), **args, known=Scale(0.2 / radius, "a tape"),
                      guess=lambda: Scale(0.15 / radius, "guessed"))  # fmt: skip
    assert known.roi_radius == pytest.approx(0.2) and known.metric


def test_a_world_with_z_up_is_turned() -> None:
    turn = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # y -> z
    found = normalise(cameras(orbit((0,)), similarity(1, turn, np.zeros(3))), given=True)
    up = found.capture_from_asset[:3, :3] @ [0, 1, 0]
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
    assert "rotated" in found.warnings[0]
    check_rigid(found)


def test_a_world_tilted_by_less_than_the_limit_stays() -> None:
    turn = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    found = normalise(cameras(orbit((0,)), similarity(1, turn, np.zeros(3))), given=True)
    np.testing.assert_allclose(found.capture_from_asset[:3, :3], np.eye(3), atol=1e-12)


def test_cameras_hung_upside_down_one_by_one_do_not_decide() -> None:
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    poses = [p @ flip if i % 5 == 0 else p for i, p in enumerate(orbit((0, 10)))]
    found = normalise(cameras(poses), given=True)
    np.testing.assert_allclose(found.capture_from_asset[:3, :3], np.eye(3), atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_solved_cameras_in_any_frame_come_out_upright_facing_z(seed: int) -> None:
    """The frame of a structure from motion is arbitrary: the asset's must not depend on it."""
    rng = np.random.default_rng(seed)
    through = similarity(float(rng.uniform(0.1, 30)), Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 5)
    found = normalise(cameras(orbit(), through), apply(through, head_points()), given=False)
    check_rigid(found)
    assert not found.metric and found.roi_radius == pytest.approx(NOMINAL_ROI)
    truth_from_asset = np.linalg.inv(through) @ found.capture_from_asset
    axes = truth_from_asset[:3, :3] / np.cbrt(np.linalg.det(truth_from_asset[:3, :3]))
    np.testing.assert_allclose(axes, np.eye(3), atol=5e-3)  # 0.3 degrees
    assert np.linalg.norm(truth_from_asset[:3, 3] - TARGET) < 0.01


def test_up_does_not_lean_back_with_cameras_that_all_look_down() -> None:
    found = normalise(cameras(orbit((35,))), head_points(), given=False)
    assert np.degrees(np.arccos(found.capture_from_asset[:3, 1] @ [0, 1, 0] / np.cbrt(
        np.linalg.det(found.capture_from_asset[:3, :3])))) < 2  # fmt: skip


def test_a_table_tells_up_where_photos_were_held_sideways() -> None:
    """Two thirds of the photos are held sideways, so that the cameras' own up is wrong by a quarter turn."""
    quarter = similarity(1.0, Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.zeros(3))
    poses = [camera_on_orbit(a, e, 1.0, TARGET) for e in (20, 45) for a in range(0, 360, 30)]
    held = [p @ quarter if i % 3 else p for i, p in enumerate(poses)]
    random = np.random.default_rng(4)
    table = random.uniform(-0.4, 0.4, (900, 3)) * (1, 0, 1) + TARGET + (0, -0.1, 0)
    points = np.concatenate([head_points(1500), table[np.linalg.norm(table - TARGET, axis=1) > 0.12]])
    turned = similarity(2.0, Rotation.from_euler("xyz", [40, 160, 70], degrees=True).as_matrix(), np.ones(3))
    found = normalise(cameras(held, turned), apply(turned, points), given=False)
    up = np.linalg.inv(found.capture_from_asset)[:3, :3] @ turned[:3, :3] @ [0.0, 1, 0]
    assert up[1] / np.linalg.norm(up) > 0.999
    bare = normalise(cameras(held, turned), apply(turned, head_points(1500)), given=False)
    up = np.linalg.inv(bare.capture_from_asset)[:3, :3] @ turned[:3, :3] @ [0.0, 1, 0]
    assert up[1] / np.linalg.norm(up) < 0.5


def test_cameras_all_around_have_a_front_too() -> None:
    poses = [camera_on_orbit(a, 5, 1.0, TARGET) for a in np.arange(0, 360, 15)]
    check_rigid(normalise(cameras(poses), given=False))


def test_a_face_says_what_is_in_front() -> None:
    """A level ring of cameras has no side of its own: eyes have, unless they are elsewhere or one above the other."""
    ring = cameras([camera_on_orbit(a, 5.0, 1.0, np.zeros(3)) for a in range(0, 360, 24)])
    turn = np.radians(70.0)
    looks = np.array([np.sin(turn), 0.0, np.cos(turn)])
    left = np.cross([0.0, 1.0, 0.0], looks)
    eyes = Eyes(0.08 * looks - 0.03 * left, 0.08 * looks + 0.03 * left, 5, 0.01)
    found = normalise(ring, given=False, eyes=eyes).capture_from_asset
    np.testing.assert_allclose(found[:3, 2] / np.linalg.norm(found[:3, 2]), looks, atol=1e-6)
    np.testing.assert_allclose(found[:3, 1] / np.linalg.norm(found[:3, 1]), [0, 1, 0], atol=1e-6)
    without = normalise(ring, given=False).capture_from_asset
    behind = Eyes(eyes.right + 3 * looks, eyes.left + 3 * looks, 5, 0.01)
    lying = Eyes(0.08 * looks - [0, 0.03, 0], 0.08 * looks + [0, 0.03, 0], 5, 0.01)
    for other in (behind, lying):
        found = normalise(ring, given=False, eyes=other).capture_from_asset
        np.testing.assert_array_equal(found, without)


def test_a_wall_behind_a_person_is_no_floor() -> None:
    """Photos around a person before a wall, from above and below: the wall's plane has the cameras on one side and
    nothing behind it. A bust on a table is upright on it, and the table is more exact than the face."""
    poses = [camera_on_orbit(a, e, 1.0, TARGET) for e in (-30, 5, 40, 65) for a in np.linspace(-75, 75, 9)]
    random = np.random.default_rng(7)
    lean = Rotation.from_euler("x", -35, degrees=True).as_matrix()
    wall = random.uniform(-0.4, 0.4, (2000, 3)) * (1, 1, 0) @ lean.T + TARGET - [0, 0, 0.2]
    turned = similarity(2.0, Rotation.from_euler("xyz", [40, 160, 70], degrees=True).as_matrix(), np.ones(3))
    seen = apply(turned, np.concatenate([head_points(1500), wall]))
    turn = turned[:3, :3] / 2.0
    for tilt, upright in ((0.0, True), (60.0, True)):
        looks = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
        at = apply(turned, TARGET[None])[0]
        head = HeadFrame(looks @ turn.T, at, at, at)
        found = normalise(cameras(poses, turned), seen, given=False, head=head).capture_from_asset
        axes = found[:3, :3] / np.cbrt(np.linalg.det(found[:3, :3]))
        assert (np.abs(axes - head.axes.T).max() < 1e-9) == upright


def test_a_floor_under_a_bust_is_more_exact_than_its_face() -> None:
    poses = [camera_on_orbit(a, e, 1.0, TARGET) for e in (20, 45) for a in range(0, 360, 30)]
    random = np.random.default_rng(4)
    table = random.uniform(-0.4, 0.4, (900, 3)) * (1, 0, 1) + TARGET + (0, -0.1, 0)
    points = np.concatenate([head_points(1500), table[np.linalg.norm(table - TARGET, axis=1) > 0.12]])
    for tilt, by_floor in ((12.0, True), (50.0, False)):
        axes = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
        head = HeadFrame(axes, TARGET, TARGET, TARGET)
        found = normalise(cameras(poses), points, given=False, head=head).capture_from_asset[:3, 1]
        up = found / np.linalg.norm(found)
        assert (up[1] > 0.9999) == by_floor
        assert (up @ axes[1] > 0.9999) != by_floor


def test_points_far_off_do_not_move_the_centre() -> None:
    table = np.random.default_rng(1).uniform(-4, 4, (5000, 3)) + [0, -3, 0]
    clean = normalise(cameras(orbit()), head_points(), given=False)
    crowded = normalise(cameras(orbit()), np.concatenate([head_points(), table]), given=False)
    shift = np.linalg.norm(crowded.capture_from_asset[:3, 3] - clean.capture_from_asset[:3, 3])
    assert shift < 0.2 * TRUE_ROI


def test_every_head_point_stays_in_the_region_of_interest() -> None:
    found = normalise(cameras(orbit()), head_points(), given=False)
    p = apply(np.linalg.inv(found.capture_from_asset), head_points())
    assert np.linalg.norm(p, axis=1).max() < found.roi_radius


def test_projections_are_the_same_in_asset_coordinates() -> None:
    """Moving cameras and points together must not move a pixel."""
    through = similarity(37.0, Rotation.random(rng=np.random.default_rng(3)).as_matrix(), np.array([1.0, 2, 3]))
    before = cameras(orbit(), through)
    found = normalise(before, given=True)
    points = apply(through, head_points(50))
    moved = apply(np.linalg.inv(found.capture_from_asset), points)
    for a, b in zip(before, in_asset(before, found.capture_from_asset), strict=True):
        K, d = matrix(a.K), np.array(a.distortion)
        uv, _ = project(K, np.linalg.inv(matrix(a.world_from_cam)), d, points)
        uv2, _ = project(K, np.linalg.inv(matrix(b.world_from_cam)), d, moved)
        np.testing.assert_allclose(uv, uv2, atol=1e-7)
    np.testing.assert_allclose(apply(found.capture_from_asset, moved), points, atol=1e-9)


def test_a_few_cameras_aimed_elsewhere_do_not_move_the_centre() -> None:
    stray = [camera_on_orbit(a, 0, 1.0, TARGET + [0, 0.4, 0]) for a in (0, 40, 80)]
    found = normalise(cameras(orbit() + stray), given=True)
    assert np.linalg.norm(found.capture_from_asset[:3, 3] - TARGET) < 0.01


def test_nearest_point_of_two_skew_lines_lies_between_them() -> None:
    centres = np.array([[0.0, 0, -1], [-1, 0.2, 0]])
    x = nearest_point(centres, np.array([[0.0, 0, 1], [1, 0, 0]]))
    assert x[[0, 2]] == pytest.approx([0, 0], abs=1e-9) and -1e-9 <= x[1] <= 0.2 + 1e-9


# ------------------------------------------------------------------ bad cameras
def test_parallel_views_are_refused() -> None:
    pose = camera_on_orbit(0, 0, 1, TARGET)
    poses = []
    for x in range(4):
        shifted = pose.copy()
        shifted[0, 3] += x
        poses.append(shifted)
    with pytest.raises(StageError, match="parallel"):
        normalise(cameras(poses), given=True)


def test_inverted_extrinsics_are_refused() -> None:
    looking_away = [p @ np.diag([1.0, -1, -1, 1]) for p in orbit()]  # OpenGL axes taken for OpenCV's
    with pytest.raises(StageError, match="look away") as caught:
        normalise(cameras(looking_away), given=True)
    assert "OpenGL" in caught.value.remedy


def test_one_camera_that_looks_away_is_named() -> None:
    poses = orbit()
    poses[4] = poses[4] @ np.diag([1.0, -1, -1, 1])
    assert "4.jpg looks away" in normalise(cameras(poses), given=True).warnings[0]


# ------------------------------------------------------------------ small parts
@pytest.mark.parametrize("b", [[0, 1, 0], [1, 0, 0], [0, -1, 0], [0.6, 0, 0.8]])
def test_least_turn(b: list[float]) -> None:
    a = np.array([0.0, 1.0, 0.0])
    R = least_turn(a, np.array(b))
    np.testing.assert_allclose(R @ a, b, atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    angle = np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))
    assert angle == pytest.approx(np.arccos(a @ b), abs=1e-6)


def test_robust_direction_has_none_where_all_cancels() -> None:
    assert robust_direction(np.array([[0.0, 1, 0], [0, -1, 0]])) is None
    mixed = np.array([[0.0, 1, 0]] * 5 + [[1.0, 0, 0]] * 2)
    np.testing.assert_allclose(robust_direction(mixed), [0, 1, 0], atol=0.05)


def test_points_out_of_view() -> None:
    """What a solver makes of photos from one spot: points anywhere but where the cameras look."""
    points = np.random.default_rng(0).normal(size=(500, 3)) + [0, 1e3, 0]
    with pytest.raises(StageError, match="one spot") as caught:
        normalise(cameras(orbit()), points, given=False)
    assert "walk around" in caught.value.remedy


# ------------------------------------------------------------------ a face in a given world
def head_turned(turn: F64, eyes: F64 = TARGET) -> HeadFrame:
    """A head whose left, up and front are the rows of `turn`, its eyes at a point."""
    return HeadFrame(turn, eyes, eyes - 0.1 * turn[1], eyes + 0.08 * turn[1])


@pytest.mark.parametrize(("yaw", "turned"), [(0, False), (8, False), (12, True), (45, True), (180, True)])
def test_a_given_world_is_turned_to_the_face(yaw: float, turned: bool) -> None:
    """The face looks along +Z afterwards, and the given world is found again through capture_from_asset."""
    turn = Rotation.from_euler("y", yaw, degrees=True).as_matrix().T
    found = normalise(cameras(orbit()), given=True, head=head_turned(turn))
    linear = found.capture_from_asset[:3, :3] / np.cbrt(np.linalg.det(found.capture_from_asset[:3, :3]))
    np.testing.assert_allclose(linear, turn.T if turned else np.eye(3), atol=1e-12)
    assert any("rotated by its landmarks" in w for w in found.warnings) == turned


def test_a_given_world_whose_up_is_another_axis_stands_by_the_face() -> None:
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # +Z is up, the face looks along -Y
    found = normalise(cameras(orbit()), given=True, head=head_turned(turn)).capture_from_asset
    np.testing.assert_allclose(found[:3, 1] / np.linalg.norm(found[:3, 1]), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found[:3, 2] / np.linalg.norm(found[:3, 2]), [0, -1, 0], atol=1e-12)


def test_a_face_elsewhere_and_published_axes_leave_a_given_world() -> None:
    turn = Rotation.from_euler("y", 60, degrees=True).as_matrix().T
    poster = normalise(cameras(orbit()), given=True, head=head_turned(turn, TARGET + [0, 0, -2.0]))
    known = normalise(cameras(orbit()), given=True, head=head_turned(turn), axes=np.eye(3))
    for found in (poster, known):
        np.testing.assert_allclose(found.capture_from_asset[:3, 0] / found.capture_from_asset[0, 0], [1, 0, 0])
