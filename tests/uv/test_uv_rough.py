"""Surfaces in shreds: charts that lie flat, all with texels, and findings that say how bad it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.shreds import shredded, with_worthless_faces

from pipeline import meshes, raster
from pipeline.artifacts import FileRef, Located, MaskSet, Surface
from pipeline.contract import Context
from pipeline.meshes import Charts, Mesh
from stages.surface.build import build as surface_build
from stages.uv import build as building
from stages.uv import decimate, rough, unwrap
from stages.uv.build import build
from stages.uv.chart_quality import Quality, measure
from stages.uv.decimate import Deviation
from stages.uv.judge import judge
from stages.uv.stage import Config, Inputs, run
from tests.support.analytic_fields import AnalyticField, bumpy_head, sphere
from tests.support.ball_head import no_head

GOOD = Quality(
    charts=7, fragments=0, utilisation=0.7, overlap=0.0, stretch=1.2, stretch_max=3.0, flipped=0.0, empty=0.0,
    seam_front=0.4, tile_utilisation=(0.7,),
)  # fmt: skip
NEAR = Deviation(1e-5, 2e-5)


def quiet(done: int, total: int, message: str = "") -> None:
    """No progress shown."""


def sound(mesh: Mesh, charts: Charts) -> Quality:
    """The figures, after what must hold of any charts."""
    q = measure(mesh, charts)
    assert np.isfinite(charts.uvs).all() and charts.uvs.min() >= 0 and charts.uvs.max() <= 1
    assert charts.faces.shape == mesh.faces.shape
    assert q.overlap < 2e-3 and q.empty < 1e-4 and q.flipped < 1e-3
    area = meshes.areas(mesh.vertices, mesh.faces)
    assert area[rough.short(mesh, charts)].sum() < 2e-3 * area.sum()
    return q


@pytest.mark.slow
@pytest.mark.parametrize("noise, most", [(0.5, 40), (1.5, 200)])
def test_a_surface_in_shreds_gets_few_charts_that_all_have_texels(noise: float, most: int) -> None:
    mesh = shredded(3, noise)
    q = sound(mesh, unwrap.unwrap(mesh, Config(texture_size=512, padding=4)))
    assert q.charts < most and q.fragments < 0.3 * most


@pytest.mark.slow
def test_thousands_of_loose_faces_stay_whole_and_are_judged() -> None:
    mesh = shredded(4, 2.0)
    q = sound(mesh, unwrap.unwrap(mesh, Config(texture_size=512, padding=4)))
    (charts,) = (f for f in judge(q, NEAR, 0.2, 0.0, 0.0, 0.0) if f.check == "charts")
    assert charts.level != "good" and charts.value == q.charts


@pytest.mark.slow
def test_faces_without_area_do_not_break_the_charts() -> None:
    """Slivers, faces whose corners are at one place, and whole flakes of no thickness."""
    mesh = with_worthless_faces(shredded(3, 0.2))
    area = meshes.areas(mesh.vertices, mesh.faces)
    assert (area == 0).sum() >= 10
    sound(mesh, unwrap.unwrap(mesh, Config(texture_size=512, padding=4)))


@pytest.mark.slow
def test_a_chart_that_collapsed_to_a_line_is_laid_flat_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a real run died of: st without area on a part of the surface."""
    mesh = surface_build(AnalyticField(sphere()), 16, quiet).mesh
    charts = unwrap.unwrap(mesh, Config(texture_size=512, padding=4))
    fallen = charts.uvs.copy()
    where = fallen[charts.faces[::40]].reshape(-1, 2)
    loose = np.concatenate([fallen, np.stack([where[:, 0], np.full(len(where), 0.5)], 1)])
    faces = charts.faces.copy()
    faces[::40] = len(fallen) + np.arange(len(where)).reshape(-1, 3)
    broken = Charts(loose.astype(np.float32), faces)
    assert measure(mesh, broken).empty > 0.01
    monkeypatch.setattr(unwrap, "unwrapped", lambda *_, **__: broken)
    sound(mesh, unwrap.unwrap(mesh, Config(texture_size=512, padding=4)))


def test_faces_smaller_than_a_tenth_of_a_square_millimetre_are_packed_too() -> None:
    """xatlas leaves out what is below 1e-7 in the given unit, and puts it anywhere."""
    rng = np.random.default_rng(2)
    corners = rng.uniform(0.2, 1.0, (400, 3, 2)) * 3e-4
    corners[:, 0], corners[:, 1, 1] = 0, 0
    faces = np.arange(1200, dtype=np.int32).reshape(-1, 3)
    uvs = unwrap.turned_over(corners.reshape(-1, 2), faces)
    assert np.abs(unwrap.signed_areas(uvs, faces)).max() < 1e-7
    charts = unwrap._packed(unwrap.spread(uvs, faces), faces, Config(texture_size=1024, padding=1))
    assert (unwrap.signed_areas(charts.uvs.astype(np.float64), charts.faces) > 0).all()
    assert (raster.layers(raster.texel_corners(charts, 2048), 2048) > 1).sum() == 0


@pytest.mark.slow
def test_good_charts_are_left_as_they_are() -> None:
    mesh = decimate.decimated(surface_build(AnalyticField(bumpy_head()), 48, quiet).mesh, 3000)
    charts = unwrap.unwrap(mesh, Config(texture_size=512, padding=4))
    assert unwrap._with_texels(charts, mesh, Config(texture_size=512, padding=4), unwrap.Tiling()) is charts


