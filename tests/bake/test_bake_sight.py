"""What the photos see of the texture: cosines, confidence and the votes for regions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.contract import Context
from pipeline.images import read_alpha, read_encoded, read_exr, write_png
from pipeline.meshes import Charts, Mesh
from pipeline.transforms import inverse_rigid, project
from pipeline.visibility import FittedPhoto, Occluder, sight_of, view_cosines
from stages.bake.build import Baked, Baker
from stages.bake.confidence import sighted
from stages.bake.regions import Poll, Votes
from stages.bake.write import write_maps
from stages.surface.build import build as surface_build
from stages.uv.config import Config
from stages.uv.decimate import decimated
from stages.uv.unwrap import unwrap
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.field_artifacts import camera

VIEWS = tuple(FittedPhoto(camera(i, np.pi / 2 * i), None) for i in range(4))


def quiet(done: int, total: int, message: str = "") -> None:
    """No progress shown."""


@pytest.fixture(scope="module")
def mesh_and_charts() -> tuple[Mesh, Charts]:
    mesh = decimated(surface_build(AnalyticField(sphere(0.08)), 32, quiet).mesh, 800)
    return mesh, unwrap(mesh, Config(texture_size=256, padding=4))


def weight_of(view: FittedPhoto, points: np.ndarray, normals: np.ndarray, occluder: Occluder) -> np.ndarray:
    return view_cosines(view, points, normals, occluder)[0]


def test_confidence_of_a_sphere_is_its_cosines() -> None:
    mesh = surface_build(AnalyticField(sphere()), 40, quiet).mesh
    points, normals = mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64)
    occluder = Occluder(mesh)
    view = FittedPhoto(camera(0, 0.0), None)
    away = np.array([0, 0, 0.6]) - points
    cosine = (away / np.linalg.norm(away, axis=1, keepdims=True) * normals).sum(1)
    clear = np.abs(cosine) > 0.1  # facets hide their own horizon
    got = weight_of(view, points, normals, occluder)
    assert np.allclose(got[clear], cosine.clip(0)[clear], atol=1e-6)


def test_confidence_sees_what_is_in_the_way(tmp_path: Path) -> None:
    ball = surface_build(AnalyticField(sphere(0.05)), 40, quiet).mesh
    wall_vertices = np.array([[-1, -1, 0.2], [1, -1, 0.2], [1, 1, 0.2], [-1, 1, 0.2]], np.float32)
    wall = np.array([[0, 1, 2], [0, 2, 3]], np.int32) + len(ball.vertices)
    both = Mesh(
        np.concatenate([ball.vertices, wall_vertices]),
        np.concatenate([ball.normals, np.tile(np.float32([0, 0, 1]), (4, 1))]),
        np.concatenate([ball.faces, wall]),
    )
    points, normals = ball.vertices.astype(np.float64), ball.normals.astype(np.float64)
    assert weight_of(FittedPhoto(camera(0, 0.0), None), points, normals, Occluder(both)).max() == 0
    assert weight_of(FittedPhoto(camera(0, np.pi), None), points, normals, Occluder(both)).max() > 0.9
    small = replace(FittedPhoto(camera(0, 0.0, focal=1000.0), None))  # only the middle fits into the photo
    seen = weight_of(small, points, normals, Occluder(ball)) > 0
    assert seen.any() and np.hypot(*points[seen][:, :2].T).max() < 0.6 * 32 / 1000 * 1.5


def test_confidence_respects_masks(tmp_path: Path) -> None:
    mask = np.zeros((64, 64))
    mask[:, 32:] = 1  # the right half of the photo: +x, as the camera looks along -z
    write_png(tmp_path / "0.png", mask)
    mesh = surface_build(AnalyticField(sphere(0.08)), 32, quiet).mesh
    points, normals = mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64)
    seen = weight_of(FittedPhoto(camera(0, 0.0), tmp_path / "0.png"), points, normals, Occluder(mesh)) > 0
    assert seen.any() and points[seen][:, 0].min() > -1e-3


def test_pixels_that_do_not_count_in_the_fit_show_nothing(tmp_path: Path) -> None:
    """The subject beyond its extent is not fitted: its colours there mean nothing."""
    asked = np.zeros((64, 64))
    asked[:, 32:] = 1
    write_png(tmp_path / "asked.png", asked)
    mesh = surface_build(AnalyticField(sphere(0.08)), 32, quiet).mesh
    points, normals = mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64)
    view = FittedPhoto(camera(0, 0.0), None, asked=tmp_path / "asked.png")
    seen = sight_of(points, normals, [view], Occluder(mesh)).cosine > 0
    assert seen.any() and points[seen][:, 0].min() > -1e-3


def test_the_best_cosine_is_that_of_the_view_straight_ahead(mesh_and_charts: tuple[Mesh, Charts]) -> None:
    mesh, _ = mesh_and_charts
    points, normals = mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64)
    occluder = Occluder(mesh)
    best = sight_of(points, normals, VIEWS, occluder).cosine
    np.testing.assert_array_equal(best, np.max([weight_of(v, points, normals, occluder) for v in VIEWS], axis=0))
    assert (sight_of(points, normals, (), occluder).cosine == 0).all()


def test_confidence_map_grows_with_views(mesh_and_charts: tuple[Mesh, Charts]) -> None:
    none, one, four = (sighted(*mesh_and_charts, v, 64, quiet).confidence for v in ((), VIEWS[:1], VIEWS))
    assert none.max() == 0 and 0.49 < one.max() <= 0.5 and (four >= one - 1e-6).all() and four.max() < 1
    assert one.min() == 0 and four.min() >= 0


def test_clipped_pixels_lower_the_confidence(mesh_and_charts: tuple[Mesh, Charts], tmp_path: Path) -> None:
    """As if the photo did not see them; elsewhere nothing changes. They are seen all the same."""
    mesh, _ = mesh_and_charts
    clipped = np.zeros((64, 64))
    clipped[:32] = 1  # the upper half of the photo: +y
    write_png(tmp_path / "0.png", clipped)
    plain, burnt = VIEWS[0], replace(VIEWS[0], clipped=tmp_path / "0.png")
    before, after = (sighted(*mesh_and_charts, (v, VIEWS[1]), 64, quiet).confidence for v in (plain, burnt))
    other = sighted(*mesh_and_charts, VIEWS[1:2], 64, quiet).confidence
    assert (after <= before).all() and np.isin(after, np.concatenate([before.ravel(), other.ravel()])).all()
    changed = after != before
    assert 0.1 < changed.mean() < 0.3 and np.array_equal(after[changed], other[changed])
    points, normals = mesh.vertices.astype(np.float64), mesh.normals.astype(np.float64)
    occluder = Occluder(mesh)
    assert np.array_equal(weight_of(plain, points, normals, occluder), weight_of(burnt, points, normals, occluder))


# ------------------------------------------------------------------ regions
def labelled(folder: Path, index: int, left: int, right: int) -> FittedPhoto:
    """A view whose photo has one label to the left of its middle, and another to the right."""
    labels = np.full((64, 64), left)
    labels[:, 32:] = right
    write_png(folder / f"{index}.png", labels / 255)
    return replace(VIEWS[index], labels=folder / f"{index}.png")


@pytest.fixture(scope="module")
def baked(mesh_and_charts: tuple[Mesh, Charts], tmp_path_factory: pytest.TempPathFactory) -> Baked:
    """The front view labels -x 1 and +x 7, the back view all 200; those from the sides have no labels."""
    folder = tmp_path_factory.mktemp("labels")
    views = (labelled(folder, 0, 1, 7), VIEWS[1], labelled(folder, 2, 200, 200), VIEWS[3])
    return Baker(AnalyticField(sphere(0.08)), *mesh_and_charts, views, 256, quiet).tile(0)


def test_each_texel_takes_the_label_of_the_photos_that_see_it(
    baked: Baked, mesh_and_charts: tuple[Mesh, Charts], tmp_path: Path
) -> None:
    from pipeline import raster

    mesh, charts = mesh_and_charts
    maps = write_maps(baked, Context(tmp_path, tmp_path))
    image = read_exr(tmp_path / "textures/region.exr")[0][..., 0]
    assert np.array_equal(read_encoded(tmp_path / "textures/region.png")[..., 0], image)
    hits = raster.rasterise(raster.texel_corners(charts, 256), 256, 0, 256)
    x, _, z = (mesh.vertices[mesh.faces[hits.face]] * hits.weights[..., None]).sum(1).T
    code = image.reshape(-1)[hits.texel]
    front, sure, side = z > 0.03, np.abs(x) > 0.004, np.abs(z) < 0.006  # cameras at 0.6 m see z > 0.0107 of the ball
    assert (code[front & sure] == np.where(x > 0, 7, 1)[front & sure]).all()
    assert (code[z < -0.03] == 200).all() and (code[side] == 0).all()
    assert set(np.unique(image)) == {0, 1, 7, 200} == set(np.unique(code))
    assert maps["region"].minimum == 0 and maps["region"].maximum == 200
    gutter = ~baked.covered()
    assert np.array_equal(image[gutter], image.reshape(-1)[baked.texel][baked.nearest[gutter]])


def test_without_labels_there_is_no_map_of_regions(mesh_and_charts: tuple[Mesh, Charts], tmp_path: Path) -> None:
    baked = Baker(AnalyticField(sphere(0.08)), *mesh_and_charts, VIEWS[:1], 256, quiet).tile(0)
    assert baked.votes is None and "region" not in write_maps(baked, Context(tmp_path, tmp_path))


def test_votes_count_by_their_cosines(tmp_path: Path) -> None:
    views = [labelled(tmp_path, i, code, code) for i, code in enumerate((5, 3, 3))]
    poll = Poll(3)
    for view, cosine in zip(views, ([0.9, 0.9, 0.0], [0.4, 0.5, 0.0], [0.4, 0.5, 0.0]), strict=True):
        poll.ask(view, np.array(cosine), np.full((3, 2), 32.0))
    votes = poll.result(lambda values: values.astype(np.float32)[None])
    assert votes is not None and votes.codes.tolist() == [3, 5]
    np.testing.assert_allclose(votes.image[0], [[0.8, 0.9], [1.0, 0.9], [0, 0]], rtol=1e-6)


def test_borders_of_regions_are_smooth_at_sizes_beyond_the_votes() -> None:
    """Votes are linear between places: a slanting border does not come in steps of a vote's size."""
    side, size = 32, 256
    y, x = np.mgrid[:side, :side] + 0.5
    first = (0.5 + (x - 0.5 * y - 8) / 8).clip(0, 1)
    votes = Votes(np.array([1, 2], np.uint8), np.stack([1 - first, first], -1).astype(np.float32))
    codes = votes.winners(np.arange(size * size), size).reshape(size, size)
    row, column = np.mgrid[:size, :size] + 0.5
    away = (column - 0.5 * row) * side / size - 8
    inside = (np.abs(row - size / 2) < 120) & (np.abs(column - size / 2) < 120)  # at its rim a picture is continued
    sure = (np.abs(away) > 0.05) & inside
    assert np.array_equal(codes[sure], np.where(away > 0, 2, 1)[sure])
    tied = Votes(np.array([4, 9], np.uint8), np.ones((2, 2, 2), np.float32))
    assert (tied.winners(np.arange(16), 4) == 4).all()


