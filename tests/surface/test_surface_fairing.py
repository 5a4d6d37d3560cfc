"""Surface that no photo shows: smooth, closed, and nothing else changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline import meshes
from pipeline.artifacts import Cut, Extent, Located, MaskSet
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.fields.faired import Faired, fair_again
from pipeline.fields.protocol import Field
from pipeline.images import write_png
from pipeline.meshes import F64, Mask
from pipeline.visibility import FittedPhoto, Occluder, looks_into
from stages.surface import build as building
from stages.surface import fairing
from stages.surface.fairing import Looked, faired, low_pass
from stages.surface.stage import Config, Inputs, run
from tests.support.analytic_fields import AnalyticField, Distance, bumpy_head, sphere, union
from tests.support.field_artifacts import camera, fitted, poses

SHARE = 0.05  # of the box's longest side, .26 m: 13 mm
BOX = (0.12, 0.12, 0.13)


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid of 4 mm, for speed."""
    monkeypatch.setattr(fairing, "CELLS", 65)


def quiet(done: int, total: int) -> None:
    """No progress shown."""


def from_the_front(rough: Occluder, points: F64) -> tuple[Mask, Mask]:
    """One camera on +z, far away: what is before the surface along z."""
    there = FittedPhoto(camera(0, 0.0, 1.0, focal=100.0), None)
    return looks_into(there, points, rough)


def nowhere(rough: Occluder, points: F64) -> tuple[Mask, Mask]:
    return np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)


def everywhere(rough: Occluder, points: F64) -> tuple[Mask, Mask]:
    return np.ones(len(points), np.bool_), np.ones(len(points), np.bool_)


def mesh_of(distance: Distance, looked: Looked, share: float = SHARE) -> building.Built:
    return building.build(faired(AnalyticField(distance, BOX), share, looked, quiet), 64, quiet)


def behind(z: float, radius: float) -> Distance:
    """A head with a knob behind it."""
    return union(sphere(0.08), sphere(radius, (0.0, 0.0, z)))


def test_each_wave_is_damped_by_the_formula() -> None:
    shape, length = (24, 31, 40), 2.7
    x, y, z = np.meshgrid(*(np.arange(n) + 0.5 for n in shape), indexing="ij")
    for i, j, k in ((0, 0, 0), (1, 0, 0), (0, 5, 2), (9, 20, 33)):
        wave = np.cos(np.pi * i * x / shape[0]) * np.cos(np.pi * j * y / shape[1]) * np.cos(np.pi * k * z / shape[2])
        square = (np.pi * i / shape[0]) ** 2 + (np.pi * j / shape[1]) ** 2 + (np.pi * k / shape[2]) ** 2
        assert low_pass(wave, length) == pytest.approx(wave / (1 + length**4 * square**2), abs=1e-12)


def test_the_low_pass_at_its_extremes() -> None:
    values = np.random.default_rng(0).normal(size=(9, 8, 7))
    assert low_pass(values, 0.0) == pytest.approx(values, abs=1e-12)
    assert low_pass(values, 1e6) == pytest.approx(np.full(values.shape, values.mean()), abs=1e-12)
    assert low_pass(np.full((1, 1, 1), 3.0), 5.0) == pytest.approx(3.0)


def test_a_knob_behind_goes_and_what_the_camera_sees_stays() -> None:
    field = AnalyticField(behind(-0.088, 0.012), BOX)
    fair = faired(field, SHARE, from_the_front, quiet)
    vertices = building.build(fair, 64, quiet).mesh.vertices
    tip = -vertices[np.hypot(vertices[:, 0], vertices[:, 1]) < 0.02, 2].min()
    assert building.build(field, 64, quiet).mesh.vertices[:, 2].min() == pytest.approx(-0.1, abs=1e-3)
    assert tip == pytest.approx(0.08, abs=0.003)
    front = np.random.default_rng(1).normal(size=(2000, 3)) * [1, 1, 0] + [0, 0, 2]
    front *= (np.linspace(0.0795, 0.081, 2000) / np.linalg.norm(front, axis=1))[:, None]
    front = front.astype(np.float32)
    assert np.array_equal(fair.sdf(front), field.sdf(front))
    for now, before in zip(fair.sdf_and_gradient(front), field.sdf_and_gradient(front), strict=True):
        assert np.array_equal(now, before)


def test_a_ball_that_is_seen_from_one_side_stays_a_ball() -> None:
    for share, most in ((0.02, 0.0002), (SHARE, 0.0025)):
        vertices = mesh_of(sphere(0.08), from_the_front, share).mesh.vertices.astype(np.float64)
        assert np.abs(np.linalg.norm(vertices, axis=1) - 0.08).max() < most


def tunnel(across: bool) -> Distance:
    """A ball with a hole of 7 mm radius along z, or along x through its back."""

    def evaluate(p: F64) -> tuple[F64, F64]:
        value, gradient = sphere(0.08)(p)
        flat = p[:, 1:] + [0, 0.045] if across else p[:, :2]
        away = np.linalg.norm(flat, axis=1)
        hole = 0.007 - away
        g = np.zeros_like(p)
        g[:, slice(1, 3) if across else slice(0, 2)] = -flat / np.maximum(away, 1e-9)[:, None]
        return np.maximum(value, hole), np.where((hole > value)[:, None], g, gradient)

    return evaluate


