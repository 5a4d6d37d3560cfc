"""The field: fill, files, light of its texels, pictures, and the whole stage on a made-up ball."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline import meshes
from pipeline.artifacts import CameraSet, Located, MaskSet, UvMesh
from pipeline.camera import PinholeCamera
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.images import read_encoded, read_linear, write_exr
from pipeline.transforms import rows
from stages.capture import stage as capture_stage
from stages.capture.scan import scan_capture
from stages.reflectance import relight, stage
from stages.reflectance.evidence import fewer_lamps
from stages.reflectance.field import Field, Lamp, centre_of, distant_lamp, load, save
from stages.reflectance.fill import harmonic
from stages.reflectance.relight import lamps_of, lit_by, look_up, picture, under_lamps
from stages.reflectance.score import decibels
from stages.reflectance.texels import arriving, points_of
from tests.reflectance.test_rig_and_motion import cameras_of
from tests.support.ball_mesh import ball_mesh
from tests.support.light_stage import DISTANCE, RADIUS, SIZE, K, albedo_at, make_stage, photograph, write_stage
from tests.support.textured_ball import camera_on_orbit

SIDE = 128


def field_of(albedo: np.ndarray, lobes: float = 0.0, order: int = 1) -> Field:
    """A ball of one material whose shadows are as traced."""
    mesh, charts = ball_mesh()
    points = points_of(mesh, charts, SIDE)
    count, towards = len(points.texel), np.eye(3)
    arrays = {
        "albedo": np.broadcast_to(albedo, (count, 3)).astype(np.float32),
        "lobes": np.full((count, 3), lobes, np.float32),
        "normal": points.normal.astype(np.float32),
        "rest": np.zeros((count, 3 * (order + 1) ** 2), np.float32),
        "shadow": np.zeros((count, 3), np.float32),
        "trust": np.zeros((count, 3), np.float32),
        "coverage": np.ones((count, 1), np.float32),
    }
    return Field(mesh, charts, points, arrays, (0.3, 0.15, 0.05), towards, np.zeros(3))


def camera(azimuth: float = 0.0) -> PinholeCamera:
    return PinholeCamera(K, camera_on_orbit(azimuth, 10, 1.0, np.zeros(3)), SIZE, SIZE)


def test_unseen_values_are_harmonic() -> None:
    """Oracle: on a plane, a linear function is harmonic: it is continued from its border."""
    y, x = np.mgrid[0:20, 0:20].astype(float)
    position = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    position += np.random.default_rng(0).normal(size=position.shape) * 1e-4
    values = np.stack([x.ravel() + 2 * y.ravel(), np.full(400, 7.0)], 1).astype(np.float32)
    known = np.ones(400, bool)
    hole = (np.abs(x.ravel() - 9) < 4) & (np.abs(y.ravel() - 10) < 4)
    known[hole] = False
    broken = np.where(known[:, None], values, 99)
    found = harmonic(broken.astype(np.float32), known, position)
    np.testing.assert_allclose(found[hole], values[hole], atol=0.5)
    np.testing.assert_allclose(found[:, 1], 7, atol=1e-3)
    assert found[hole, 0].min() >= values[:, 0].min() and found[hole, 0].max() <= values[:, 0].max()
    np.testing.assert_array_equal(harmonic(values, np.zeros(400, bool), position), values)
    np.testing.assert_array_equal(harmonic(values, np.ones(400, bool), position), values)


def test_near_texels_count_more_than_far_ones() -> None:
    """Against the same system written as a full matrix, on texels that lie unevenly: w = 1 / distance."""
    rng = np.random.default_rng(11)
    position = rng.uniform(size=(60, 3)) ** 3
    values, known = rng.normal(size=(60, 2)).astype(np.float32), rng.random(60) > 0.4
    away = np.linalg.norm(position[:, None] - position[None], axis=2)
    near = np.argsort(away, axis=1)[:, 1:9]
    w = np.zeros((60, 60))
    for i in range(60):
        w[i, near[i]] = 1 / away[i, near[i]]
    w += w.T
    u, k = np.flatnonzero(~known), np.flatnonzero(known)
    wanted = np.linalg.solve(np.diag(w[u].sum(1)) - w[np.ix_(u, u)], w[np.ix_(u, k)] @ values[k])
    np.testing.assert_allclose(harmonic(values, known, position)[u], wanted, atol=1e-4)


def test_a_matt_ball_is_lamberts() -> None:
    """Oracle: a / pi n.l I / d^2, by hand, at pixels near the middle."""
    field = field_of(np.array([0.5, 0.4, 0.3]))
    lamp = Lamp(np.array([0.3, 0.4, 1.2]), -np.array([0.3, 0.4, 1.2]) / 1.3, np.array([4.0, 4, 2]))
    view = camera()
    made = picture(view, look_up(field, view), lit_by(field, view, lamp, field.arrives(lamp)))
    origin, rays = view.rays(np.array([[SIZE / 2, SIZE / 2]]))
    b = rays[0] @ origin
    point = origin + (-b - np.sqrt(b * b - (origin @ origin - RADIUS**2))) * rays[0]
    away = lamp.position - point
    expected = np.array([0.5, 0.4, 0.3]) / np.pi * (away @ point) / np.linalg.norm(away) / RADIUS
    expected = expected * lamp.strength * (away @ -lamp.axis) / np.linalg.norm(away) / (away @ away)
    np.testing.assert_allclose(made[SIZE // 2, SIZE // 2, :3], expected, rtol=0.02)
    assert made[2, 2].sum() == 0 and made[SIZE // 2, SIZE // 2, 3] == pytest.approx(1)


def test_a_picture_in_bands_is_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the last bit; the last band is lower than the others."""
    field, view = field_of(np.array([0.5, 0.4, 0.3])), camera(20)
    whole = look_up(field, view)
    monkeypatch.setattr(relight, "BAND", 4 * SIZE * 7)
    parts = look_up(field, view)
    assert SIZE % 7 and whole.shape == parts.shape and whole.nnz == parts.nnz > 1000
    for one, other in ((whole.data, parts.data), (whole.indices, parts.indices), (whole.indptr, parts.indptr)):
        np.testing.assert_array_equal(one, other)


