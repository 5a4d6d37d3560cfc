"""Handles: counted by Euler's formula, found as loops that part nothing, and cut without harm elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline import meshes
from pipeline.meshes import F64, Faces, Indices
from stages.surface import handles
from stages.surface.build import Built, build
from tests.support.analytic_fields import AnalyticField, Distance, sphere, union


def quiet(done: int, total: int) -> None:
    """No progress shown."""


def torus(major: float, minor: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Distance:
    """A ring in the plane z = 0."""

    def distance(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = p - np.asarray(centre)
        around = np.linalg.norm(x[:, :2], axis=1)
        ring = np.concatenate([x[:, :2] * (1 - major / np.maximum(around, 1e-12))[:, None], x[:, 2:]], 1)
        length = np.linalg.norm(ring, axis=1)
        return length - minor, ring / np.maximum(length, 1e-12)[:, None]

    return distance


def jug() -> Distance:
    """A ball with a thin ear."""
    return union(sphere(0.08), torus(0.022, 0.006, (0.08, 0.0, 0.0)))


def marched(distance: Distance, handle: float, resolution: int = 64) -> Built:
    return build(AnalyticField(distance, (0.12, 0.12, 0.12)), resolution, quiet, handle=handle)


def parts_without(faces: Faces, loops: list[Indices]) -> int:
    """Pieces of the mesh when faces are no longer neighbours across the loops' edges."""
    barred = {frozenset(e) for loop in loops for e in zip(loop.tolist(), np.roll(loop, 1).tolist(), strict=True)}
    owner: dict[frozenset[int], int] = {}
    joined = []
    for i, (a, b, c) in enumerate(faces.tolist()):
        for edge in (frozenset((a, b)), frozenset((b, c)), frozenset((c, a))):
            if edge in barred:
                continue
            if edge in owner:
                joined.append((owner[edge], i))
            owner[edge] = i
    rows, columns = np.asarray(joined).T
    n = len(faces)
    return int(connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)))[0])


def test_a_thin_ear_is_cut_and_the_ball_stays_what_it_was() -> None:
    kept, cut = marched(jug(), 0), marched(jug(), 0.6)
    assert kept.topology.euler == 0 and kept.handles == (0, 1)
    assert cut.topology.euler == 2 and cut.topology.manifold and cut.handles == (1, 0)
    assert any("handle" in w for w in kept.warnings) and cut.warnings == ()
    ball = np.linalg.norm(kept.mesh.vertices + [0.02, 0, 0], axis=1) < 0.07
    assert ball.sum() > 1000
    assert np.array_equal(kept.mesh.vertices[ball], cut.mesh.vertices[: len(ball)][ball])
    assert np.array_equal(kept.mesh.normals[ball], cut.mesh.normals[: len(ball)][ball])
    new = cut.mesh.vertices[len(kept.mesh.vertices) :]
    assert len(new) and np.linalg.norm(new - [0.102, 0, 0], axis=1).max() < 0.04


def test_caps_look_outwards_and_close_the_solid() -> None:
    """Whichever loop was cut, at most the ear's volume goes and little comes: no ball turned inside out."""
    kept, cut = marched(jug(), 0), marched(jug(), 0.6)
    whole, left = (meshes.volume(m.mesh.vertices, m.mesh.faces) for m in (kept, cut))
    ear = 2 * np.pi**2 * 0.022 * 0.006**2
    assert whole - ear < left < whole + 0.1 * ear
    sides = meshes.unit(meshes.area_vectors(cut.mesh.vertices, cut.mesh.faces))
    mean = meshes.unit(cut.mesh.normals[cut.mesh.faces].mean(1))
    assert ((sides * mean).sum(1) > 0).mean() > 0.99
    assert np.allclose(np.linalg.norm(cut.mesh.normals, axis=1), 1, atol=1e-5)


def test_a_ring_is_what_the_scene_has_and_stays() -> None:
    got = marched(torus(0.07, 0.03), 0.1)
    assert got.topology.euler == 0 and got.handles == (0, 1)
    assert np.array_equal(got.mesh.faces, marched(torus(0.07, 0.03), 0).mesh.faces)