def test_a_tunnel_behind_closes_and_one_that_the_camera_looks_through_stays() -> None:
    assert building.build(AnalyticField(tunnel(True), BOX), 64, quiet, handle=0).topology.euler == 0
    hidden = building.build(faired(AnalyticField(tunnel(True), BOX), SHARE, from_the_front, quiet), 64, quiet, handle=0)
    shown = building.build(faired(AnalyticField(tunnel(False), BOX), SHARE, from_the_front, quiet), 64, quiet, handle=0)
    assert hidden.topology.euler == 2 and shown.topology.euler == 0


def test_a_deep_hollow_that_a_camera_looks_into_stays_empty() -> None:
    """A hole whose walls count as seen by nobody: only the space in it is."""

    def into_the_hole(rough: Occluder, points: F64) -> tuple[Mask, Mask]:
        shown = points[:, 2] > 0.05
        return shown | (np.hypot(points[:, 0], points[:, 1]) < 0.003), shown

    fair = faired(AnalyticField(tunnel(False), BOX), SHARE, into_the_hole, quiet)
    line = np.stack([np.zeros(40), np.zeros(40), np.linspace(-0.07, 0.07, 40)], 1).astype(np.float32)
    assert (fair.sdf(line) > 0).all()


def value_at(field: Field, points: F64) -> F64:
    return field.sdf(points.astype(np.float32)).astype(np.float64)


def test_the_gradient_is_that_of_the_values() -> None:
    """Central differences over two cells of a trilinear function are those of its nodes, interpolated."""
    fair = faired(AnalyticField(behind(-0.088, 0.012), BOX), SHARE, from_the_front, quiet)
    assert isinstance(fair, Faired)
    rng, step = np.random.default_rng(2), fair._cell
    points = rng.normal(size=(4000, 3))
    points *= (0.08 / np.linalg.norm(points, axis=1))[:, None]
    points = points[points[:, 2] < -0.02]
    slope = np.stack([value_at(fair, points + e) - value_at(fair, points - e) for e in step * np.eye(3)], 1) / 2 / step
    error = np.linalg.norm(fair.sdf_and_gradient(points.astype(np.float32))[1] - slope, axis=1)
    assert np.median(error) < 0.01 and np.percentile(error, 99) < 0.08


def test_the_field_is_the_same_where_cameras_look_everywhere_or_nowhere() -> None:
    field = AnalyticField(sphere(0.08), BOX)
    assert faired(field, SHARE, nowhere, quiet) is field
    assert faired(field, SHARE, everywhere, quiet) is field


def test_all_but_the_distance_is_the_fields_own() -> None:
    field = AnalyticField(behind(-0.088, 0.012), BOX)
    fair = faired(field, SHARE, from_the_front, quiet)
    p = np.array([[0.01, 0.02, -0.09]], np.float32)
    assert fair is not field and fair.sdf(p) != field.sdf(p)
    assert fair.cell == field.cell and fair.rank == field.rank and fair.bounds is not None
    assert np.array_equal(fair.light, field.light) and fair.moving_light is field.moving_light
    assert np.array_equal(fair.material(p).albedo, field.material(p).albedo)
    assert np.array_equal(fair.irradiance_ratio(p), field.irradiance_ratio(p))
    assert np.array_equal(fair.basis(p, p), field.basis(p, p))
    assert (fair.colour_responses is None) == (field.colour_responses is None)


