"""Maps in several UDIM tiles: each tile baked by itself, all of them one surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline import meshes, raster, tiles
from pipeline.artifacts import FileRef, MaskSet, UvMesh, ViewMask
from pipeline.contract import Context
from pipeline.fields.protocol import F32, Material
from pipeline.images import read_encoded, read_exr, write_png
from pipeline.meshes import Charts, Mesh
from pipeline.visibility import Occluder
from stages.bake import detail, regions, statistics
from stages.bake.build import Baked, Baker
from stages.bake.confidence import sighted
from stages.bake.smaller import smaller
from stages.bake.stage import Config, Inputs, region_shares, run
from stages.bake.write import KINDS, joined, write_maps
from stages.uv import pack, unwrap
from stages.uv.config import Config as UvConfig
from tests.bake.test_bake_sight import VIEWS, labelled
from tests.bake.test_bake_stage import inputs  # noqa: F401  (a fixture)
from tests.support.analytic_fields import AnalyticField, linear_albedo, sphere

RADIUS, SIZE, COUNT = 0.08, 256, 3


class Even(AnalyticField):
    """One material everywhere."""

    def material(self, points: F32) -> Material:
        """See above."""
        return super().material(np.broadcast_to(np.float32([0.01, 0.02, 0.03]), points.shape))


def quiet(done: int, total: int, message: str = "") -> None:
    """No progress shown."""


@pytest.fixture(scope="module")
def ball() -> Mesh:
    made = trimesh.creation.icosphere(3, RADIUS)
    normals = (made.vertices / RADIUS).astype(np.float32)
    return Mesh(made.vertices.astype(np.float32), normals, made.faces.astype(np.int32))


@pytest.fixture(scope="module")
def charts(ball: Mesh) -> Charts:
    with pytest.MonkeyPatch.context() as patch:  # a coarser packing is quicker
        patch.setattr(pack, "G", 96)
        found = unwrap.unwrap(ball, UvConfig(texture_size=SIZE, padding=4, tiles=COUNT))
    assert int(tiles.of_face(found).max()) + 1 == COUNT
    return found


@pytest.fixture(scope="module")
def written(
    ball: Mesh, charts: Charts, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[Baked], dict[str, object]]:
    """Views from the front and from the back, of which the front one has labels."""
    folder = tmp_path_factory.mktemp("maps")
    views = (labelled(folder, 0, 2, 3), VIEWS[2])
    baker = Baker(AnalyticField(sphere(RADIUS)), ball, charts, views, SIZE, quiet)
    assert baker.tiles == COUNT
    baked = [baker.tile(t) for t in range(COUNT)]
    context = Context(folder, folder)
    parts = [write_maps(b, context, t, COUNT) for t, b in enumerate(baked)]
    return folder, baked, joined(parts, [b.statistics.texels for b in baked], context)  # type: ignore[return-value]


def test_one_material_is_even_over_all_tiles_and_their_gutters(ball: Mesh, charts: Charts) -> None:
    baker = Baker(Even(sphere(RADIUS)), ball, charts, (), SIZE, quiet)
    baked = [baker.tile(t) for t in range(COUNT)]
    for name in ("albedo", "inv_kappa", "specular_coefficients", "roughness", "f0", "irradiance_ratio"):
        values = np.stack([KINDS[name].values(b.samples)[b.nearest] for b in baked])
        flat = values.reshape(COUNT * SIZE * SIZE, -1)
        assert np.ptp(flat, axis=0).max() <= 2e-6 * np.abs(flat).max(), name


def test_every_tile_holds_its_part_of_the_surface(
    ball: Mesh, charts: Charts, written: tuple[Path, list[Baked], dict[str, object]]
) -> None:
    for t in range(COUNT):
        mesh, own = tiles.single_tile(ball, charts, t)
        hits = raster.rasterise(raster.texel_corners(own, SIZE), SIZE, 0, SIZE)
        x = (mesh.vertices[mesh.faces[hits.face]] * hits.weights[..., None]).sum(1).astype(np.float64)
        x *= RADIUS / np.linalg.norm(x, axis=1, keepdims=True)
        image = read_exr(written[0] / f"textures/albedo.{1001 + t}.exr")[0].reshape(-1, 3)[hits.texel]
        seen = np.abs(x[:, 2]) > 0.045  # else no view sees it well, and the albedo follows what is around
        assert np.abs(image[seen] - linear_albedo(x[seen])).max() < 2e-3


def test_files_and_figures_of_all_tiles(written: tuple[Path, list[Baked], dict[str, object]]) -> None:
    folder, baked, maps = written
    assert "clamped" not in maps and not list(folder.glob("textures/clamped*"))
    kinds = {f"{1001 + t}.{k}" for t in range(COUNT) for k in ("exr", "png")}
    for name, found in maps.items():
        files = found.files  # type: ignore[attr-defined]
        assert set(files) in ({"exr"}, kinds, {k for k in kinds if k.endswith("exr")})
        assert (set(files) == {"exr"}) == (name == "basis_lut")
        assert all(ref.path == f"textures/{name}.{kind}" for kind, ref in files.items())
    covered = [b.covered() for b in baked]
    albedo = [read_exr(folder / f"textures/albedo.{1001 + t}.exr")[0] for t in range(COUNT)]
    inside = np.concatenate([a[c] for a, c in zip(albedo, covered, strict=True)])
    assert maps["albedo"].mean == pytest.approx(float(inside.mean()), rel=1e-5)  # type: ignore[attr-defined]
    assert maps["albedo"].maximum == pytest.approx(float(inside.max()), rel=2**-11)  # type: ignore[attr-defined]
    coverage = [read_encoded(folder / f"textures/coverage.{1001 + t}.png") for t in range(COUNT)]
    assert maps["coverage"].mean == pytest.approx(np.mean(coverage) / 255, abs=2e-3)  # type: ignore[attr-defined]
    whole = statistics.together([b.statistics for b in baked])
    assert whole.coverage == pytest.approx(np.mean(covered))
    unseen = np.concatenate([b.samples.unseen for b in baked]) > 0.5
    assert whole.figures(detail=False)["unseen"] == pytest.approx(float(unseen.mean()), abs=1e-6)
    moved = np.concatenate([b.samples.displacement[b.samples.landed] for b in baked]).astype(np.float64)
    assert whole.deviation == pytest.approx(np.sqrt((moved**2).mean()))


def test_regions_and_their_shares_of_the_surface(
    ball: Mesh, written: tuple[Path, list[Baked], dict[str, object]]
) -> None:
    """The front view at 0.6 m labels what it sees of the ball, its cap of z > 0.0107: half of it 2, half 3."""
    folder, baked, maps = written
    assert maps["region"].maximum == 3  # type: ignore[attr-defined]
    values = {int(v) for t in range(COUNT) for v in np.unique(read_exr(folder / f"textures/region.{1001 + t}.exr")[0])}
    assert values == {0, 2, 3}
    areas = {code: sum(b.regions.get(code, 0) for b in baked) for code in (0, 2, 3)}
    assert sum(areas.values()) == pytest.approx(meshes.areas(ball.vertices, ball.faces).sum())
    shares = region_shares(areas, ("background", "subject", "face"))
    assert list(shares) == ["unlabelled", "face", "3"]
    cap = 0.5 * (1 - RADIUS / 0.6)
    assert shares["face"] == pytest.approx(cap / 2, abs=0.02) and shares["3"] == pytest.approx(cap / 2, abs=0.02)
    assert shares["unlabelled"] == pytest.approx(1 - cap, abs=0.02) and region_shares({}, ()) == {}
    assert regions.areas(ball, Charts(np.zeros((3, 2), np.float32), ball.faces * 0), None) == {
        0: pytest.approx(meshes.areas(ball.vertices, ball.faces).sum())
    }


def test_a_tile_is_hidden_by_what_lies_in_another(ball: Mesh, charts: Charts) -> None:
    part, own = tiles.single_tile(ball, charts, 0)
    wall = np.float32([[-0.1, -0.1, 0.1], [0.1, -0.1, 0.1], [0.1, 0.1, 0.1], [-0.1, 0.1, 0.1]])
    both = Occluder(
        Mesh(
            np.concatenate([ball.vertices, wall]),
            np.concatenate([ball.normals, np.tile(np.float32([0, 0, 1]), (4, 1))]),
            np.concatenate([ball.faces, len(ball.vertices) + np.int32([[0, 1, 2], [0, 2, 3]])]),
        )
    )
    for t in range(COUNT):
        part, own = tiles.single_tile(ball, charts, t)
        assert sighted(part, own, VIEWS[:1], 64, quiet, both).confidence.max() == 0
    assert any(
        sighted(*tiles.single_tile(ball, charts, t), VIEWS[:1], 64, quiet, Occluder(ball)).confidence.max() > 0.4
        for t in range(COUNT)
    )


def test_points_of_several_tiles_are_put_together() -> None:
    rng = np.random.default_rng(0)
    corner = np.zeros((4, 3), np.int32)
    parts = [
        detail.Points(rng.random((4, 3)), rng.random((4, 3)), corner + i, *rng.random((3, 4, 3)).astype(np.float32))
        for i in range(2)
    ]
    both = detail.joined(parts)
    assert np.array_equal(both.x, np.concatenate([p.x for p in parts])) and both.corner[-1, 0] == 1
    assert detail.joined(parts[:1]) is parts[0]


@pytest.mark.slow
def test_the_stage_bakes_every_tile_with_the_photos_detail(
    inputs: Inputs,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pack, "G", 96)
    mesh = meshes.load(inputs.uv.path(inputs.uv.artifact.mesh))
    charts = unwrap.unwrap(mesh, UvConfig(texture_size=256, padding=2, tiles=2))
    meshes.save(tmp_path / "uv.npz", mesh, charts)
    uv = UvMesh.model_validate(inputs.uv.artifact.model_dump() | {"mesh": FileRef.of(tmp_path, "uv.npz"), "tiles": 2})
    write_png(tmp_path / "labels.png", np.full((64, 64), 2 / 255))
    mask = ViewMask(
        index=1, mask=inputs.masks.artifact.masks[0].mask, source="given", coverage=1.0,
        labels=FileRef.of(tmp_path, "labels.png"), labelled=("face",),
    )  # fmt: skip
    masks = MaskSet(masks=(mask,), label_names=("background", "subject", "face"))
    given = replace(inputs, uv=replace(inputs.uv, artifact=uv), masks=replace(inputs.masks, artifact=masks))
    made = run(given, Config(size=256), Context(tmp_path / "out", tmp_path))
    assert made.tiles == 2 and 0.2 < made.coverage < 0.8 and "detail_support" in made.figures
    assert made.figures["texel_mm"] > 0 and made.figures["photo_pixel_mm"] > 0
    assert set(made.regions) == {"unlabelled", "face"} and sum(made.regions.values()) == pytest.approx(1, abs=1e-5)
    assert {p.name for p in (tmp_path / "out/textures").glob("albedo*")} == {
        f"albedo.{n}.{k}" for n in (1001, 1002) for k in ("exr", "png")
    }


# ------------------------------------------------------------------ tiles of different sizes
def test_a_smaller_tile_has_the_means_of_its_texels(written: tuple) -> None:
    baked = written[1][1]
    half = smaller(baked, 2)
    assert half.size == SIZE // 2 and half.statistics is baked.statistics and smaller(baked, 1) is baked
    row, column = np.divmod(baked.texel, SIZE)
    assert set(half.texel.tolist()) == set((row // 2 * half.size + column // 2).tolist())
    for i in (0, len(half.texel) // 2, len(half.texel) - 1):
        own = (row // 2 == half.texel[i] // half.size) & (column // 2 == half.texel[i] % half.size)
        assert half.samples.albedo[i] == pytest.approx(baked.samples.albedo[own].mean(0), rel=1e-5)
        assert half.samples.rho[i] == pytest.approx(baked.samples.rho[own].mean(), rel=1e-5)
    assert np.linalg.norm(half.samples.normal, axis=1) == pytest.approx(1, abs=1e-5)
    assert half.samples.landed.dtype == np.bool_
    assert half.nearest.shape == (half.size, half.size)
    assert np.array_equal(half.nearest.ravel()[half.texel], np.arange(len(half.texel)))


def test_tiles_of_different_sizes_stand_side_by_side() -> None:
    large, small = np.zeros((8, 8, 3), np.float32), np.arange(16, dtype=np.float32).reshape(4, 4, 1).repeat(3, 2)
    both = tiles.side_by_side([large, small])
    assert both.shape == (8, 16, 3) and not both[:, :8].any()
    assert both[1:3, 9:11, 0].mean() == pytest.approx(small[:2, :2, 0].mean()) and both[0, 8, 0] == 0
    codes = tiles.side_by_side([large[..., :1], small[..., :1]], whole=True)
    assert np.array_equal(codes[:, 8:, 0], small[..., 0].repeat(2, 0).repeat(2, 1))
    assert tiles.side_by_side([small]) is small