def test_loops_of_a_ring_are_as_long_as_they_must_be() -> None:
    """The two of a ring, from where both are short: around its tube, 2 pi r, and around its hole, 2 pi (R - r)."""
    mesh = marched(torus(0.07, 0.03), 0, 96).mesh
    vertices = mesh.vertices.astype(np.float64)
    inmost = int(np.linalg.norm(vertices[:, :2], axis=1).argmin())
    loops = handles.loops_from(handles.web(vertices, mesh.faces), inmost)
    lengths = [loop.length for loop in loops]
    assert len(loops) == 2 and lengths == sorted(lengths)
    for loop, least in zip(loops, (2 * np.pi * 0.03, 2 * np.pi * 0.04), strict=True):
        corners = vertices[loop.vertices]
        assert loop.length == pytest.approx(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum())
        assert 0.99 * least <= loop.length < 1.3 * least  # edges of a lattice run in steps


def pretzel(count: int) -> Distance:
    rings = [torus(0.02, 0.006, (0.037 * i - 0.0185 * (count - 1), 0.0, 0.0)) for i in range(count)]
    out = rings[0]
    for ring in rings[1:]:
        out = union(out, ring)
    return out


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.slow
def test_loops_part_nothing_and_run_along_edges(count: int) -> None:
    mesh = marched(pretzel(count), 0, 96).mesh
    vertices = mesh.vertices.astype(np.float64)
    loops = handles.loops_from(handles.web(vertices, mesh.faces), 0)
    assert len(loops) == 2 * count == 2 * handles.genus(mesh.faces, len(vertices))
    known = {frozenset(e) for e in meshes.edges(mesh.faces).tolist()}
    for found in loops:
        loop = found.vertices
        assert len(set(loop.tolist())) == len(loop) >= 3
        assert all(frozenset(e) in known for e in zip(loop.tolist(), np.roll(loop, 1).tolist(), strict=True))
        assert parts_without(mesh.faces, [loop]) == 1
    together = handles._chosen(vertices, mesh.faces, np.inf)
    assert len(together) > 1 and parts_without(mesh.faces, [loop.vertices for loop in together]) == 1
    tube = 2 * np.pi * 0.006
    assert together[0].length < 1.3 * tube  # however far from the root: another root was tried


def crumbled(seed: int) -> tuple[F64, Faces]:
    """Smooth noise cut at zero inside a ball, its largest piece: many handles of all widths."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(0, 70, (24, 3)), rng.uniform(0, 6.28, 24)

    def noisy(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = p @ waves.T + phases
        return 0.004 * np.cos(angle).sum(1), -0.004 * np.sin(angle) @ waves

    def both(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        (a, ga), (b, gb) = noisy(p), sphere(0.1)(p)
        return np.maximum(a, b), np.where((a > b)[:, None], ga, gb)

    got = marched(both, 0, 48)
    return got.mesh.vertices.astype(np.float64), got.mesh.faces


@pytest.mark.parametrize("seed", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in (1, 2, 3))])
def test_a_crumbled_mesh_becomes_a_sphere_in_the_topological_sense(seed: int) -> None:
    vertices, faces = crumbled(seed)
    before = handles.genus(faces, len(vertices))
    assert before >= 3
    got = handles.without_handles(vertices, faces, np.inf)
    now = meshes.topology(got.faces, len(got.vertices))
    assert now.manifold and now.components == 1 and now.euler == 2
    assert (got.cut, got.left) == (before, 0)
    still = np.ones(len(vertices), np.bool_)
    still[got.moved[got.moved < len(vertices)]] = False
    assert np.array_equal(got.vertices[: len(vertices)][still], vertices[still])
    assert np.isin(np.arange(len(vertices), len(got.vertices)), got.moved).all()
    again = handles.without_handles(vertices, faces, np.inf)
    assert np.array_equal(again.vertices, got.vertices) and np.array_equal(again.faces, got.faces)


def test_only_loops_within_the_limit_are_cut() -> None:
    vertices, faces = crumbled(1)
    limit = 0.12
    got = handles.without_handles(vertices, faces, limit)
    assert got.cut > 0 and got.left > 0 and got.cut + got.left == handles.genus(faces, len(vertices))
    assert handles.genus(got.faces, len(got.vertices)) == got.left
    assert meshes.topology(got.faces, len(got.vertices)).manifold


def test_a_closed_ball_is_handed_back_as_it_is() -> None:
    mesh = marched(sphere(0.1), 0, 24).mesh
    vertices = mesh.vertices.astype(np.float64)
    got = handles.without_handles(vertices, mesh.faces, np.inf)
    assert got.vertices is vertices and got.faces is mesh.faces and len(got.moved) == 0
