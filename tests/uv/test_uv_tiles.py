"""Charts in several UDIM tiles: in one density, apart from each other, none across a border; and how many it takes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from pipeline import footprint, meshes, raster, tiles
from pipeline.artifacts import Camera, CameraSet, FileRef, FittedFace, Located, MaskSet, Surface
from pipeline.contract import Context
from pipeline.meshes import Charts, Mesh
from pipeline.transforms import rows
from stages.uv import charts as charting
from stages.uv import pack as packing
from stages.uv import unwrap
from stages.uv.chart_quality import measure
from stages.uv.stage import Config, Inputs, run
from stages.uv.tile_count import Tiling, packed
from tests.support.ball_head import no_head
from tests.uv.test_uv_build import random_charts

RADIUS = 0.1


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarser packing, a tenth of the time; nothing here depends on how tight it is."""
    monkeypatch.setattr(packing, "G", 96)
    monkeypatch.setattr(packing, "SEARCH", 3)
    monkeypatch.setattr(charting, "TRIES", 1)


@pytest.fixture(scope="module")
def ball() -> Mesh:
    made = trimesh.creation.icosphere(2, RADIUS)
    normals = made.vertices / RADIUS
    return Mesh(made.vertices.astype(np.float32), normals.astype(np.float32), made.faces.astype(np.int32))


def checked(mesh: Mesh, charts: Charts, padding: float, size: int = 512) -> np.ndarray:
    """(T,) uv area of each tile over its surface, after checks of each."""
    label = unwrap.chart_of_face(charts.faces, len(charts.uvs))
    tile = tiles.of_face(charts)
    corners = charts.uvs[charts.faces].astype(np.float64)
    for k in np.unique(label):
        assert len(set(tile[label == k])) == 1
    density = []
    for t in range(int(tile.max()) + 1):
        part, own = tiles.single_tile(mesh, charts, t)
        inside = own.uvs[own.faces]
        assert inside.min() >= padding / 2 and inside.max() <= 1 - padding / 2
        assert np.allclose(inside + [t, 0], corners[tile == t], atol=1e-6)
        assert raster.layers(raster.texel_corners(own, size), size).max() == 1
        flat = unwrap.signed_areas(own.uvs.astype(np.float64), own.faces)
        assert (flat > 0).all()
        density.append(flat.sum() / meshes.areas(part.vertices, part.faces).sum())
    return np.array(density)


@pytest.mark.parametrize("count", [2, 4])
def test_charts_fill_tiles_at_one_density(count: int) -> None:
    uvs, faces = random_charts(14)
    label = np.repeat(np.arange(14), 2)
    placed = packing.pack_tiles(uvs, faces, label, 0.01, count)
    assert placed is not None
    charts = Charts(placed, faces)
    flat = np.concatenate([uvs, np.zeros((len(uvs), 1))], 1).astype(np.float32)
    density = checked(Mesh(flat, flat, faces), charts, 0.01)
    assert len(density) == count and np.ptp(density) < 1e-4 * density.mean()
    assert unwrap.signed_areas(placed.astype(np.float64), faces).sum() > 0.5 * count
    one = packing.pack(uvs, faces, label, 0.01)
    assert one is not None
    gain = density.mean() / unwrap.signed_areas(one.astype(np.float64), faces).sum()
    assert gain * np.abs(unwrap.signed_areas(uvs, faces)).sum() > 0.8 * count


def test_one_tile_is_packed_as_ever() -> None:
    uvs, faces = random_charts(6)
    label = np.repeat(np.arange(6), 2)
    one, same = packing.pack(uvs, faces, label, 0.01), packing.pack_tiles(uvs, faces, label, 0.01, 1)
    assert one is not None and same is not None and one.tobytes() == same.tobytes()


def test_as_few_tiles_as_reach_the_scale() -> None:
    uvs, faces = random_charts(14)
    label = np.repeat(np.arange(14), 2)
    area = float(np.abs(unwrap.signed_areas(uvs, faces)).sum())
    for share, least in ((1.3, 2), (1.8, 3)):
        wanted = Tiling(10, float(np.sqrt(share / area)))
        placed = packed(uvs, faces, label, area, 0.01, wanted)
        assert placed is not None
        used = int(tiles.of_face(Charts(placed, faces)).max()) + 1
        assert wanted.least(area) <= used <= least + 1
        assert unwrap.signed_areas(placed.astype(np.float64), faces).sum() >= share * (1 - 1e-5)
        assert packing.pack_tiles(uvs, faces, label, 0.01, used - 1, wanted.scale) is None
    far = packed(uvs, faces, label, area, 0.01, Tiling(2, float(np.sqrt(9 / area))))  # more than there is room for
    assert far is not None and tiles.of_face(Charts(far, faces)).max() == 1


