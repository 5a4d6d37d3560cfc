"""The surface that the lights show: maps of a made-up ball, found ways, and the moved mesh, against the ball itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.camera import PinholeCamera
from pipeline.images import write_exr
from pipeline.meshes import Mesh, unique_edges, unit, vertex_normals
from pipeline.transforms import pixel_centres
from stages.reflectance.agree import ALBEDOS, MOST, NORMALS, SHARPEST, _cost, _lowest, ways
from stages.reflectance.answers import AnswerMap, answer_maps
from stages.reflectance.reshape import _System, folded, moved, neighbour_mean, outline, relaxed
from stages.reflectance.rig import Rig, rig_of
from stages.reflectance.thin import Held
from tests.reflectance.test_rig_and_motion import cameras_of, lights_of
from tests.reflectance.test_split import silent
from tests.support.light_stage import RADIUS, SIZE, K, albedo_at, make_stage, photograph

WIDTH = 144
WIDE = np.diag([0.75, 0.75, 1]) @ K + np.array(
    [[0, 0, 0.25 * SIZE / 2], [0, 0, 0.25 * SIZE / 2], [0, 0, 0]]
)  # shows all of the ball
VIEWS = [PinholeCamera(WIDE, pose, SIZE, SIZE).scaled(WIDTH) for pose in make_stage(4, 8).poses]
TRIED = np.linspace(-0.01, 0.01, 21)


def globe(levels: int = 5) -> Mesh:
    """An octahedron whose triangles are split into four again and again, blown up to the ball; without seams."""
    vertices = [np.array(v, float) for v in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    for _ in range(levels):
        half: dict[tuple[int, int], int] = {}

        def middle(a: int, b: int, half: dict[tuple[int, int], int] = half) -> int:
            key = (min(a, b), max(a, b))
            if key not in half:
                half[key] = len(vertices)
                m = vertices[a] + vertices[b]
                vertices.append(m / np.linalg.norm(m))
            return half[key]

        faces = [
            t for a, b, c in faces for ab, bc, ca in [(middle(a, b), middle(b, c), middle(c, a))]
            for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        ]  # fmt: skip
    return meshed(RADIUS * np.array(vertices), np.array(faces, np.int32))


def meshed(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    return Mesh(vertices.astype(np.float32), vertex_normals(vertices, faces), faces)


def hit(view: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """(H W,) which pixels show the ball, and (n, 3) where; written out."""
    eye, directions = view.rays(pixel_centres(view.width, view.height))
    b = directions @ eye
    under = b * b - (eye @ eye - RADIUS**2)
    shown = under > 0
    return shown, eye + (-b - np.sqrt(np.where(shown, under, 0)))[:, None][shown] * directions[shown]


def ball_map(view: PinholeCamera, *, plain: bool = False) -> AnswerMap:
    shown, at = hit(view)
    values = np.zeros((len(shown), 7))
    albedo = np.full((len(at), 3), 0.4) if plain else albedo_at(at)
    values[shown] = np.concatenate([at / RADIUS, np.log(albedo), np.ones((len(at), 1))], 1)
    return AnswerMap(view, values.reshape(view.height, view.width, 7))


MAPS = [ball_map(v) for v in VIEWS]


def free(mesh: Mesh, cameras: int = len(VIEWS)) -> Held:
    """Nothing is held: no picture shows the subject."""
    return Held(mesh, neighbour_mean(unique_edges(mesh.faces), len(mesh.vertices)), [np.zeros((8, 8), bool)] * cameras)


def faces_two(vertices: np.ndarray) -> np.ndarray:
    """(V,) well seen by two of the cameras."""
    cosines = np.stack([(unit(v.eye - vertices) * unit(vertices)).sum(1) for v in VIEWS])
    return np.asarray(np.sort(cosines, axis=0)[-2] > 0.45)


def off(mesh: Mesh) -> np.ndarray:
    return np.asarray(np.abs(np.linalg.norm(mesh.vertices.astype(float), axis=1) - RADIUS))


def test_a_map_is_bilinear_between_known_pixels() -> None:
    """Oracle: the ball's normal at the ray's end; beside the ball, behind the camera and out of the frame: unknown."""
    one, at = MAPS[1], hit(VIEWS[1])[1][40:-40:7]
    facing = (unit(VIEWS[1].eye - at) * at / RADIUS).sum(1) > 0.5
    normal, albedo, known = one.at(at)
    np.testing.assert_allclose(normal[facing], at[facing] / RADIUS, atol=2e-3)
    np.testing.assert_allclose(albedo[facing], np.log(albedo_at(at))[facing], atol=1e-6)
    assert known[facing].all()
    behind = VIEWS[1].eye * 2
    nowhere = np.array([behind, [0.3, 0.3, 0], [5.0, 5, 0], VIEWS[1].eye])
    normal, _, known = one.at(nowhere)
    assert not known.any() and np.isfinite(normal).all()
    assert one.at(np.zeros((0, 3)))[0].shape == (0, 3)


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("way", [-0.006, 0.0, 0.004])
def test_cameras_agree_on_the_ball(way: float, plain: bool) -> None:
    """A surface that lies `way` too far out has to go back by it, with stripes on it or without."""
    mesh = globe()
    vertices = mesh.vertices.astype(float) * (1 + way / RADIUS)
    seen = np.stack([(unit(v.eye - vertices) * unit(vertices)).sum(1) > 0.3 for v in VIEWS])
    mean = neighbour_mean(unique_edges(mesh.faces), len(vertices))
    maps = [ball_map(v, plain=plain) for v in VIEWS]
    found, trust = ways(vertices, unit(vertices), seen, maps, mean, TRIED)
    told = faces_two(vertices) & (trust > 1 / 0.003**2)
    assert told.sum() > 0.7 * faces_two(vertices).sum()
    assert np.median(np.abs(found[told] + way)) < 3e-4
    assert trust.max() <= 1 / SHARPEST**2
    assert not trust[seen.sum(0) < 2].any()


def test_one_camera_agrees_with_anything() -> None:
    mesh = globe(3)
    vertices = mesh.vertices.astype(float)
    mean = neighbour_mean(unique_edges(mesh.faces), len(vertices))
    _, trust = ways(vertices, unit(vertices), np.ones((1, len(vertices)), bool), MAPS[:1], mean, TRIED)
    assert not trust.any()


def test_the_cost_is_that_of_the_page() -> None:
    """Two cameras that see the same point, with normals and albedos that differ by known amounts."""
    turned = 0.03
    values = [np.tile([0, 0, 1.0, 0, 0, 0, 1], (8, 8, 1)), np.tile([0, 0, 0, 0.1, 0.1, 0.1, 1.0], (8, 8, 1))]
    values[1][..., :3] = [np.sin(turned), 0, np.cos(turned)]
    pose = np.diag([1.0, -1, -1, 1])
    pose[2, 3] = 1
    view = PinholeCamera(np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), pose, 8, 8)
    maps, both = [AnswerMap(view, v) for v in values], np.ones((2, 1), bool)
    expected = (2 * np.sin(turned / 2)) ** 2 / NORMALS**2 + 3 * 0.1**2 / ALBEDOS**2
    np.testing.assert_allclose(_cost(np.zeros((1, 3)), both, maps), expected, rtol=1e-6)
    values[1][..., 3:6] = 50
    np.testing.assert_allclose(_cost(np.zeros((1, 3)), both, maps), MOST)
    assert np.isnan(_cost(np.zeros((1, 3)), np.array([[True], [False]]), maps)).all()


def test_minima_are_the_parabolas() -> None:
    tried = np.linspace(-0.01, 0.01, 11)
    places = np.array([-0.0033, 0.0, 0.0071, 0.02, -0.02])
    cost = 0.5 * 4e4 * (tried - places[:, None]) ** 2
    way, trust = _lowest(cost, np.ones(5, bool), tried)
    np.testing.assert_allclose(way[:3], places[:3], atol=1e-9)
    np.testing.assert_allclose(trust[:3], 4e4 * (1 - cost.min(1)[:3] / 6), rtol=1e-6)
    assert not trust[3:].any()  # the least cost is at an end
    assert (
        not _lowest(cost, np.zeros(5, bool), tried)[1].any() and not _lowest(cost + 6, np.ones(5, bool), tried)[1].any()
    )
    assert np.isfinite(_lowest(np.zeros((2, 11)), np.ones(2, bool), tried)[0]).all()


@pytest.fixture(scope="module")
def dented() -> Mesh:
    """The ball with a bulge of 5 mm towards the second camera and noise."""
    mesh = globe()
    out = mesh.vertices.astype(float)
    towards = unit(VIEWS[1].eye[None])[0]
    bulge = 5e-3 * np.exp(-(1 - unit(out) @ towards) / 0.04)
    noise = 3e-4 * np.random.default_rng(1).normal(size=len(out))
    return meshed(out * (1 + (bulge + noise) / RADIUS)[:, None], mesh.faces)


def test_a_bulge_is_taken_back(dented: Mesh) -> None:
    """To the ball, where two cameras see it and where only one does; the normals as well."""
    found = moved(dented, dented, MAPS, VIEWS, TRIED, 5, free(dented))
    two = faces_two(dented.vertices.astype(float))
    assert np.quantile(off(dented)[two], 0.9) > 1.3e-3 and np.quantile(off(found)[two], 0.9) < 4e-4
    before, after = (
        np.degrees(np.arccos(np.median((m.normals * unit(m.vertices)).sum(1)[two]))) for m in (dented, found)
    )
    assert before > 2 and after < 0.5
    alone = moved(
        dented, dented, MAPS[1:2], VIEWS[1:2], TRIED, 8, free(dented, 1)
    )  # its depth is not known, its shape is
    facing = (unit(VIEWS[1].eye - dented.vertices) * unit(dented.vertices)).sum(1) > 0.5
    spread = [float(np.std(np.linalg.norm(m.vertices.astype(float), axis=1)[facing])) for m in (dented, alone)]
    assert spread[1] < 0.3 * spread[0]


def test_what_is_right_stays() -> None:
    mesh = globe()
    found = moved(mesh, mesh, MAPS, VIEWS, TRIED, 5, free(mesh))
    seen = np.max([(unit(v.eye - mesh.vertices) * unit(mesh.vertices)).sum(1) for v in VIEWS], axis=0) > 0.2
    assert off(found)[seen].max() < 6e-4 and np.median(off(found)[seen]) < 1e-4
    assert off(found).max() < 4e-3  # at the back, which is smoothed as the octahedron's corners are
    assert found.faces is mesh.faces


def test_maps_that_know_nothing_move_nothing() -> None:
    mesh = globe(2)
    empty = [replace(m, values=np.zeros_like(m.values)) for m in MAPS]
    assert moved(mesh, mesh, empty, VIEWS, TRIED, 3, free(mesh)) is mesh
    assert moved(mesh, mesh, [], [], TRIED, 3, free(mesh, 0)) is mesh


def test_outlines_are_the_balls_circle() -> None:
    """A ball in perspective, seen towards its centre, is a circle of radius f R / sqrt(D^2 - R^2)."""
    found, view = outline(globe(), VIEWS[1]), VIEWS[1]
    radius = view.K[0, 0] * RADIUS / np.sqrt(view.eye @ view.eye - RADIUS**2)
    centre = view.K[:2, 2]
    far = np.linalg.norm(pixel_centres(view.width, view.height) - centre, axis=1).reshape(found.shape)
    assert np.abs(found - (far - radius)).max() < 1.2
    mesh = globe(2)
    away = Mesh(mesh.vertices + np.float32(99), mesh.normals, mesh.faces)
    assert np.isposinf(outline(away, view)).all()
    near = PinholeCamera(view.K * np.array([[50], [50], [1]]), view.world_from_cam, 8, 8)
    near.K[:2, 2] = 4
    assert np.isneginf(outline(mesh, near)).all()


def test_folds_are_found_and_relaxed() -> None:
    """A vertex that is drawn over its neighbours folds the triangles there; the ball and a sharp cube have no folds."""
    mesh = globe(3)
    mean = neighbour_mean(unique_edges(mesh.faces), len(mesh.vertices))
    vertices = mesh.vertices.astype(float)
    assert not folded(vertices, unit(vertices), mesh.faces, mean).any()
    same, whole = relaxed(vertices, mesh.faces, mean)
    assert same is vertices and whole.all()
    near = np.flatnonzero(np.linalg.norm(vertices - vertices[7], axis=1) < 0.02)
    drawn = vertices.copy()
    drawn[7] += 3 * (vertices[near[near != 7][0]] - vertices[7])
    normals = vertex_normals(drawn, mesh.faces).astype(float)
    found = folded(drawn, normals, mesh.faces, mean)
    assert found[7] and found.mean() < 0.2
    flat, whole = relaxed(drawn, mesh.faces, mean)
    assert not folded(flat, vertex_normals(flat, mesh.faces).astype(float), mesh.faces, mean).any()
    assert not whole[7] and (flat[whole] == drawn[whole]).all()
    assert np.isfinite(
        relaxed(np.zeros((4, 3)), np.array([[0, 1, 2], [0, 2, 3]]), neighbour_mean(np.array([[0, 1]]), 4))[0]
    ).all()


def test_rows_are_least_squares() -> None:
    rng = np.random.default_rng(3)
    a, b, w = rng.normal(size=(9, 4)), rng.normal(size=9), rng.uniform(0.1, 2, 9)
    from scipy.sparse import csr_array

    system = _System(4)
    system.add_sparse(csr_array(a), b, w)
    system.add(
        [np.array([0, 2]), np.array([1, 1])], [np.array([2.0, 1]), np.array([-1.0, 3])], np.ones(2), np.full(2, 4.0)
    )
    whole = np.concatenate([a, [[2, -1, 0, 0], [0, 3, 1, 0]]])
    root = np.sqrt(np.concatenate([w, [4, 4]]))
    expected = np.linalg.lstsq(whole * root[:, None], np.concatenate([b, [1, 1]]) * root, rcond=None)[0]
    np.testing.assert_allclose(system.solved(), expected, rtol=1e-8)


def test_means_are_over_a_vertex_and_its_neighbours() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    pairs = unique_edges(faces)
    assert sorted(map(tuple, pairs)) == [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)]
    found = neighbour_mean(pairs, 5) @ np.array([4.0, 8, 0, 12, 7])
    np.testing.assert_allclose(found, [24 / 4, 12 / 3, 24 / 4, 16 / 3, 7])


def pictured(folder: Path, lights: int = 40) -> tuple[Rig, dict[tuple[int, int], Path]]:
    """The ball's pictures under single lights, from three cameras."""
    made = make_stage(3, lights)
    pictures = {}
    for c in range(3):
        for i in range(lights):
            pictures[c, i] = folder / f"{c}_{i}.exr"
            write_exr(pictures[c, i], photograph(made, c, i, 0.03).astype(np.float32), half=True)
    return rig_of(lights_of(made), cameras_of(made.poses), np.eye(4), {}), pictures


