"""Decimation, charts and their figures, against plain loops and formulas."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from pipeline import meshes, raster
from pipeline.errors import StageError
from pipeline.meshes import Charts, Mesh
from stages.surface.build import build as surface_build
from stages.surface.trim import cut
from stages.uv import decimate, unwrap
from stages.uv import pack as packing
from stages.uv.build import Built, build
from stages.uv.chart_quality import measure, stretch
from stages.uv.config import Config
from tests.support.analytic_fields import AnalyticField, bumpy_head, sphere


def quiet(done: int, total: int, message: str = "") -> None:
    """No progress shown."""


@pytest.fixture(scope="module")
def dense() -> Mesh:
    return surface_build(AnalyticField(bumpy_head(0.001, 60.0)), 80, quiet).mesh


@pytest.fixture(scope="module")
def built(dense: Mesh) -> Built:
    return build(dense, Config(target_faces=5000, proxy_faces=1000, texture_size=512, padding=4), quiet)


def painted(charts: Charts, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Another rasteriser: scan lines, one triangle after the other. Counts and the last face, row 0 at v = 0."""
    count, owner = np.zeros((size, size), int), np.full((size, size), -1)
    for face, corner in enumerate(charts.uvs.astype(np.float64)[charts.faces] * size):
        low, high = np.floor(corner.min(0)).astype(int), np.ceil(corner.max(0)).astype(int)
        (x0, y0), (x1, y1), (x2, y2) = corner
        det = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if det == 0:
            continue
        y, x = np.mgrid[max(low[1], 0) : min(high[1], size), max(low[0], 0) : min(high[0], size)] + 0.5
        s = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / det
        t = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / det
        inside = (s > 1e-4) & (t > 1e-4) & (s + t < 1 - 1e-4)
        row, column = (y[inside] - 0.5).astype(int), (x[inside] - 0.5).astype(int)
        count[row, column] += 1
        owner[row, column] = face
    return count, owner


def test_mesh_is_closed_and_near_the_target(dense: Mesh, built: Built) -> None:
    assert 0.9 * 5000 < len(built.mesh.faces) <= 1.05 * 5000 and len(built.proxy.faces) <= 1.2 * 1000
    for mesh in (built.mesh, built.proxy):
        assert meshes.topology(mesh.faces, len(mesh.vertices)).manifold
        assert meshes.volume(mesh.vertices, mesh.faces) == pytest.approx(
            meshes.volume(dense.vertices, dense.faces), rel=0.02
        )
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    assert built.deviation.mean < 2e-4 and built.deviation.rms < 3e-4 and built.warnings == ()


def test_charts_hold_every_face_once(built: Built) -> None:
    charts = built.charts
    assert charts.uvs.min() >= 0 and charts.uvs.max() <= 1 and charts.uvs.dtype == np.float32
    assert charts.faces.shape == built.mesh.faces.shape and np.isfinite(charts.uvs).all()
    position_of = {}  # a texture vertex belongs to one place of the mesh
    for uv, vertex in zip(charts.faces.ravel().tolist(), built.mesh.faces.ravel().tolist(), strict=True):
        assert position_of.setdefault(uv, vertex) == vertex