def test_a_mesh_is_laid_out_for_its_tiles(ball: Mesh) -> None:
    plain = Config(texture_size=512, padding=4)
    one = unwrap.unwrap(ball, plain)
    three = unwrap.unwrap(ball, plain.changed(tiles=3))
    density = checked(ball, three, 4 / 512)
    assert len(density) == 3 and np.ptp(density) < 1e-3 * density.mean()
    texel = footprint.texel(ball, one, 512)
    assert footprint.texel(ball, three, 512) < 0.75 * texel
    quality = measure(ball, three)
    assert len(quality.tile_utilisation) == 3 and quality.overlap == 0
    assert np.mean(quality.tile_utilisation) == pytest.approx(quality.utilisation)
    # texels that one tile has already: the same charts, to the last bit
    content = unwrap.unwrap(ball, plain.changed(tiles="auto", tile_size=512), texel=1.01 * texel)
    assert content.uvs.tobytes() == one.uvs.tobytes() and content.faces.tobytes() == one.faces.tobytes()
    finer = unwrap.unwrap(ball, plain.changed(tiles="auto", tile_size=512), texel=0.7 * texel)
    assert footprint.texel(ball, finer, 512) <= unwrap.COARSER * 0.7 * texel * (1 + 1e-4)
    assert 2 <= tiles.of_face(finer).max() + 1 <= 4


def test_texels_and_pixels_on_the_surface(ball: Mesh) -> None:
    square = Mesh(
        np.float32([[0, 0, 0], [0.3, 0, 0], [0.3, 0.3, 0], [0, 0.3, 0]]),
        np.tile(np.float32([0, 0, 1]), (4, 1)),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    charts = Charts(np.float32([[2.1, 0], [2.6, 0], [2.6, 0.5], [2.1, 0.5]]), square.faces)
    assert footprint.texel(square, charts, 100) == pytest.approx(0.3 / 50)
    # straight ahead from 0.6 m at 300 pixels: 2 mm; a camera behind sees nothing
    assert footprint.pixel(square, [camera(0.6, (0.15, 0.15))]) == pytest.approx(0.002, rel=0.05)
    assert footprint.pixel(square, [camera(0.6, (0.15, 0.15)), camera(0.3, (0.15, 0.15))]) == pytest.approx(
        0.001, rel=0.08
    )
    assert footprint.pixel(square, [camera(-0.6)]) is None and footprint.pixel(ball, []) is None


def camera(z: float, at: tuple[float, float] = (0.0, 0.0)) -> Camera:
    """Looks along -z."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = *at, z
    K = [[300, 0, 200], [0, 300, 200], [0, 0, 1]]
    return Camera(
        index=0, name="0", width=400, height=400, K=rows(np.array(K, float)), world_from_cam=rows(pose),
        distortion=(0, 0, 0, 0, 0),
    )  # fmt: skip


@pytest.mark.slow
def test_the_stage_counts_tiles_from_the_fitted_photos(ball: Mesh, tmp_path: Path) -> None:
    meshes.save(tmp_path / "surface.npz", ball)
    surface = Surface(
        mesh=FileRef.of(tmp_path, "surface.npz"), vertices=len(ball.vertices), faces=len(ball.faces), watertight=True,
        components=1, removed_components=0, cell=0.006,
    )  # fmt: skip
    held_out = camera(0.15).model_copy(update={"index": 1})  # three times as fine: must not count
    poses = CameraSet(
        source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.2,
        cameras=(camera(0.35), held_out),
    )  # fmt: skip
    face = FittedFace(
        field=FileRef.of(tmp_path, "surface.npz"), light=FileRef.of(tmp_path, "surface.npz"), rank=1, light_order=10,
        fitted_views=(0,), held_out=(), steps=1, loss=0, psnr=1, beta=1, cell=1, model={},
    )  # fmt: skip
    masks = Located(MaskSet(masks=()), tmp_path)
    rig = Located(face, tmp_path), Located(poses, tmp_path)
    inputs = Inputs(Located(surface, tmp_path), *rig, masks, no_head(tmp_path))
    out = run(inputs, Config(target_faces=1200, tile_size=256, tiles="auto"), Context(tmp_path, tmp_path))
    mesh, charts = meshes.load(tmp_path / out.mesh.path), meshes.load_charts(tmp_path / out.mesh.path)
    assert 1 < out.tiles == int(tiles.of_face(charts).max()) + 1 == len(out.tile_utilisation) <= 4
    pixel = footprint.pixel(ball, [camera(0.35)])
    assert pixel is not None and footprint.texel(mesh, charts, 256) <= pixel * unwrap.COARSER * 1.001
    assert out.warnings == ()


@pytest.mark.parametrize("bad", [0, 11, "many", 1.5])
def test_tiles_have_limits(bad: object) -> None:
    with pytest.raises(ValidationError):
        Config(tiles=bad)  # type: ignore[arg-type]
    assert Config(tiles="4").tiles == 4 and Config().tiles == 1  # type: ignore[arg-type]


def test_tiles_follow_the_size_that_is_baked() -> None:
    from stages.presets import configs_for

    for sets, wanted in (
        ({"bake": {"size": "4096"}}, 1024),
        ({"uv": {"tiles": "3"}, "bake": {"size": "4096"}}, 1024),
        ({"uv": {"tiles": "auto"}, "bake": {"size": "4096"}}, 4096),
        ({"uv": {"tiles": "auto", "tile_size": "512"}}, 512),
        ({"uv": {"tiles": "auto"}}, 2048),
    ):
        assert configs_for("studio", sets)["uv"].tile_size == wanted  # type: ignore[attr-defined]
