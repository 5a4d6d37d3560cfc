"""The mesher against shapes whose surface is a formula."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline import meshes
from pipeline.artifacts import Cut, Extent
from pipeline.errors import StageError
from pipeline.extent import MESH, signed
from stages.surface import clean, extract
from stages.surface.build import Built, build
from stages.surface.judge import judge
from tests.support.analytic_fields import AnalyticField, Distance, bumpy_head, ellipsoid, sphere, union


def quiet(done: int, total: int) -> None:
    """No progress shown."""


def built(distance: Distance, resolution: int = 48, half: tuple[float, float, float] = (0.12, 0.13, 0.12)) -> Built:
    return build(AnalyticField(distance, half), resolution, quiet)


def edge_uses(faces: np.ndarray) -> dict[tuple[int, int], int]:
    """Plain count of directed edges, an oracle apart from pipeline.meshes."""
    uses: dict[tuple[int, int], int] = {}
    for a, b, c in faces.tolist():
        for edge in ((a, b), (b, c), (c, a)):
            uses[edge] = uses.get(edge, 0) + 1
    return uses


def test_sphere_is_exact_closed_and_outward() -> None:
    got = built(sphere(0.1))
    radius = np.linalg.norm(got.mesh.vertices.astype(np.float64), axis=1)
    assert np.abs(radius - 0.1).max() < 0.01 * got.cell
    uses = edge_uses(got.mesh.faces)
    assert all(n == 1 and uses.get((b, a)) == 1 for (a, b), n in uses.items())
    assert len(got.mesh.vertices) - len(uses) // 2 + len(got.mesh.faces) == 2
    assert meshes.volume(got.mesh.vertices, got.mesh.faces) == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=4e-3)
    assert np.abs(got.mesh.normals - got.mesh.vertices / 0.1).max() < 1e-4
    assert got.topology.manifold and got.topology.euler == 2 and got.warnings == ()
    assert got.cell == pytest.approx(0.26 / 48)


def test_faces_look_along_the_field_gradient() -> None:
    got = built(bumpy_head(), 64)
    face_normals = meshes.unit(meshes.area_vectors(got.mesh.vertices, got.mesh.faces))
    vertex_mean = meshes.unit(got.mesh.normals[got.mesh.faces].mean(1))
    assert np.mean((face_normals * vertex_mean).sum(1) > 0.5) > 0.99


def test_neck_is_capped_flat_inside_the_box() -> None:
    field = AnalyticField(bumpy_head())
    got = build(field, 64, quiet)
    floor = -0.13 + extract.INSET * got.cell
    on_floor = np.abs(got.mesh.vertices[:, 1] - floor) < 1e-6
    assert got.topology.manifold and got.topology.euler == 2
    assert on_floor.sum() > 100 and got.mesh.vertices[:, 1].min() > floor - 1e-6
    cap = on_floor[got.mesh.faces].all(1)
    area = meshes.areas(got.mesh.vertices, got.mesh.faces)[cap].sum()
    assert np.pi * (0.05 - got.cell) ** 2 < area < np.pi * 0.053**2  # the faces on the rim are not counted
    assert np.allclose(got.mesh.normals[on_floor].mean(0), [0, -1, 0], atol=0.02)
    free = ~on_floor
    assert np.abs(field.distance(got.mesh.vertices[free].astype(np.float64))[0]).max() < 0.01 * got.cell


def test_no_face_without_area() -> None:
    got = built(sphere(0.1), 26, (0.13, 0.13, 0.13))  # lattice nodes fall exactly on the sphere
    assert meshes.areas(got.mesh.vertices, got.mesh.faces).min() > 0.9 * clean.THIN * got.cell**2


def test_specks_and_cavities_go() -> None:
    specks = union(sphere(0.08), sphere(0.006, (0.1, 0.1, 0.1)), sphere(0.005, (-0.1, 0.11, 0.1)))

    def with_cavity(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, gradient = specks(p)
        hole, inward = sphere(0.02)(p)
        cut = -hole > value
        return np.where(cut, -hole, value), np.where(cut[:, None], -inward, gradient)

    got = built(with_cavity, 64)
    assert got.removed == 3 and got.topology.components == 1
    assert np.abs(np.linalg.norm(got.mesh.vertices, axis=1) - 0.08).max() < 1e-4
    assert got.warnings == ()


def test_large_second_piece_is_reported() -> None:
    got = built(union(sphere(0.07, (0, -0.03, 0)), sphere(0.03, (0.0, 0.09, 0))))
    assert got.removed == 1 and "disconnected components" in got.warnings[0]


def test_slabs_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = built(bumpy_head(), 64)
    monkeypatch.setattr(extract, "SLAB_NODES", 1)
    sliced = built(bumpy_head(), 64)
    assert sliced.topology == whole.topology
    distance, _ = cKDTree(whole.mesh.vertices).query(sliced.mesh.vertices)
    assert distance.max() < 1e-6 and len(whole.mesh.vertices) == len(sliced.mesh.vertices)


def test_twice_gives_the_same_bytes() -> None:
    a, b = built(bumpy_head(), 40), built(bumpy_head(), 40)
    for name in ("vertices", "normals", "faces"):
        assert getattr(a.mesh, name).tobytes() == getattr(b.mesh, name).tobytes()


def test_only_near_blocks_are_evaluated() -> None:
    field = AnalyticField(sphere(0.1))
    build(field, 128, quiet)
    assert field.evaluations < 0.45 * 128**3


@pytest.mark.parametrize("steepness", [0.2, 4.0, 30.0])
def test_fields_that_are_no_distances(steepness: float) -> None:
    """A slope far from one hides the surface from the near-block test; the walls that this makes are noticed."""

    def scaled(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, gradient = sphere(0.1, (0.003, 0.001, 0.002))(p)
        return steepness * value, steepness * gradient

    got = built(scaled, 64)
    radius = np.linalg.norm(got.mesh.vertices - np.array([0.003, 0.001, 0.002]), axis=1)
    assert got.topology.manifold and np.abs(radius - 0.1).max() < 0.01 * got.cell


def test_small_ball_between_coarse_nodes_is_found() -> None:
    got = built(sphere(0.004, (0.0113, 0.0071, 0.0029)), 64)
    assert got.topology.euler == 2


def constant(value: float) -> Distance:
    """A field that is the same everywhere."""
    return lambda p: (np.full(len(p), value), np.tile([0.0, 1.0, 0.0], (len(p), 1)))


def test_no_surface() -> None:
    with pytest.raises(StageError, match="no surface"):
        built(constant(0.5))


def test_a_solid_that_fills_its_box_is_handed_on_and_unusable() -> None:
    got = built(constant(-0.5), 24)
    assert got.topology.manifold and got.cap > 0.9
    (cap,) = (f for f in judge(got) if f.check == "cap")
    assert cap.level == "unusable" and "masks" in cap.remedy


def test_nan_is_refused() -> None:
    def broken(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, gradient = sphere(0.1)(p)
        return np.where(p[:, 0] > 0.05, np.nan, value), gradient

    with pytest.raises(StageError, match="not finite"):
        built(broken)


def test_flat_box_is_refused() -> None:
    with pytest.raises(StageError, match="no volume"):
        built(sphere(0.1), 32, (0.1, 0.0, 0.1))


def test_newton_stays_within_half_a_cell() -> None:
    field = AnalyticField(ellipsoid())
    grid = extract.lattice(field, 64)
    rng = np.random.default_rng(0)
    start = rng.uniform(-0.1, 0.1, (500, 3))
    landed = clean.land(field, grid, start)
    assert np.linalg.norm(landed.vertices - start, axis=1).max() <= clean.REACH * grid.h * 1.001


def test_small_bumps_on_a_steep_field_are_not_walled_off() -> None:
    """Warts smaller than a block leave no sign at its corners; a steep slope hides them from the distance test too."""
    directions = np.random.default_rng(6).normal(size=(60, 3))
    centres = 0.1006 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    warts = union(sphere(0.095), *(sphere(0.007, tuple(c)) for c in centres))

    def steep(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, gradient = warts(p)
        return 40 * value, 40 * gradient

    got = build(AnalyticField(steep, (0.12, 0.13, 0.12)), 64, quiet, handle=0)  # warts that touch make handles
    assert got.topology.manifold
    assert np.abs(warts(got.mesh.vertices.astype(np.float64))[0]).max() < 0.05 * got.cell  # no wall
    to_tip, _ = cKDTree(got.mesh.vertices).query(centres * 1.0696)
    assert to_tip.max() < 0.8 * got.cell


def test_the_fast_wall_distance_is_that_with_a_gradient() -> None:
    extent = Extent(centre=(0.06, 0.02, 0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), radii=(0.12, 0.1, 0.14),
                    cuts=(Cut(normal=(0.0, -1.0, 0.0), offset=0.05),), head=0.15)  # fmt: skip
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (5000, 3))
    for cutting in (None, extent):
        grid = extract.lattice(AnalyticField(sphere(0.1), (0.12, 0.13, 0.12)), 64, cutting)
        np.testing.assert_allclose(extract._wall(points, grid), extract.wall_distance(points, grid)[0], atol=1e-15)


def test_the_mesh_is_closed_at_the_extent() -> None:
    """A sphere cut by a slanting plane and by a ball: closed, on the sphere inside, on plane or ball elsewhere."""
    normal = np.array([0.3, -0.9, 0.1]) / np.linalg.norm([0.3, -0.9, 0.1])
    extent = Extent(centre=(0.06, 0.02, 0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), radii=(0.12,) * 3,
                    cuts=(Cut(normal=tuple(normal), offset=0.05),), head=0.15)  # fmt: skip
    got = build(AnalyticField(sphere(0.1), (0.12, 0.13, 0.12)), 64, quiet, extent=extent)
    assert got.topology.manifold and got.topology.euler == 2 and got.cap > 0.1
    x = got.mesh.vertices.astype(np.float64)
    reach = MESH * extent.head
    outside = signed(extent, x, reach)
    assert outside.max() < 0.3 * got.cell  # the rim, where both meet
    on_sphere = np.abs(np.linalg.norm(x, axis=1) - 0.1) < 0.02 * got.cell
    on_wall = np.abs(outside) < 0.02 * got.cell
    assert (on_sphere | on_wall).mean() > 0.95 and on_sphere.sum() > 500 and on_wall.sum() > 500
    grid = np.random.default_rng(0).uniform(-0.1, 0.1, (200_000, 3))
    kept = (np.linalg.norm(grid, axis=1) < 0.1) & (signed(extent, grid, reach) < 0)
    assert meshes.volume(x, got.mesh.faces) == pytest.approx(kept.mean() * 0.2**3, rel=0.02)