@pytest.mark.slow
def test_fragments_are_given_to_a_neighbour(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = shredded(3, 0.8)
    smooth = mesh.vertices.astype(np.float64)
    monkeypatch.setattr(rough, "FRAGMENT", 0.0)
    alone = rough.in_pieces(mesh, smooth)
    monkeypatch.setattr(rough, "FRAGMENT", 0.01)
    merged = rough.in_pieces(mesh, smooth)
    assert alone is not None and merged is not None
    assert merged[2].max() < alone[2].max()
    assert sorted(set(merged[2].tolist())) == list(range(int(merged[2].max()) + 1))


@pytest.mark.slow
def test_a_decimation_that_opens_the_mesh_is_handed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    dense = surface_build(AnalyticField(sphere()), 24, quiet).mesh
    simplified = decimate.simplified

    def torn(*given: object):
        v, f = simplified(*given)  # type: ignore[arg-type]
        far = np.setdiff1d(np.arange(len(f)), np.flatnonzero(np.isin(f, f[:1]).any(1)))
        return v, np.delete(f, far[:60], axis=0)  # a hole that is too wide to be filled

    monkeypatch.setattr(decimate, "simplified", torn)
    made = build(dense, Config(target_faces=800, proxy_faces=200, texture_size=256, padding=2), quiet)
    (opened,) = (f for f in made.findings if f.check == "opened")
    assert (
        opened.level != "good" and opened.value > 0 and meshes.topology(made.mesh.faces, len(made.mesh.vertices)).sound
    )


@pytest.mark.slow
def test_the_stage_hands_its_findings_on(tmp_path: Path) -> None:
    mesh = surface_build(AnalyticField(bumpy_head()), 48, quiet).mesh
    meshes.save(tmp_path / "surface.npz", mesh)
    artifact = Surface(
        mesh=FileRef.of(tmp_path, "surface.npz"), vertices=len(mesh.vertices), faces=len(mesh.faces), watertight=True,
        components=1, removed_components=0, cell=0.006,
    )  # fmt: skip
    masks = Located(MaskSet(masks=()), tmp_path)
    inputs = Inputs(Located(artifact, tmp_path), None, None, masks, no_head(tmp_path))  # type: ignore[arg-type]
    uv = run(inputs, Config(target_faces=3000, proxy_faces=300, texture_size=512), Context(tmp_path, tmp_path))
    assert len(uv.findings) == 10 and {f.level for f in uv.findings} == {"good"}, [str(f) for f in uv.findings]


@pytest.mark.parametrize(
    "check, ruin, level",
    [
        ("charts", {"charts": 64}, "usable"),
        ("charts", {"charts": 1052}, "unusable"),
        ("fragments", {"fragments": 50, "charts": 60}, "usable"),
        ("fragments", {"fragments": 506, "charts": 583}, "unusable"),
        ("fragments", {"fragments": 746, "charts": 833}, "unusable"),
        ("fragments", {"fragments": 3767, "charts": 3945}, "unusable"),
        ("overlap", {"overlap": 0.005}, "usable"),
        ("overlap", {"overlap": 0.05}, "unusable"),
        ("texels_missing", {"empty": 0.0061}, "unusable"),
        ("mirrored", {"flipped": 0.01}, "usable"),
        ("mirrored", {"flipped": 0.1}, "unusable"),
        ("stretch", {"stretched": 0.025}, "usable"),
        ("stretch", {"stretched": 0.3}, "unusable"),
        ("stretch", {"stretched": float("nan")}, "unusable"),
        ("face_share", {"face_share": 0.07}, "usable"),
    ],
)
def test_each_ruined_figure_has_its_level(check: str, ruin: dict[str, float], level: str) -> None:
    found = {f.check: f for f in judge(replace(GOOD, **ruin), NEAR, 0.3, 0.0, 0.0, 0.0)}  # type: ignore[arg-type]
    assert found[check].level == level and found[check].remedy


def test_the_face_has_its_share_where_it_is_known() -> None:
    def known(share: float | None) -> list[str]:
        found = judge(replace(GOOD, face_share=share), NEAR, 0.3, 0.0, 0.0, 0.0)
        return [f.level for f in found if f.check == "face_share"]

    assert known(None) == [] and known(0.41) == ["good"] and known(0.39) == ["usable"]


def test_distance_from_the_dense_mesh_is_judged() -> None:
    def levels(deviation: float, against: float, opened: float, crumpled: float = 0.0) -> dict[str, str]:
        found = judge(GOOD, Deviation(deviation, deviation), 0.3, against, opened, crumpled)
        return {f.check: f.level for f in found if f.level != "good"}

    assert levels(1e-4, 0, 0) == {}
    assert levels(5e-4, 0, 0) == {"deviation": "usable"}
    assert levels(5e-3, 0, 0) == {"deviation": "unusable"}
    assert levels(1e-5, 0.01, 0) == {"against_dense": "usable"}
    assert levels(1e-5, 0.2, 0) == {"against_dense": "unusable"}
    assert levels(1e-5, 0, 0.002) == {"opened": "usable"}
    assert levels(1e-5, 0, 0.2) == {"opened": "unusable"}
    assert levels(1e-5, 0, 0, 0.01) == {"crumpled": "usable"}
    assert levels(1e-5, 0, 0, 0.3) == {"crumpled": "unusable"}
    assert building.crumpled(shredded(3, 2.0)) > 0.02 and building.crumpled(shredded(2, 0)) == 0
    assert building._opened(meshes.topology(np.zeros((0, 3), np.int32), 0), shredded(1, 0)) == 0