def test_each_camera_finds_normals_although_the_surface_is_wrong(tmp_path: Path) -> None:
    """A surface that is 6 mm too large, and bent: the maps have the ball's normals and albedo."""
    rig, pictures = pictured(tmp_path)
    mesh = globe(4)
    wrong = meshed(mesh.vertices.astype(float) * (1.06 + 0.04 * np.sin(40 * mesh.vertices[:, :1])), mesh.faces)
    maps = answer_maps(wrong, rig, pictures, tmp_path / "scratch", lambda: None, silent)
    assert len(maps) == 3 and not list((tmp_path / "scratch").iterdir())
    for one in maps:
        shown, at = hit(one.camera)
        values = one.values.reshape(-1, 7)[shown]
        facing = (unit(one.camera.eye - at) * at / RADIUS).sum(1) > 0.5
        known = facing & (values[:, 6] > 0)
        assert known.sum() > 0.95 * facing.sum()
        angle = np.degrees(np.arccos(np.clip((values[known, :3] * at[known] / RADIUS).sum(1), -1, 1)))
        assert np.median(angle) < 2.5 and np.quantile(angle, 0.9) < 6
        assert np.median(np.abs(values[known, 3:6] - np.log(albedo_at(at[known])))) < 0.08


def test_a_camera_without_pictures_knows_nothing(tmp_path: Path) -> None:
    rig, pictures = pictured(tmp_path, 12)
    some = {k: p for k, p in pictures.items() if k[0] != 1}
    maps = answer_maps(globe(3), rig, some, tmp_path / "scratch", lambda: None, silent)
    assert not maps[1].values.any() and maps[0].values.any()