def test_no_overlap_and_no_flip_by_another_rasteriser(built: Built) -> None:
    count, _ = painted(built.charts, 700)
    assert count.max() == 1
    uv = built.charts.uvs.astype(np.float64)[built.charts.faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    weight = meshes.areas(built.mesh.vertices, built.mesh.faces)
    assert weight[area <= 0].sum() < 0.005 * weight.sum()
    assert built.quality.utilisation == pytest.approx(area.sum(), abs=0.01)
    assert built.quality.utilisation > 0.45 and built.quality.overlap == 0 and built.quality.flipped < 1e-3


def test_charts_keep_their_distance(built: Built) -> None:
    """No texel of one chart is within `padding` texels of another chart."""
    from scipy.ndimage import distance_transform_edt

    _, owner = painted(built.charts, 512)
    chart = unwrap.chart_of_face(built.charts.faces, len(built.charts.uvs))
    label = np.where(owner >= 0, chart[owner], -1)
    biggest = np.argsort(-np.bincount(label[label >= 0]))[:4]
    for which in biggest:
        away = distance_transform_edt(label != which)
        assert away[(label >= 0) & (label != which)].min() >= 4


def test_few_charts_and_little_stretch(built: Built) -> None:
    assert built.quality.charts < 60 and built.quality.stretch < 1.35 and built.quality.empty < 0.005


@pytest.mark.slow
def test_twice_gives_the_same(dense: Mesh, built: Built) -> None:
    again = build(dense, Config(target_faces=5000, proxy_faces=1000, texture_size=512, padding=4), quiet)
    assert again.charts.uvs.tobytes() == built.charts.uvs.tobytes()
    assert again.mesh.vertices.tobytes() == built.mesh.vertices.tobytes() and again.quality == built.quality


def test_smooth_mesh_with_more_faces_wanted_is_kept(dense: Mesh) -> None:
    assert decimate.decimated(dense, len(dense.faces) + 1) is dense


@pytest.mark.slow
def test_a_mesh_with_a_border_keeps_it(dense: Mesh) -> None:
    """A head cut open below, as `surface.unseen=trimmed` leaves it: decimated and unwrapped, still one sheet."""
    ends, share, faces = cut(dense.faces, 0.5 + dense.vertices[:, 1].astype(np.float64) + 0.05)
    start, end = dense.vertices[ends].transpose(1, 0, 2)
    points = np.concatenate([dense.vertices, start + share[:, None] * (end - start)])
    vertices, faces, source = meshes.compact(points, faces)
    normals = np.concatenate([dense.normals, dense.normals[ends[:, 0]]])[source]
    opened = Mesh(vertices.astype(np.float32), normals, faces)
    made = build(opened, Config(target_faces=1200, proxy_faces=300, texture_size=512, padding=4), quiet)
    for mesh in (made.mesh, made.proxy):
        found = meshes.topology(mesh.faces, len(mesh.vertices))
        assert found.sound and found.components == 1 and found.euler == 1
        assert mesh.vertices[:, 1].min() > -0.052
    assert made.quality.overlap == 0 and made.quality.flipped == 0 and made.quality.charts < 30
    assert made.quality.stretch < 1.35 and made.deviation.rms < 5e-4


def test_a_mesh_that_is_no_manifold_is_refused(dense: Mesh) -> None:
    tips = np.array([[0, 1, 2], [0, 3, 4]], np.int32)
    with pytest.raises(StageError, match="not a manifold"):
        build(
            Mesh(dense.vertices, dense.normals, tips),
            Config(target_faces=1000, proxy_faces=300, texture_size=512, padding=4),
            quiet,
        )


def test_bubble_is_cut_off() -> None:
    """A tetrahedron without one face, hung on the three edges of a face of a large mesh, is taken away again."""
    mesh = surface_build(AnalyticField(sphere()), 16, quiet).mesh
    a, b, c = mesh.faces[0].tolist()
    tip = len(mesh.vertices)
    bubble = np.array([[a, c, b], [a, b, tip], [b, c, tip], [c, a, tip]], np.int32)
    vertices = np.concatenate([mesh.vertices, [[0, 0.2, 0]]])
    faces = np.concatenate([mesh.faces, bubble])
    assert meshes.topology(faces, len(vertices)).crowded_edges == 3
    kept_vertices, kept = decimate.without_bubbles(vertices, faces)
    assert meshes.topology(kept, len(kept_vertices)).manifold and len(kept) == len(mesh.faces)
    beside = surface_build(AnalyticField(sphere()), 12, quiet).mesh  # a smaller piece is no bubble
    vertices = np.concatenate([vertices, beside.vertices + np.float32(5)])
    faces = np.concatenate([faces, beside.faces + tip + 1])
    assert len(decimate.without_bubbles(vertices, faces)[1]) == len(mesh.faces) + len(beside.faces)


@pytest.mark.slow
def test_deviation_of_shifted_spheres() -> None:
    """A sphere moved by e is away by e |cos| / 1 in the mean: half of e."""
    mesh = surface_build(AnalyticField(sphere()), 40, quiet).mesh
    moved = Mesh(mesh.vertices + np.array([0, 0.002, 0], np.float32), mesh.normals, mesh.faces)
    found = decimate.deviation(mesh, moved)
    assert found.mean == pytest.approx(0.001, rel=0.05)
    assert found.rms == pytest.approx(0.002 / np.sqrt(3), rel=0.05)  # the mean of cos^2 over a sphere is 1/3
    assert decimate.deviation(mesh, mesh).rms < 1e-7
    assert decimate.flipped_share(mesh, Mesh(mesh.vertices, mesh.normals, mesh.faces[:, ::-1].copy())) == 1


def test_distance_to_triangle_zones() -> None:
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    points = np.array([[0.2, 0.2, 0.5], [-3, -4, 0], [0.5, -2, 0], [2, 0, 0], [1, 1, 0], [0.1, 0.1, 0]], float)
    expected = [0.5, 5, 2, 1, np.sqrt(0.5), 0]
    got = decimate.distance_to_triangles(points, np.repeat(triangle[None], len(points), 0))
    assert np.allclose(got, expected)


def square_mesh() -> tuple[Mesh, Charts]:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uvs = np.array([[0.1, 0.1], [0.6, 0.1], [0.6, 0.6], [0.1, 0.6]], np.float32)
    return Mesh(vertices, np.tile(np.float32([0, 0, 1]), (4, 1)), faces), Charts(uvs, faces.copy())


def test_stretch_of_known_maps() -> None:
    mesh, charts = square_mesh()
    assert stretch(mesh, charts) == pytest.approx((1, 1), abs=1e-5)
    wide = Charts(charts.uvs * np.float32([1, 0.25]), charts.faces)
    # singular values 2 and 1/2 after the areas are made equal: sqrt((4 + 1/4) / 2)
    assert stretch(mesh, wide) == pytest.approx((np.sqrt(2.125), 2), rel=1e-5)
    long = charts.uvs.copy()
    long[:2, 1] = 0.599  # the first face is drawn out to a line, nearly; the second keeps half of its height
    assert measure(mesh, charts).stretched == 0 and measure(mesh, Charts(long, charts.faces)).stretched > 0.4


def test_seams_in_front_are_measured() -> None:
    """The diagonal of a square that looks forward, cut open; a square that looks back does not count."""
    mesh, charts = square_mesh()
    assert measure(mesh, charts).seam_front == 0
    cut = Charts(np.concatenate([charts.uvs, charts.uvs + 0.2]), np.array([[0, 1, 2], [4, 6, 7]], np.int32))
    assert measure(mesh, cut).seam_front == pytest.approx(np.sqrt(2), rel=1e-6)
    behind = Mesh(mesh.vertices * np.float32([-1, 1, 1]), -mesh.normals, mesh.faces)
    assert measure(behind, cut).seam_front == 0


def test_measure_sees_overlap_flip_and_empty_charts() -> None:
    mesh, charts = square_mesh()
    good = measure(mesh, charts)
    assert (good.charts, good.overlap, good.flipped, good.empty) == (1, 0, 0, 0)
    assert good.utilisation == pytest.approx(0.25, abs=2e-3) and good.stretch == pytest.approx(1, abs=1e-5)
    folded_uvs = charts.uvs.copy()
    folded_uvs[3] = [0.6, 0.2]  # the second triangle folds over the first
    folded = measure(mesh, Charts(folded_uvs, charts.faces))
    assert folded.overlap > 0.1 and folded.flipped == pytest.approx(0.5)
    flat_uvs = charts.uvs.copy()
    flat_uvs[3] = 0.5 * (flat_uvs[0] + flat_uvs[2])
    assert measure(mesh, Charts(flat_uvs, charts.faces)).empty == pytest.approx(0.5)


def test_mirrored_charts_are_turned_and_spread_apart() -> None:
    uvs = np.array([[0, 0], [1, 0], [0, 1], [0.2, 0.2], [0.2, 1], [1, 0.2]], float)
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    assert (unwrap.signed_areas(uvs, faces) > 0).tolist() == [True, False]
    turned = unwrap.turned_over(uvs, faces)
    assert (unwrap.signed_areas(turned, faces) > 0).all()
    apart = unwrap.spread(turned, faces)
    assert apart[3:, 0].min() > apart[:3, 0].max() or apart[:3, 0].min() > apart[3:, 0].max()
    assert np.allclose(unwrap.signed_areas(apart, faces), [0.5, 0.32])


def test_raster_layers_agree_with_the_other_rasteriser(built: Built) -> None:
    size = 300
    ours = raster.layers(raster.texel_corners(built.charts, size), size)[::-1]
    other, _ = painted(built.charts, size)
    assert (ours != other).mean() < 1e-3  # only texels on edges, where the margins differ


def random_charts(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rectangles of two triangles, turned by random angles, on top of each other."""
    rng = np.random.default_rng(3)
    uvs, faces = [], []
    for i in range(count):
        w, h, angle = *rng.uniform(0.2, 2, 2), rng.uniform(0, 6)
        corner = np.array([[0, 0], [w, 0], [w, h], [0, h]]) @ np.array(
            [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        )
        uvs.append(corner)
        faces += [[4 * i, 4 * i + 1, 4 * i + 2], [4 * i, 4 * i + 2, 4 * i + 3]]
    return np.concatenate(uvs), np.array(faces, np.int32)


def test_packing_keeps_shapes_and_distance() -> None:
    uvs, faces = random_charts(25)
    placed = packing.pack(uvs, faces, np.repeat(np.arange(25), 2), 0.01)
    assert placed is not None and placed.min() >= 0 and placed.max() <= 1
    before, after = unwrap.signed_areas(uvs, faces), unwrap.signed_areas(placed.astype(np.float64), faces)
    assert (after > 0).all() and np.allclose(after / before, after[0] / before[0], rtol=1e-3)
    assert after.sum() > 0.6
    corners = placed.reshape(25, 4, 2).astype(np.float64)
    steps = np.linspace(0, 1, 60)[:, None]
    outline = [
        np.concatenate([a + steps * (b - a) for a, b in zip(c, np.roll(c, -1, 0), strict=True)]) for c in corners
    ]
    for i in range(25):
        for j in range(i):
            assert cKDTree(outline[i]).query(outline[j])[0].min() > 0.01


def test_packing_turns_without_mirroring() -> None:
    uvs, faces = random_charts(9)
    placed = packing.pack(uvs, faces, np.repeat(np.arange(9), 2), 0.02)
    assert placed is not None
    for old, new in zip(uvs.reshape(9, 4, 2), placed.reshape(9, 4, 2).astype(np.float64), strict=True):
        a, b = (q - q.mean(0) for q in (old, new))
        u, _, vt = np.linalg.svd(a.T @ b)
        assert np.linalg.det(u @ vt) > 0
        assert np.allclose(a @ (u @ vt) * np.linalg.norm(b) / np.linalg.norm(a), b, atol=1e-5)


def test_packing_a_line_and_a_point() -> None:
    uvs = np.array([[0, 0], [1, 0], [0, 1], [0, 0], [0.2, 0.2], [0.4, 0.4], [3, 3], [3, 3], [3, 3]], float)
    faces = np.arange(9, dtype=np.int32).reshape(3, 3)
    placed = packing.pack(uvs, faces, np.arange(3), 0.01)
    assert placed is not None and placed.min() >= 0 and placed.max() <= 1
    triangle, line, point = placed.reshape(3, 3, 2).astype(float)
    scale = np.linalg.norm(triangle[1] - triangle[2]) / np.sqrt(2)
    assert scale > 0.3, "the triangle fills most of the square"
    for k, length in ((1, 0.2), (2, 0.4)):
        assert np.linalg.norm(line[k] - line[0]) == pytest.approx(scale * length * np.sqrt(2), rel=1e-3)
    assert np.ptp(point, 0).max() < 1e-6
    assert np.linalg.norm(line[:, None] - point[None], axis=2).min() >= 0.01 - 1e-6


def test_many_charts_go_to_the_other_packer(dense: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unwrap, "MANY_CHARTS", 0)
    for ours in ("unwrapped", "in_pieces"):
        monkeypatch.setattr(unwrap, ours, lambda *_, **__: None)
    charts = unwrap.unwrap(decimate.decimated(dense, 2000), Config(texture_size=512, padding=4))
    assert painted(charts, 500)[0].max() == 1
    assert (unwrap.signed_areas(charts.uvs.astype(np.float64), charts.faces) > 0).mean() > 0.99


def tetrahedra(shared: int) -> tuple[np.ndarray, np.ndarray]:
    """Two closed tetrahedra that have `shared` vertices in common."""
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    other = np.array([0, 1, 4, 5])[faces] if shared == 2 else np.array([0, 4, 5, 6])[faces]
    vertices = np.random.default_rng(0).normal(size=(6 if shared == 2 else 7, 3))
    return vertices, np.concatenate([faces, other]).astype(np.int32)


@pytest.mark.parametrize("shared", [1, 2])
def test_sheets_that_touch_are_split_apart(shared: int) -> None:
    vertices, faces = tetrahedra(shared)
    assert not meshes.topology(faces, len(vertices)).manifold
    v, f = meshes.split_apart(vertices, faces)
    found = meshes.topology(f, len(v))
    assert found.manifold and found.components == 2 and len(v) == 8
    assert np.array_equal(v[f], vertices[faces])  # nothing moves


def test_a_manifold_is_not_split(built: Built) -> None:
    v, f = meshes.split_apart(built.mesh.vertices.astype(np.float64), built.mesh.faces)
    assert len(v) == len(built.mesh.vertices) and np.array_equal(f, built.mesh.faces)


def test_holes_that_met_in_a_vertex_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A closed mesh loses two faces that share a vertex, opposite each other among its six: only once that vertex is
    parted can one walk around the hole."""
    whole, fine = (trimesh.creation.icosphere(subdivisions=n) for n in (2, 3))
    faces = np.asarray(whole.faces, np.int32)
    shared = int(np.flatnonzero(np.bincount(faces.ravel()) == 6)[0])
    centre = whole.triangles_center - whole.vertices[shared]
    around = np.flatnonzero((faces == shared).any(1))
    opposite = around[(centre[around] @ centre[around[0]]).argmin()]
    left = np.delete(faces, [around[0], opposite], axis=0)
    monkeypatch.setattr(decimate, "simplified", lambda *_: (np.asarray(whole.vertices, np.float64), left))
    dense = Mesh(fine.vertices.astype(np.float32), fine.vertex_normals.astype(np.float32), fine.faces.astype(np.int32))
    found = decimate.decimated(dense, len(faces))
    assert meshes.topology(found.faces, len(found.vertices)).manifold
