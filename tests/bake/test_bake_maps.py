"""Baked maps against fields whose surface and material are formulas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline import meshes, raster, tangents
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.images import read_encoded, read_exr
from pipeline.maths import microfacet
from pipeline.meshes import Charts, Mesh
from pipeline.visibility import FittedPhoto, Occluder
from stages.bake.ambient import ambient
from stages.bake.build import Baked, Baker
from stages.bake.lut import basis_lut
from stages.bake.write import write_maps
from stages.surface.build import build as surface_build
from stages.uv import unwrap
from stages.uv.config import Config
from stages.uv.decimate import decimated
from tests.support import analytic_fields as analytic
from tests.support.analytic_fields import AnalyticField, bumpy_head, ellipsoid, sphere
from tests.support.field_artifacts import camera

SIZE = 256
HALF = 2**-11  # largest relative rounding of a 16-bit float
VIEWS = tuple(FittedPhoto(camera(i, np.pi / 2 * i), None) for i in range(4))


def quiet(done: int, total: int, message: str = "") -> None:
    """No progress shown."""


def charted(field: AnalyticField, faces: int) -> tuple[Mesh, Charts]:
    dense = surface_build(field, 64, quiet).mesh
    mesh = decimated(dense, faces)
    return mesh, unwrap.unwrap(mesh, Config(texture_size=SIZE, padding=4))


@pytest.fixture(scope="module")
def field() -> AnalyticField:
    return AnalyticField(ellipsoid())


@pytest.fixture(scope="module")
def mesh_and_charts(field: AnalyticField) -> tuple[Mesh, Charts]:
    return charted(field, 1500)


@pytest.fixture(scope="module")
def baked(field: AnalyticField, mesh_and_charts: tuple[Mesh, Charts]) -> Baked:
    return Baker(field, *mesh_and_charts, VIEWS, SIZE, quiet).tile(0)


@pytest.fixture(scope="module")
def folder(baked: Baked, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("maps")
    write_maps(baked, Context(out, out))
    return out / "textures"


def truth(mesh: Mesh, charts: Charts, texels: np.ndarray) -> np.ndarray:
    """Points of the ellipsoid under texel centres, one texel after the other: the mesh's point, then bisection along
    the mesh's interpolated normal."""
    radii = np.array((0.075, 0.11, 0.09))
    uv = charts.uvs.astype(np.float64)[charts.faces]
    out = []
    for texel in texels:
        x, y = (texel % SIZE + 0.5) / SIZE, 1 - (texel // SIZE + 0.5) / SIZE
        a, b, c = uv[:, 0], uv[:, 1], uv[:, 2]
        det = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
        s = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / det
        t = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / det
        face = int(np.argmax(np.minimum(np.minimum(s, t), 1 - s - t)))
        w = np.array([1 - s[face] - t[face], s[face], t[face]])
        if w.min() < 0:  # the centre is outside every chart
            out.append(np.full(3, np.nan))
            continue
        p, n = w @ mesh.vertices[mesh.faces[face]], w @ mesh.normals[mesh.faces[face]]
        n = n / np.linalg.norm(n)
        low, high = -0.01, 0.01
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if np.linalg.norm((p + middle * n) / radii) > 1 else (middle, high)
        out.append(p + low * n)
    return np.array(out)


@pytest.fixture(scope="module")
def checked(mesh_and_charts: tuple[Mesh, Charts], baked: Baked) -> tuple[np.ndarray, np.ndarray]:
    """Some covered texels and the true points under their centres."""
    chosen = baked.texel[:: max(1, len(baked.texel) // 400)]
    points = truth(*mesh_and_charts, chosen)
    inside = np.isfinite(points).all(1)
    assert inside.sum() > 200
    return chosen[inside], points[inside]


def well_seen(points: np.ndarray) -> np.ndarray:
    """(N,) whether a view sees the ellipsoid's points (N, 3) at a clearly larger cosine than unseen.CLEAR."""
    normal = points / np.array((0.075, 0.11, 0.09)) ** 2
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(np.abs(normal[:, [0, 2]]).max(1) > 0.65)


@pytest.mark.parametrize(
    ("name", "formula"),
    [
        ("albedo", analytic.linear_albedo),
        ("specular_intensity", analytic.linear_rho),
        ("specular_coefficients", lambda p: analytic.linear_rho(p)[:, None] * analytic.linear_coefficients(p)),
        ("inv_kappa", analytic.linear_inv_kappa),
        ("shininess", lambda p: 1 / analytic.linear_inv_kappa(p)),
    ],
)
def test_material_is_that_of_the_true_surface(folder: Path, checked: tuple, name: str, formula: object) -> None:
    texel, points = checked
    image, channels = read_exr(folder / f"{name}.exr")
    expected = np.atleast_2d(formula(points).T).T  # type: ignore[operator]
    got = image.reshape(-1, image.shape[2])[texel]
    if name == "albedo":  # where no photo shows the surface well, it follows what is around
        use = well_seen(points)
        got, expected = got[use], expected[use]
        assert len(got) > 200
    assert np.abs(got / expected - 1).max() < 1e-3 + HALF
    if name == "specular_coefficients":
        assert channels == ("R", "G", "B")  # as the usd stage links them


def test_f0_and_roughness_follow_their_formulas(folder: Path, checked: tuple) -> None:
    texel, points = checked
    strength = analytic.linear_rho(points) * (analytic.linear_coefficients(points) * [0.05, 0.1, 0.15]).sum(1)
    kappa = 1 / analytic.linear_inv_kappa(points)
    alpha = 0.5407 * (kappa.clip(2.1, 89) - 1.517) ** -0.486
    f0 = read_exr(folder / "f0.exr")[0].reshape(-1)[texel]
    assert (
        np.abs(f0 - strength / np.interp(alpha, [0, 0.1, 0.15, 0.2, 0.3], [1, 0.988, 0.972, 0.948, 0.877])).max() < 1e-4
    )
    roughness = read_exr(folder / "roughness.exr")[0].reshape(-1)[texel]
    assert np.abs(roughness - np.sqrt(alpha)).max() < 1e-4 + HALF


def test_normal_map_gives_back_the_gradient(
    folder: Path, checked: tuple, mesh_and_charts: tuple[Mesh, Charts], baked: Baked
) -> None:
    mesh, charts = mesh_and_charts
    texel, points = checked
    expected = points / np.array((0.075, 0.11, 0.09)) ** 2
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    hits = raster.rasterise(raster.texel_corners(charts, SIZE), SIZE, 0, SIZE)
    row = np.searchsorted(hits.texel, texel)
    t, b, n = tangents.at(tangents.frames(mesh, charts), mesh, hits.face[row], hits.weights[row])
    for image, limit in ((read_exr(folder / "normal.exr")[0], 0.05), (read_encoded(folder / "normal.png"), 0.5)):
        local = image.reshape(-1, 3)[texel].astype(np.float64)
        local = local / 255 * 2 - 1 if image.dtype == np.uint8 else local
        got = local[:, :1] * t + local[:, 1:2] * b + local[:, 2:] * n
        angle = np.degrees(np.arccos(np.clip((got * expected).sum(1) / np.linalg.norm(got, axis=1), -1, 1)))
        assert angle.mean() < limit
    flat = np.degrees(np.arccos(np.clip((n * expected).sum(1), -1, 1)))
    assert flat.mean() < 5  # the map corrects little on a smooth body: frames, not luck, make it agree


@pytest.mark.slow
def test_normal_map_brings_back_bumps() -> None:
    """Bumps that the decimated mesh has lost are in the map; +y is up (growing v)."""
    smooth, bumpy = AnalyticField(ellipsoid()), AnalyticField(bumpy_ellipsoid)
    mesh, charts = charted(smooth, 1500)
    baked = Baker(bumpy, mesh, charts, (), SIZE, quiet).tile(0)
    hits = raster.rasterise(raster.texel_corners(charts, SIZE), SIZE, 0, SIZE)
    t, b, n = tangents.at(tangents.frames(mesh, charts), mesh, hits.face, hits.weights)
    local = baked.samples.normal.astype(np.float64)
    got = local[:, :1] * t + local[:, 1:2] * b + local[:, 2:] * n
    x = (mesh.vertices[mesh.faces[hits.face]] * hits.weights[..., None]).sum(1) + baked.samples.displacement[
        :, None
    ] * n
    value, gradient = bumpy_ellipsoid(x)
    expected = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    use = baked.samples.landed
    assert use.mean() > 0.99 and np.abs(value[use]).max() < 1e-4
    error = np.degrees(np.arccos(np.clip((got * expected).sum(1), -1, 1)))[use]
    relief = np.degrees(np.arccos(np.clip((n * expected).sum(1), -1, 1)))[use]
    assert error.mean() < 0.1 and relief.mean() > 3


def bumpy_ellipsoid(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    value, gradient = ellipsoid()(p)
    wave = np.sin(300 * p)
    slope = 0.0005 * 300 * np.cos(300 * p)
    others = np.stack([wave[:, 1] * wave[:, 2], wave[:, 0] * wave[:, 2], wave[:, 0] * wave[:, 1]], 1)
    return value + 0.0005 * wave.prod(1), gradient + slope * others


def test_tangents_point_along_u_and_v(mesh_and_charts: tuple[Mesh, Charts]) -> None:
    mesh, charts = mesh_and_charts
    face = np.arange(len(mesh.faces))
    weights = np.full((len(face), 3), 1 / 3)
    t, b, n = tangents.at(tangents.frames(mesh, charts), mesh, face, weights)
    for axis in (t, b, n):
        assert np.allclose(np.linalg.norm(axis, axis=1), 1)
    assert np.abs((t * n).sum(1)).max() < 1e-9 and np.allclose(np.cross(t, b), n)
    x, uv = mesh.vertices.astype(np.float64)[mesh.faces], charts.uvs.astype(np.float64)[charts.faces]
    for i in range(0, len(face), 37):  # dx = T du + B dv, solved for each face
        sides = np.stack([x[i, 1] - x[i, 0], x[i, 2] - x[i, 0]])
        steps = np.stack([uv[i, 1] - uv[i, 0], uv[i, 2] - uv[i, 0]])
        along = np.linalg.solve(steps, sides)
        assert along[0] @ t[i] > 0.8 * np.linalg.norm(along[0])
        assert along[1] @ b[i] > 0.8 * np.linalg.norm(along[1])


def test_mirrored_chart_has_the_other_handedness(mesh_and_charts: tuple[Mesh, Charts]) -> None:
    mesh, charts = mesh_and_charts
    mirrored = Charts(charts.uvs * np.float32([-1, 1]) + np.float32([1, 0]), charts.faces)
    face, weights = np.arange(50), np.full((50, 3), 1 / 3)
    t, b, _ = tangents.at(tangents.frames(mesh, charts), mesh, face, weights)
    t2, b2, _ = tangents.at(tangents.frames(mesh, mirrored), mesh, face, weights)
    assert np.allclose(t2, -t, atol=1e-5) and np.allclose(b2, b, atol=1e-5)


def test_displacement_is_the_way_to_the_surface(folder: Path, checked: tuple, mesh_and_charts: tuple) -> None:
    mesh, charts = mesh_and_charts
    texel, points = checked
    mm = read_exr(folder / "displacement.exr")[0].reshape(-1)[texel]
    hits = raster.rasterise(raster.texel_corners(charts, SIZE), SIZE, 0, SIZE)
    row = np.searchsorted(hits.texel, texel)
    start = (mesh.vertices[mesh.faces[hits.face[row]]] * hits.weights[row][..., None]).sum(1)
    assert np.allclose(np.abs(mm), 1000 * np.linalg.norm(points - start, axis=1), atol=2e-3)
    assert mm.mean() > 0  # a body's chords lie inside it


def test_gutters_never_bleed(folder: Path, baked: Baked) -> None:
    """No mip level mixes a chart with anything that is not a chart's value."""
    covered = baked.covered()
    for name in ("albedo", "inv_kappa", "f0", "roughness", "specular_coefficients"):
        image = read_exr(folder / f"{name}.exr")[0]
        low, high = image[covered].min(0), image[covered].max(0)
        assert not covered.all() and (image >= low).all() and (image <= high).all()
        level = image
        while len(level) > 1:
            level = level.reshape(len(level) // 2, 2, -1, 2, image.shape[2]).mean((1, 3))
            assert (level >= low - 1e-6).all() and (level <= high + 1e-6).all()
    normal = read_exr(folder / "normal.exr")[0]
    assert np.allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-3)
    assert read_encoded(folder / "albedo.png").min() > 0


def test_each_empty_texel_repeats_the_nearest_chart(baked: Baked) -> None:
    covered = baked.covered()
    rows, columns = np.nonzero(covered)
    rng = np.random.default_rng(1)
    for r, c in rng.permutation(np.argwhere(~covered))[:50]:
        square = (rows - r) ** 2 + (columns - c) ** 2
        source = baked.texel[baked.nearest[r, c]]
        assert (source // SIZE - r) ** 2 + (source % SIZE - c) ** 2 == square.min()


def test_ambient_occlusion_of_a_groove() -> None:
    """On the floor of a long groove of half width a and depth d the sky fills sin(atan(a / d)) of the cosine."""
    box = trimesh.creation.box((0.4, 0.02, 4.0))
    walls = [trimesh.creation.box((0.02, 0.1, 4.0)).apply_translation((x, 0.05, 0)) for x in (-0.06, 0.06)]
    both = trimesh.util.concatenate([box, *walls])
    floor = np.array([[0, 0.0101, 0], [0.001, 0.0101, 0], [0, 0.0101, 0.001]], np.float32)
    vertices = np.concatenate([both.vertices, floor]).astype(np.float32)
    normals = np.concatenate([both.vertex_normals, np.tile([0, 1, 0], (3, 1))]).astype(np.float32)
    mesh = Mesh(vertices, normals, both.faces.astype(np.int32))
    got = ambient(mesh, Occluder(mesh), lambda done, total: None)[-3:]
    lifted = 0.1 - 0.0101 - 0.002 * 4.0
    assert np.allclose(got, np.sin(np.arctan(0.05 / lifted)), atol=0.03)


def test_albedo_is_clamped_to_what_skin_can_be(field: AnalyticField, mesh_and_charts: tuple, tmp_path: Path) -> None:
    class Glowing(AnalyticField):
        def material(self, points: np.ndarray) -> object:  # type: ignore[override]
            found = super().material(points)
            found.albedo[points[:, 0] > 0.05] = 1.0
            return found

    baked = Baker(Glowing(ellipsoid()), *mesh_and_charts, VIEWS, SIZE, quiet).tile(0)
    albedo, clamped = np.asarray(baked.samples.albedo), np.asarray(baked.samples.clamped)
    assert albedo.max() == np.float32(0.95) and clamped.max() == pytest.approx(0.05, abs=1e-6)
    assert (
        baked.statistics.figures(detail=False)["albedo_clamped"] == pytest.approx((clamped > 0).mean(), abs=1e-6)
        and (clamped > 0).any()
    )
    assert any("was clamped" in w for w in baked.statistics.warnings(0, 0))
    maps = write_maps(baked, Context(tmp_path, tmp_path))
    marked = read_exr(tmp_path / "textures/clamped.exr")[0][..., 0]
    assert np.array_equal(marked.reshape(-1)[baked.texel] > 0, clamped > 0) and "clamped" in maps


def test_coverage_holds_every_touched_texel(mesh_and_charts: tuple[Mesh, Charts], baked: Baked) -> None:
    _, charts = mesh_and_charts
    rng = np.random.default_rng(0)
    r, s = np.sqrt(rng.random((40, len(charts.faces), 1))), rng.random((40, len(charts.faces), 1))
    a, b, c = charts.uvs[charts.faces].transpose(1, 0, 2)
    points = ((1 - r) * a + r * (1 - s) * b + r * s * c).reshape(-1, 2)
    column, row = (points[:, 0] * SIZE).astype(int), ((1 - points[:, 1]) * SIZE).astype(int)
    covered = baked.covered()
    assert covered[row.clip(0, SIZE - 1), column.clip(0, SIZE - 1)].all()
    assert (
        covered.mean() == baked.statistics.coverage
        and covered.mean() < 1.35 * unwrap.signed_areas(charts.uvs.astype(np.float64), charts.faces).sum()
    )


def test_maps_do_not_depend_on_bands(
    field: AnalyticField, mesh_and_charts: tuple, baked: Baked, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, small in (("BAND", 3000), ("NEAREST_BAND", 1), ("HALO", 8)):
        monkeypatch.setattr(f"stages.bake.build.{name}", small)
    again = Baker(field, *mesh_and_charts, VIEWS, SIZE, quiet).tile(0)
    assert np.array_equal(again.texel, baked.texel) and np.allclose(again.samples.albedo, baked.samples.albedo)
    assert np.array_equal(again.nearest, baked.nearest)


@pytest.mark.slow
def test_cap_is_left_where_it_is() -> None:
    field = AnalyticField(bumpy_head(0.0005))
    mesh, charts = charted(field, 3000)
    baked = Baker(field, mesh, charts, (), SIZE, quiet).tile(0)
    hits = raster.rasterise(raster.texel_corners(charts, SIZE), SIZE, 0, SIZE)
    y = (mesh.vertices[mesh.faces[hits.face]] * hits.weights[..., None]).sum(1)
    on_cap = (y[:, 1] < -0.1275) & (np.hypot(y[:, 0], y[:, 2]) < 0.04)
    assert on_cap.sum() > 50 and not baked.samples.landed[on_cap].any()
    assert np.abs(baked.samples.displacement[on_cap]).max() == 0
    assert np.allclose(baked.samples.normal[on_cap], [0, 0, 1], atol=1e-5)
    assert any("the fitted surface does not reach" in w for w in baked.statistics.warnings(0, 0)) and any(
        "no fitted view" in w for w in baked.statistics.warnings(0, 0)
    )


# ------------------------------------------------------------------ table
def test_basis_table_of_a_basis_of_the_cosine(field: AnalyticField) -> None:
    lut, residual = basis_lut(field)
    c = (np.arange(64) + 0.5) / 64
    assert lut.shape == (1, 64, 3) and residual < 1e-5
    assert np.allclose(lut[0], (1 + (1 - c) ** 2)[:, None] * np.array([1, 2, 3]) / 20, atol=1e-5)


def test_basis_table_residual() -> None:
    class Turned(AnalyticField):
        def basis(self, wo: np.ndarray, normal: np.ndarray) -> np.ndarray:
            """1 + n_y / 2 for every base: mean 1, standard deviation 0.5 / sqrt(3)."""
            return np.repeat(1 + 0.5 * normal[:, 1:2], 3, 1).astype(np.float32)

    lut, residual = basis_lut(Turned(sphere()))
    assert np.allclose(lut, 1, atol=1e-3) and residual == pytest.approx(0.5 / np.sqrt(3), rel=0.01)


# ------------------------------------------------------------------ bad input
def test_charts_without_area_are_refused(field: AnalyticField, mesh_and_charts: tuple[Mesh, Charts]) -> None:
    mesh, charts = mesh_and_charts
    flat = Charts(np.full_like(charts.uvs, -5.0), charts.faces)
    with pytest.raises(StageError, match="no texels"):
        Baker(field, mesh, flat, (), SIZE, quiet).tile(0)


def test_field_that_is_not_finite_is_refused(mesh_and_charts: tuple[Mesh, Charts]) -> None:
    class Broken(AnalyticField):
        def material(self, points: np.ndarray) -> object:  # type: ignore[override]
            found = super().material(points)
            found.albedo[points[:, 0] > 0.05] = np.nan
            return found

    with pytest.raises(StageError, match="not finite"):
        Baker(Broken(ellipsoid()), *mesh_and_charts, (), SIZE, quiet).tile(0)


def test_meshes_round_trip(mesh_and_charts: tuple[Mesh, Charts], tmp_path: Path) -> None:
    mesh, charts = mesh_and_charts
    meshes.save(tmp_path / "m.npz", mesh, charts)
    again, again_charts = meshes.load(tmp_path / "m.npz"), meshes.load_charts(tmp_path / "m.npz")
    assert np.array_equal(again.normals, mesh.normals) and np.array_equal(again_charts.faces, charts.faces)
    meshes.save(tmp_path / "bare.npz", mesh)
    with pytest.raises(KeyError):
        meshes.load_charts(tmp_path / "bare.npz")
    assert microfacet.E_SS[0] == 1