def test_lamps_add_up_and_far_lamps_are_distant_ones() -> None:
    field, view = field_of(np.full(3, 0.5), 0.02), camera()
    near = [
        Lamp(np.array(p), -np.array(p) / np.linalg.norm(p), np.full(3, 4.0)) for p in ([0, 0, 1.3], [1.0, 0.5, 0.5])
    ]
    both = under_lamps(field, [view], near, lambda d, n: None)[0].radiance
    each = [under_lamps(field, [view], [lamp], lambda d, n: None)[0].radiance for lamp in near]
    np.testing.assert_allclose(both, each[0] + each[1], rtol=1e-5, atol=1e-7)
    direction = np.array([0.6, 0.0, 0.8])
    far = Lamp(500 * direction, -direction, np.full(3, 500.0**2))
    at_infinity = distant_lamp(direction, np.ones(3))
    a, b = (field.radiance(lamp, view.eye, field.arrives(lamp)) for lamp in (far, at_infinity))
    np.testing.assert_allclose(a, b, atol=2e-3)


def test_a_white_environment_lights_a_matt_ball_with_its_albedo() -> None:
    """Oracle: radiance 1 from everywhere gives a Lambertian convex body the radiance a."""
    field, view = field_of(np.array([0.6, 0.3, 0.1])), camera()
    lamps = lamps_of(np.ones((32, 64, 3), np.float32), "white", quick=True)
    made = under_lamps(field, [view], lamps, lambda d, n: None)[0].radiance
    np.testing.assert_allclose(np.median(made, 0), [0.6, 0.3, 0.1], rtol=0.05)


def test_shadows_of_the_stages_lights_carry_over_to_lamps_near_them() -> None:
    field = field_of(np.full(3, 0.5))
    field.arrays["shadow"][:, 2] = -1  # dark under the light along z
    field.arrays["trust"][:, 2] = 1
    lit = field.points.normal[:, 2] > 0.5
    at, beside, far = (distant_lamp(np.array([np.sin(a), 0, np.cos(a)]), np.ones(3)) for a in np.radians([0, 8, 90]))
    assert field.arrives(at)[lit].max() < 0.01 and field.arrives(beside)[lit].max() < 0.01
    side = field.points.normal[:, 0] > 0.5
    np.testing.assert_allclose(field.arrives(far)[side], 1, atol=1e-6)


def test_a_ball_shadows_its_far_side() -> None:
    field = field_of(np.full(3, 0.5))
    share = arriving(field.points, field.blocker, np.array([0, 0, 1.3]), np.array([0, 0, -1.0]))
    facing = field.points.position[:, 2] / RADIUS
    assert share[facing > 0.2].min() == 1 and share[facing < -0.15].max() == 0