def test_distances_to_a_mesh_by_hand() -> None:
    """Two triangles, at 2 and 5 units: the first in the list is as good as any, a slanting ray is as much longer, and
    what points past both, or away, meets nothing."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    vertices = np.concatenate([corners, corners - np.array([0, 0, 3], np.float32)])
    mesh = Mesh(vertices, np.full_like(vertices, [0, 0, 1]), np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    ways = np.array([[0, 0, -1.0], [0.1, 0, -1], [5, 0, -1], [0, 0, 1]])
    length = np.linalg.norm(ways, axis=1)
    found = Occluder(mesh).distance(np.array([0.0, 0, 2]), ways / length[:, None])
    assert np.allclose(found[:2], 2 * length[:2], rtol=1e-5) and np.isinf(found[2:]).all()
    from_between = Occluder(mesh).distances(np.array([[0, 0, -1.0], [0, 0, -1]]), np.array([[0, 0, -1.0], [0, 0, 1]]))
    assert np.allclose(from_between, [2, 1], rtol=1e-5)


def test_masks_that_were_read_are_kept_up_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pipeline.images
    from pipeline.visibility import _Masks

    read: list[str] = []

    def counted(path: Path) -> np.ndarray:
        read.append(path.name)
        return read_alpha(path)

    monkeypatch.setattr(pipeline.images, "read_alpha", counted)
    halves = np.zeros((3, 40, 50), np.float32)
    halves[0, :20], halves[1, 20:], halves[2, :, :25] = 1, 1, 0.6
    paths = [tmp_path / f"{i}.png" for i in range(3)]
    for path, image in zip(paths, halves, strict=True):
        write_png(path, image)
    kept = _Masks(most=2 * 40 * 50)
    for i in (0, 1, 0, 2, 0, 1):  # of three, the one that was used longest ago is dropped
        np.testing.assert_array_equal(kept.inside(paths[i]), halves[i] > 0.5)
    assert read == ["0.png", "1.png", "2.png", "1.png"]
    write_png(paths[0], 1 - np.tile(halves[0], (2, 1)))
    assert kept.inside(paths[0]).shape == (80, 50) and not kept.inside(paths[0])[0].any()


@pytest.mark.parametrize("lens", [(0.0,) * 5, (0.1, -0.05, 0.01, -0.02, 0.03)])
def test_places_and_cosines_are_those_of_the_projection(lens: tuple[float, ...]) -> None:
    """Against transforms.project, with points beside the photo, behind the camera and at its centre, and a normal of no
    length; a nearer wall hides nothing here."""
    one = camera(3, 0.4, size=64, focal=90.0)
    pose = np.array(one.world_from_cam)
    view = FittedPhoto(one.model_copy(update={"distortion": lens, "width": 80, "height": 50}), None)
    rng = np.random.default_rng(5)
    points, normals = rng.normal(scale=0.4, size=(4000, 3)), rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points[0], normals[1] = pose[:3, 3], 0
    far = Mesh(np.float32([[9, 9, 9], [9.1, 9, 9], [9, 9.1, 9]]), np.zeros((3, 3), np.float32), np.int32([[0, 1, 2]]))
    found, uv = view_cosines(view, points, normals, Occluder(far))
    wanted, depth = project(np.array(one.K), inverse_rigid(pose), np.array(lens), points)
    away = pose[:3, 3] - points
    with np.errstate(invalid="ignore"):
        cosine = (away / np.linalg.norm(away, axis=1, keepdims=True) * normals).sum(1)
        seen = (cosine > 0) & (depth > 0) & (wanted >= 0).all(1) & (wanted[:, 0] < 80) & (wanted[:, 1] < 50)
    assert 100 < seen.sum() < 1500
    np.testing.assert_allclose(found, np.where(seen, cosine, 0), atol=1e-14)
    np.testing.assert_allclose(uv[seen], wanted[seen], atol=1e-9)
    assert np.isnan(uv[~seen]).all()
