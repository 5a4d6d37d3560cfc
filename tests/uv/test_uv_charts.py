"""Charts of our own, on shapes that are awkward in different ways, against formulas and other libraries."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from pipeline import meshes
from pipeline.errors import Cancelled
from pipeline.meshes import Charts, Mesh
from stages.surface.build import build as surface_build
from stages.usd.render.render import _square, _triangle
from stages.uv import parameterise, segment, unwrap
from stages.uv.chart_quality import measure
from stages.uv.charts import unwrapped
from stages.uv.config import Config
from tests.support.analytic_fields import AnalyticField, bumpy_head


def mesh_of(made: trimesh.Trimesh) -> Mesh:
    return Mesh(
        np.asarray(made.vertices, np.float32),
        np.asarray(made.vertex_normals, np.float32),
        np.asarray(made.faces, np.int32),
    )


def quiet(done: int, total: int) -> None:
    """No progress shown."""


def noisy() -> Mesh:
    made = trimesh.creation.icosphere(3, 0.1)
    rng = np.random.default_rng(0)
    made.vertices += rng.normal(0, 0.002, made.vertices.shape)
    return mesh_of(made)


def two_parts() -> Mesh:
    a, b = trimesh.creation.icosphere(3, 0.08), trimesh.creation.torus(0.06, 0.02, major_sections=24, minor_sections=12)
    b.apply_translation([0.2, 0, 0])
    return mesh_of(trimesh.util.concatenate([a, b]))


def thin_plate() -> Mesh:
    made = trimesh.creation.box((0.2, 0.2, 0.002)).subdivide_to_size(0.03)
    made.merge_vertices()
    return mesh_of(made)


ZOO = {
    "sphere": lambda: mesh_of(trimesh.creation.icosphere(3, 0.1)),
    "torus": lambda: mesh_of(trimesh.creation.torus(0.08, 0.03, major_sections=36, minor_sections=18)),
    "two parts": two_parts,
    "thin plate": thin_plate,
    "noisy": noisy,
}


@pytest.mark.parametrize("way", ["own", "pieces", "xatlas"])
def test_a_signal_ends_the_unwrapping_between_its_parts(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    """The last look-up before the charts are placed says stop: nothing after it begins."""
    calls: list[str] = []

    def check() -> None:
        calls.append("check")
        if len(calls) == {"own": 2, "pieces": 3, "xatlas": 4}[way]:
            raise Cancelled("stopped")

    mesh = ZOO["sphere"]()
    monkeypatch.setattr(unwrap, "unwrapped", lambda *a, **k: object() if way == "own" else None)
    monkeypatch.setattr(unwrap, "in_pieces", lambda *a, **k: (None, None, None) if way == "pieces" else None)
    monkeypatch.setattr(unwrap, "_cut", lambda *a: (None, None))
    monkeypatch.setattr(unwrap, "_flat", lambda *a: (None, None))
    for later in ("_with_texels", "_placed", "evened"):
        monkeypatch.setattr(unwrap, later, lambda *a: pytest.fail("it went on"))
    with pytest.raises(Cancelled):
        unwrap.unwrap(mesh, Config(), check=check)


@pytest.mark.slow
@pytest.mark.parametrize("name", ZOO)
def test_charts_of_awkward_shapes_are_valid(name: str) -> None:
    mesh = ZOO[name]()
    assert meshes.topology(mesh.faces, len(mesh.vertices)).manifold
    charts = unwrap.unwrap(mesh, Config(texture_size=512, padding=3))
    found = measure(mesh, charts)
    assert found.charts <= 40 and found.utilisation > 0.45
    assert found.overlap < 1e-3 and found.flipped < 1e-3 and found.empty < 1e-3
    assert found.stretch < 1.3
    if name == "noisy":
        again = unwrap.unwrap(mesh, Config(texture_size=512, padding=3))
        assert again.uvs.tobytes() == charts.uvs.tobytes()


@pytest.mark.slow
def test_seams_keep_off_the_front_of_a_head(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is left is the ring around the neck, under the chin; an even cost cuts through the face."""
    mesh = surface_build(AnalyticField(bumpy_head(0.0, 60.0)), 56, quiet).mesh
    smooth = unwrap.smoothed(mesh.vertices.astype(np.float64), mesh.faces, 0.005)
    charts = unwrapped(mesh, smooth, 4 / 512)
    assert charts is not None
    found = measure(mesh, charts)
    assert found.seam_front < 0.15 and found.utilisation > 0.6 and found.charts <= 12
    monkeypatch.setattr(segment, "FRONT_COST", 1e-6)
    even = unwrapped(mesh, smooth, 4 / 512)
    assert even is not None and measure(mesh, even).seam_front > 1.5 * found.seam_front


def patch(height: float, n: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A cylinder's wall of radius 1 over 1.5 rad, which unrolls without stretch; rows of n x n points."""
    angle, z = np.meshgrid(np.linspace(0, 1.5, n), np.linspace(0, height, n))
    points = np.stack([np.cos(angle), np.sin(angle), z], -1).reshape(-1, 3)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int64)


def test_a_cylinder_unrolls_to_its_rectangle() -> None:
    points, faces = patch(2.0)
    uv = parameterise.rigid(points, faces, parameterise.conformal(points, faces))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    flat, true = (np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (uv, points))
    np.testing.assert_allclose(flat, true, rtol=2e-3)
    assert (parameterise.signed_areas(uv, faces) > 0).all()
    diagonal = np.linalg.norm(uv[0] - uv[-1])
    assert diagonal == pytest.approx(np.hypot(1.5, 2.0), rel=2e-3)