def test_files_give_the_same_field(tmp_path: Path) -> None:
    field, view = field_of(np.array([0.5, 0.4, 0.3]), 0.02), camera()
    names = save(field, tmp_path, {"lights": [1, 2, 3]})
    assert sorted(names) == sorted(p.name for p in tmp_path.iterdir())
    again = load(tmp_path)
    lamp = Lamp(np.array([0.3, 0.4, 1.2]), -np.array([0.3, 0.4, 1.2]) / 1.3, np.full(3, 4.0))
    a, b = (f.radiance(lamp, view.eye, f.arrives(lamp)) for f in (field, again))
    np.testing.assert_allclose(a, b, rtol=5e-3, atol=2e-3)  # half floats, also of normals at the terminator
    (tmp_path / "lobes.exr").unlink()
    with pytest.raises(StageError, match="can't be read"):
        load(tmp_path)


def test_the_stages_centre_is_where_its_lamps_shine() -> None:
    made = make_stage(2, 20)
    centre = np.array([0.1, -0.2, 0.3])
    np.testing.assert_allclose(centre_of(made.positions + centre, -made.positions / DISTANCE), centre, atol=1e-9)
    parallel = np.broadcast_to([0.0, 0, 1], (20, 3))
    np.testing.assert_allclose(centre_of(made.positions, parallel), made.positions.mean(0))


def test_decibels() -> None:
    assert decibels([0.01]) == 20 and decibels([0.0, 0.02]) == 20 and decibels([0]) == 99 and np.isnan(decibels([]))


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> stage.Inputs:
    """A light stage's capture of a ball, its cameras, and the ball's mesh with charts."""
    folder = tmp_path_factory.mktemp("ball")
    made = make_stage(4, 42)
    write_stage(folder / "in", made, gloss=0.03, tracking=(0, 40))
    work = folder / "capture"
    work.mkdir()
    read = capture_stage.run(
        capture_stage.Inputs(scan_capture(folder / "in")), capture_stage.Config(), Context(work, work)
    )
    cameras = CameraSet(source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.15,
                        cameras=cameras_of(made.poses))  # fmt: skip
    mesh, charts = ball_mesh()
    meshes.save(folder / "mesh.npz", mesh, charts)
    place = Context(folder, folder)
    uv = UvMesh(mesh=place.file("mesh.npz"), vertices=len(mesh.vertices), faces=len(mesh.faces), charts=1,
                utilisation=1, stretch=1, overlap=0, deviation_mm=0)  # fmt: skip
    masks = MaskSet(masks=())
    return stage.Inputs(Located(read, work), Located(cameras, folder), Located(masks, folder), Located(uv, folder))


def test_the_stage_on_a_ball(ball: stage.Inputs, tmp_path: Path) -> None:
    """Oracle: the ball's albedo, and pictures under lights that the fit did not use."""
    found = stage.run(ball, stage.Config(size=SIDE), Context(tmp_path, tmp_path / "scratch"))
    assert found.present and found.lights == 36 and len(found.left_out) == 6
    assert found.figures["left_out_psnr"] > found.figures["blend_psnr"] + 3 and found.figures["left_out_psnr"] > 30
    assert found.figures["motion_mm"] < 0.05
    field = load(tmp_path / "reflectance")
    seen = field.known & (field.points.normal[:, 2] > 0.3)
    expected = albedo_at(field.points.position)[seen]
    assert np.median(np.abs(field.albedo[seen] / expected - 1)) < 0.06
    basis = json.loads((tmp_path / "reflectance" / "basis.json").read_text())
    assert len(basis["towards"]) == 36 and set(basis["left_out"]) == set(found.left_out)
    assert not list((tmp_path / "scratch").glob("samples*"))
    scores = {(p.camera, p.light): p for p in found.predicted}
    assert len(scores) == 24 and {n for _, n in scores} == set(found.left_out)
    assert np.mean([p.psnr for p in found.predicted]) > np.mean([p.blend_psnr for p in found.predicted]) + 3
    assert found.figures["quick_psnr"] > 25 and found.figures["full_lamps"] == 6 * found.figures["quick_lamps"]
    best, median, worst = (scores[tuple(map(int, Path(f.path).stem.split("_")[1:]))].psnr for f in found.shown)
    assert best > median > worst
    truth, own = np.split(read_encoded(tmp_path / found.shown[0].path).astype(float) / 255, 2, axis=1)
    assert truth.max() > 0.5  # not of a light behind the ball
    assert abs(-10 * np.log10(np.mean((truth - own)[truth.max(2) > 0.02] ** 2)) - best) < 2  # of the covered pixels
    made = make_stage(4, 42)
    view = PinholeCamera(K, made.poses[1], SIZE, SIZE)
    n = found.left_out[1]
    lamp = Lamp(made.positions[n], -made.positions[n] / DISTANCE, made.intensities[n])
    shown = picture(view, look_up(field, view), lit_by(field, view, lamp, field.arrives(lamp)))
    truth = photograph(made, 1, n, 0.03)
    inside = shown[..., 3] > 0.99
    assert np.sqrt(np.mean((shown[..., :3] - truth)[inside] ** 2)) < 0.025  # .0202; the highlight is no GGX lobe