def test_the_file_has_the_same_distances_at_the_surface(tmp_path: Path) -> None:
    field = AnalyticField(behind(-0.088, 0.012), BOX)
    fair = faired(field, SHARE, from_the_front, quiet)
    assert isinstance(fair, Faired) and fair_again(field, None) is field
    fair.save(tmp_path / "fairing.npz")
    again = fair_again(field, tmp_path / "fairing.npz")
    points = building.build(fair, 48, quiet).mesh.vertices
    for a, b in zip(fair.sdf_and_gradient(points), again.sdf_and_gradient(points), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert np.array_equal(fair.sdf(points), again.sdf(points))


def test_a_field_without_surface_or_with_nan_is_an_error() -> None:
    def broken(p: F64) -> tuple[F64, F64]:
        return np.full(len(p), np.nan), np.zeros_like(p)

    for distance in (broken, sphere(5.0, (0.0, 0.0, 9.0))):
        with pytest.raises(StageError):
            faired(AnalyticField(distance, BOX), SHARE, from_the_front, quiet)


def test_the_cut_of_a_neck_stays_flat() -> None:
    extent = Extent(centre=(0.0, 0.0, 0.0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), radii=(0.2, 0.2, 0.2),
                    cuts=(Cut(normal=(0.0, -1.0, 0.0), offset=0.05),), head=0.16)  # fmt: skip
    field = AnalyticField(sphere(0.08), BOX)
    fair = faired(field, SHARE, from_the_front, quiet, extent)
    plain, new = (building.build(f, 64, quiet, extent=extent) for f in (field, fair))
    assert new.cap == pytest.approx(plain.cap, rel=0.03)
    assert new.mesh.vertices[:, 1].min() == pytest.approx(plain.mesh.vertices[:, 1].min(), abs=1e-5)


def test_looks_into_asks_frame_and_mesh() -> None:
    ball = building.build(AnalyticField(sphere(0.08), BOX), 32, quiet).mesh
    before, within, after, beside = [0, 0, 0.1], [0, 0, 0.05], [0, 0, -0.1], [0.5, 0, 0.1]
    points = np.array([before, within, after, beside], np.float64)
    front, back = (FittedPhoto(camera(0, a), None) for a in (0.0, np.pi))
    for view, expected in ((front, [True, False, False, False]), (back, [False, False, True, False])):
        into, shown = looks_into(view, points, Occluder(ball))
        assert into.tolist() == shown.tolist() == expected
    assert looks_into(front, np.zeros((0, 3)), Occluder(ball))[0].shape == (0,)


def test_shown_asks_the_mask_and_the_pixels_that_count(tmp_path: Path) -> None:
    """The mask is the photo's left half, what counts its upper half."""
    ball = building.build(AnalyticField(sphere(0.08), BOX), 32, quiet).mesh
    half = np.zeros((64, 64))
    half[:, :32] = 1
    write_png(tmp_path / "mask.png", half)
    write_png(tmp_path / "asked.png", half.T)
    points = 0.01 * np.array([[-1, 1, 10], [1, 1, 10], [-1, -1, 10], [1, -1, 10]])
    there = FittedPhoto(camera(0, 0.0), None)
    cut = replace(there, mask=tmp_path / "mask.png")
    both = replace(cut, asked=tmp_path / "asked.png")
    for view, expected in ((there, [1, 1, 1, 1]), (cut, [1, 0, 1, 0]), (both, [1, 0, 0, 0])):
        into, shown = looks_into(view, points, Occluder(ball))
        assert into.all() and shown.tolist() == [bool(x) for x in expected]


def test_a_speck_of_unseen_surface_that_is_shown_holds_nothing() -> None:
    """A knob behind, of which a photo shows one place, goes; the front, where one place is hidden, stays."""

    def looked(rough: Occluder, points: F64) -> tuple[Mask, Mask]:
        into, shown = from_the_front(rough, points)
        speck = np.linalg.norm(points - [0, 0, -0.102], axis=1) < 0.004
        hidden = np.linalg.norm(points - [0, 0, 0.082], axis=1) < 0.004
        return into | speck, (shown | speck) & ~hidden

    distance = behind(-0.088, 0.012)
    vertices = mesh_of(distance, looked).mesh.vertices
    assert vertices[:, 2].min() > -0.085 and vertices[:, 2].max() == pytest.approx(0.08, abs=2e-4)


def test_a_knob_that_a_camera_sees_before_a_wall_goes_too() -> None:
    """At the side of the head, seen by the camera, but not shown by its photo."""

    def looked(rough: Occluder, points: F64) -> tuple[Mask, Mask]:
        into, _ = from_the_front(rough, points)
        return into, into & (points[:, 0] < 0.07)

    distance = union(sphere(0.08), sphere(0.012, (0.088, 0.0, 0.0)))
    assert building.build(AnalyticField(distance, BOX), 64, quiet).mesh.vertices[:, 0].max() > 0.098
    assert mesh_of(distance, looked).mesh.vertices[:, 0].max() < 0.086


def test_the_stage_fairs_unless_the_setting_is_zero(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    face = fitted(tmp_path, AnalyticField(behind(-0.088, 0.012), BOX), monkeypatch, views=1)
    photos = Located(Capture(kind="facescape", views=()), tmp_path)
    inputs = Inputs(face, poses(tmp_path, 1), Located(MaskSet(masks=()), tmp_path), photos)
    depth = {}
    for share in (0.0, SHARE):
        context = Context(tmp_path, tmp_path)
        surface = run(inputs, Config(resolution=40, fair=share), context)
        depth[share] = float(meshes.load(tmp_path / surface.mesh.path).vertices[:, 2].min())
    assert surface.fairing is not None
    assert depth[0.0] == pytest.approx(-0.1, abs=2e-3) and depth[SHARE] > -0.085


def test_a_head_that_cameras_see_from_all_sides_hardly_changes() -> None:
    def around(rough: Occluder, points: F64) -> tuple[Mask, Mask]:
        angles = np.linspace(0, 2 * np.pi, 9)[:-1]
        views = [FittedPhoto(camera(i, a, 1.0, focal=100.0), None) for i, a in enumerate(angles)]
        into, shown = np.any([looks_into(v, points, rough) for v in views], 0)
        return into, shown

    field = AnalyticField(bumpy_head())
    vertices = building.build(field, 64, quiet).mesh.vertices
    level = vertices[np.abs(vertices[:, 1]) < 0.03]
    assert np.abs(faired(field, 0.022, around, quiet).sdf(level)).max() < 1e-4