def test_conformal_maps_keep_angles() -> None:
    """A cap of a sphere: LSCM's angles agree with the surface's to about the facets' size; areas do not have to."""
    made = trimesh.creation.icosphere(4, 1.0)
    keep = made.triangles_center[:, 2] > 0.4
    vertices, faces, _ = meshes.compact(made.vertices, made.faces[keep].astype(np.int32))
    uv = parameterise.conformal(np.asarray(vertices, np.float64), faces.astype(np.int64))

    def angles(p: np.ndarray) -> np.ndarray:
        a, b = p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]]
        cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        return np.degrees(np.arccos(cosine))

    off = np.abs(angles(uv) - angles(np.asarray(vertices)))
    assert off.max() < 3 and off.mean() < 0.7


@pytest.mark.parametrize("shape, cuts", [("disc", 0), ("ring", 1)])
def test_rings_are_cut_once_and_discs_never(shape: str, cuts: int) -> None:
    points, faces = patch(2.0, 12)
    if shape == "ring":
        middle = points[faces].mean(1)
        faces = faces[
            ~((np.abs(middle[:, 2] - 1) < 0.4) & (np.abs(np.arctan2(middle[:, 1], middle[:, 0]) - 0.75) < 0.3))
        ]
    e = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    code = e[:, 0] * 1000 + e[:, 1]
    order = np.argsort(code, kind="stable")
    twin = np.flatnonzero(np.diff(code[order]) == 0)
    a, b = order[twin], order[twin + 1]
    length = np.linalg.norm(points[e[a, 0]] - points[e[a, 1]], axis=1)
    pairs = segment.Dual(a % len(faces), b % len(faces), e[a], length, length)
    cut = parameterise.disc_cuts(faces, pairs)
    assert cut is not None and bool(cut.any()) == bool(cuts)
    local, vertex = parameterise.joined_corners(faces, pairs, cut)
    assert parameterise.border_loops(local).max() == 0
    inner = np.linalg.norm(points[pairs.edge[cut][:, 0]] - points[pairs.edge[cut][:, 1]], axis=1).sum()
    assert inner < 0.6  # the shortest way from the hole to the border: 0.45 rad or 0.6 along the wall


def test_unfolding_mends_a_mirrored_triangle() -> None:
    points, faces = patch(2.0, 8)
    uv = parameterise.rigid(points, faces, parameterise.conformal(points, faces))
    broken = uv.copy()
    broken[27] += 3 * (uv[28] - uv[27])  # an inner vertex beyond its neighbour
    assert (parameterise.signed_areas(broken, faces) <= 0).any()
    assert (parameterise.signed_areas(parameterise.unfolded(faces, broken), faces) > 0).all()


def test_pixel_filters_have_their_moments() -> None:
    """Sum 1, middle of the pixel, variance 1/12 of a square and r^2 / 24 of a triangle of full width r."""
    for made, variance in ((_square(64), 1 / 12), (_triangle(64, 2.0), 4 / 24)):
        w = made.weights.astype(np.float64)
        assert w.sum() == pytest.approx(1, abs=1e-6)
        np.testing.assert_allclose(w @ made.offsets, 0.5, atol=1e-6)
        np.testing.assert_allclose(w @ (made.offsets - 0.5) ** 2, variance, rtol=2e-3)


def test_closed_pieces_are_no_discs() -> None:
    """A piece without a border has no disc; the stage then goes on to part it."""
    made = trimesh.creation.icosphere(2, 1.0)
    faces = made.faces.astype(np.int64)
    pairs = segment.dual(np.asarray(made.vertices), faces.astype(np.int32), np.ones(len(made.vertices)))
    assert parameterise.disc_cuts(faces, pairs) is None


def test_least_cut_parts_a_dumbbell_at_its_waist() -> None:
    """Two boxes joined by a thin bar: the cheapest border is around the bar."""
    vertices, faces = patch(6.0, 31)
    angle = np.arctan2(vertices[:, 1], vertices[:, 0])
    keep = (np.abs(vertices[faces].mean(1)[:, 2] - 3) > 1) | (np.abs(angle[faces].mean(1) - 0.75) < 0.2)
    own = faces[keep]
    e = np.sort(np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]]), 1)
    code = e[:, 0] * 10_000 + e[:, 1]
    order = np.argsort(code, kind="stable")
    twin = np.flatnonzero(np.diff(code[order]) == 0)
    a, b = order[twin], order[twin + 1]
    length = np.linalg.norm(vertices[e[a, 0]] - vertices[e[a, 1]], axis=1)
    pairs = segment.Dual(a % len(own), b % len(own), e[a], length, length)
    place = vertices[own].mean(1)[:, 2]
    area = meshes.areas(vertices.astype(np.float32), own.astype(np.int32))
    label = segment.halved(place, np.zeros(len(own), np.int64), 0, area, pairs)
    across = label[pairs.a] != label[pairs.b]
    assert set(label) == {0, 1} and length[across].sum() < 0.6
    assert (np.abs(vertices[e[a[across], 0], 2] - 3) <= 1.2).all()


@pytest.mark.slow
def test_charts_hold_their_faces() -> None:
    mesh = mesh_of(trimesh.creation.icosphere(2, 0.1))
    charts: Charts = unwrap.unwrap(mesh, Config(texture_size=512, padding=3))
    position: dict[int, int] = {}
    for uv, vertex in zip(charts.faces.ravel().tolist(), mesh.faces.ravel().tolist(), strict=True):
        assert position.setdefault(uv, vertex) == vertex