def test_a_held_out_camera_is_no_part_of_the_field(ball: stage.Inputs, tmp_path: Path) -> None:
    """The field is the same with its pictures all black, and what it predicts for that camera is told."""
    views = [v.model_copy(update={"holdout": v.index == 1}) for v in ball.capture.artifact.views]
    held = ball.capture.artifact.model_copy(update={"views": tuple(views)})
    copy = tmp_path / "capture"
    shutil.copytree(ball.capture.folder, copy)
    found, texels = [], []
    for name in ("as it is", "black"):
        inputs = stage.Inputs(Located(held, copy), ball.poses, ball.masks, ball.uv)
        work = tmp_path / name
        work.mkdir()
        found.append(stage.run(inputs, stage.Config(size=64), Context(work, work / "scratch")))
        texels.append(load(work / "reflectance").arrays)
        for frame in held.stage.frames:
            if frame.camera == 1:
                write_exr(copy / frame.image.path, np.zeros((SIZE, SIZE, 3), np.float32))
    assert found[0].cameras == (1,) and found[0].figures["left_out_camera_psnr"] > 24
    assert found[1].figures["left_out_camera_psnr"] < found[0].figures["left_out_camera_psnr"]
    for name, values in texels[0].items():
        np.testing.assert_array_equal(values, texels[1][name])


def test_a_part_of_a_field_is_lit_as_the_whole() -> None:
    field, view = field_of(np.array([0.5, 0.4, 0.3]), 0.02), camera()
    lamp = Lamp(np.array([0.3, 0.4, 1.2]), -np.array([0.3, 0.4, 1.2]) / 1.3, np.full(3, 4.0))
    whole = field.radiance(lamp, view.eye, field.arrives(lamp))
    texels = np.arange(5, len(whole), 7)
    part = field.part(texels)
    np.testing.assert_array_equal(part.radiance(lamp, view.eye, part.arrives(lamp)), whole[texels])
    assert fewer_lamps(field, view.eye, np.zeros(len(whole), bool), lambda d, n: None) == {}


def test_two_runs_are_equal(ball: stage.Inputs, tmp_path: Path) -> None:
    results = []
    for name in ("a", "b"):
        work = tmp_path / name
        work.mkdir()
        results.append(stage.run(ball, stage.Config(size=64), Context(work, work / "scratch")))
    assert results[0].canonical_json() == results[1].canonical_json()


def test_other_captures_pass_through(ball: stage.Inputs, tmp_path: Path) -> None:
    plain = Located(ball.capture.artifact.model_copy(update={"stage": None}), ball.capture.folder)
    found = stage.run(stage.Inputs(plain, ball.poses, ball.masks, ball.uv), stage.Config(), Context(tmp_path, tmp_path))
    assert not found.present and not found.files and not list(tmp_path.iterdir())


def test_too_few_lights_are_named(ball: stage.Inputs, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="too few lights are left"):
        stage.run(ball, stage.Config(size=64, every=1), Context(tmp_path, tmp_path / "s"))


def test_a_picture_that_vanishes_is_told(ball: stage.Inputs, tmp_path: Path) -> None:
    copy = tmp_path / "capture"
    shutil.copytree(ball.capture.folder, copy)
    frame = ball.capture.artifact.stage.frames[0]
    (copy / frame.image.path).unlink()
    gone = Located(ball.capture.artifact, copy)
    with pytest.raises((StageError, OSError)):
        inputs = stage.Inputs(gone, ball.poses, ball.masks, ball.uv)
        stage.run(inputs, stage.Config(size=64), Context(tmp_path, tmp_path / "s"))
    assert read_linear(ball.capture.path(frame.image)).shape == (SIZE, SIZE, 3)
