"""Surface that no photo saw, cut off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline import meshes
from pipeline.artifacts import FileRef, Located, MaskSet
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.images import write_png
from pipeline.meshes import F64, Indices, Mask, Mesh
from stages.surface import build as building
from stages.surface import trim
from stages.surface.stage import Config, Inputs, run
from tests.support.analytic_fields import AnalyticField, sphere
from tests.support.field_artifacts import fitted, poses

RADIUS, CELL = 0.1, 0.24 / 48


def quiet(done: int, total: int) -> None:
    """No progress shown."""


def seen_where(wanted: object) -> building.Built:
    """A ball of which photos see the vertices (V, 3) that `wanted` names."""

    def sees(mesh: Mesh) -> Mask:
        return np.asarray(wanted(mesh.vertices.astype(np.float64)))  # type: ignore[operator]

    return building.build(AnalyticField(sphere(RADIUS)), 48, quiet, sees)


def border_of(faces: Indices) -> tuple[Indices, int, Indices]:
    """Vertices on borders, how many loops these are, and their edges (E, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    e = meshes.edges(faces)
    count = int(faces.max()) + 1
    rim = e[~np.isin(e[:, 0] * count + e[:, 1], e[:, 1] * count + e[:, 0])]
    assert (np.bincount(rim.ravel())[np.unique(rim)] == 2).all()  # loops that never touch
    on = np.unique(rim)
    graph = coo_array((np.ones(len(rim)), tuple(np.searchsorted(on, rim).T)), shape=(len(on), len(on)))
    return on, connected_components(graph, directed=False)[0], rim


def latitude(points: F64) -> F64:
    return np.asarray(np.degrees(np.arcsin(points[:, 1] / np.linalg.norm(points, axis=1))))


def test_what_nobody_sees_is_cut_along_one_smooth_loop() -> None:
    built = seen_where(lambda p: latitude(p) > -30)
    assert built.topology.sound and not built.topology.watertight and built.topology.components == 1
    on, loops, rim = border_of(built.mesh.faces)
    assert loops == 1 and np.abs(latitude(built.mesh.vertices[on]) + 30).max() < 3.5  # about a cell
    assert np.allclose(np.linalg.norm(built.mesh.vertices, axis=1), RADIUS, atol=1e-5)
    assert built.trimmed == pytest.approx(0.25, abs=0.01)  # of a sphere: half of 1 - sin 30
    assert np.allclose(np.linalg.norm(built.mesh.normals, axis=1), 1, atol=1e-5)
    toward = built.mesh.normals[built.mesh.faces[:, 0]]
    assert ((meshes.area_vectors(built.mesh.vertices, built.mesh.faces) * toward).sum(1) > 0).all()
    a, b = built.mesh.vertices[rim].astype(np.float64).transpose(1, 0, 2)
    circle = 2 * np.pi * RADIUS * np.cos(np.radians(30))
    assert np.linalg.norm(a - b, axis=1).sum() < 1.1 * circle  # along the sides of whole triangles: 1.9


def test_specks_notches_and_islands_are_tidied() -> None:
    """Every tenth vertex wrong on either side, a narrow notch, an island and a hole of two degrees: as without them."""
    rng = np.random.default_rng(4)

    def wanted(p: F64) -> Mask:
        above = latitude(p) > -30
        notch = (np.abs(p[:, 0]) < 0.4 * CELL) & (p[:, 2] > 0) & (latitude(p) < 0)
        spots = np.abs(np.abs(latitude(p)) - 80) < 2
        return np.asarray((above & ~notch) ^ spots ^ (rng.random(len(p)) < 0.1))

    built = seen_where(wanted)
    on, loops, _ = border_of(built.mesh.faces)
    assert loops == 1 and built.topology.sound and built.topology.components == 1
    assert np.abs(latitude(built.mesh.vertices[on]) + 30).max() < 8
    assert built.trimmed == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("size, stays", [(4.5, False), (12.0, True)])
def test_small_holes_are_closed_and_small_islands_dropped(size: float, stays: bool) -> None:
    """Caps of 4.5 degrees have 0.15 % of a sphere's area, of 12 degrees 1.1 %."""
    mesh = building.build(AnalyticField(sphere(RADIUS)), 48, quiet).mesh
    at = latitude(mesh.vertices.astype(np.float64))
    plain = at > -30
    hole, island = at > 90 - size, at < size - 90
    got = trim._tidied(mesh, np.where((plain & ~hole) | island, 0.9, 0.2)) >= 0.5
    assert np.array_equal(got, (plain & ~hole) | island if stays else plain)


def test_two_seen_parts_stay() -> None:
    built = seen_where(lambda p: np.abs(latitude(p)) > 30)
    assert built.topology.components == 2 and built.topology.sound and border_of(built.mesh.faces)[1] == 2


@pytest.mark.parametrize("seed", range(4))
def test_any_cut_of_a_closed_mesh_is_a_manifold(seed: int) -> None:
    """Sides by lot: vertices that touch others of their side in single points only, the worst that there is."""
    mesh = building.build(AnalyticField(sphere(RADIUS)), 24, quiet).mesh
    s = np.random.default_rng(seed).random(len(mesh.vertices))
    ends, share, faces = trim.cut(mesh.faces, s)
    x = mesh.vertices.astype(np.float64)
    points = np.concatenate([x, x[ends[:, 0]] + share[:, None] * (x[ends[:, 1]] - x[ends[:, 0]])])
    found = meshes.topology(faces, len(points))
    assert found.sound and found.boundary_edges > 100
    kept = np.unique(faces)
    assert (s[kept[kept < len(s)]] >= 0.5).all() and np.isin(np.flatnonzero(s >= 0.5), kept).all()
    normal = x[mesh.faces].mean(1)
    assert ((meshes.area_vectors(x, mesh.faces) * normal).sum(1) > 0).all()
    assert ((meshes.area_vectors(points, faces) * points[faces].mean(1)).sum(1) > 0).all()


def test_the_cut_lies_where_a_linear_share_is_one_half() -> None:
    mesh = building.build(AnalyticField(sphere(RADIUS)), 24, quiet).mesh
    x = mesh.vertices.astype(np.float64)
    s = 0.5 + x[:, 1] + 0.3 * x[:, 0]
    ends, share, _ = trim.cut(mesh.faces, s)
    at = x[ends[:, 0]] + share[:, None] * (x[ends[:, 1]] - x[ends[:, 0]])
    free = (share > trim.MARGIN) & (share < 1 - trim.MARGIN)
    assert free.sum() > 20 and np.abs((at[:, 1] + 0.3 * at[:, 0])[free]).max() < 1e-9


def test_nothing_or_everything_seen() -> None:
    whole = seen_where(lambda p: np.ones(len(p), np.bool_))
    plain = building.build(AnalyticField(sphere(RADIUS)), 48, quiet)
    assert whole.topology.manifold and whole.trimmed == 0 and np.array_equal(whole.mesh.vertices, plain.mesh.vertices)
    with pytest.raises(StageError, match="no fitted photo sees"):
        seen_where(lambda p: np.zeros(len(p), np.bool_))


def test_the_stage_cuts_what_its_cameras_do_not_see(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two cameras at 0.6 m, in front and to the right: the ball's back and left go, unless asked to stay."""
    views = []
    for i in range(4):
        write_png(tmp_path / f"{i}.png", np.ones((64, 64)))
        ref = FileRef.of(tmp_path, f"{i}.png")
        views.append(CaptureView(index=i, name=f"{i}.png", image=ref, width=64, height=64, holdout=i > 1))
    face = fitted(tmp_path, AnalyticField(sphere(RADIUS)), monkeypatch)
    capture = Located(Capture(kind="facescape", views=tuple(views)), tmp_path)
    inputs = Inputs(face, poses(tmp_path), Located(MaskSet(masks=()), tmp_path), capture)
    kept = run(inputs, Config(resolution=48), Context(tmp_path / "a", tmp_path))
    cut = run(inputs, Config(resolution=48, unseen="trimmed"), Context(tmp_path / "b", tmp_path))
    assert kept.watertight and kept.trimmed == 0 and not cut.watertight and cut.components == 1
    x, _, z = meshes.load(tmp_path / "b" / cut.mesh.path).vertices.T
    horizon = RADIUS * RADIUS / 0.6
    assert ((x > horizon - 0.01) | (z > horizon - 0.01)).all() and 0.3 < cut.trimmed < 0.5
