"""Thinned meshes: which vertices are kept, and what the others take from them."""

from __future__ import annotations

import numpy as np
import pytest
from support.ball_head import RADIUS, ball_scan

from pipeline import thinning
from pipeline.lighting import standard
from pipeline.lighting.median_cut import lamps
from pipeline.maths.latlong import latlong_directions
from pipeline.meshes import edges


def test_small_meshes_are_kept_whole() -> None:
    mesh = ball_scan(RADIUS, 12)
    assert thinning.thinned(len(mesh.vertices), mesh.faces) is None
    assert thinning.thinned(len(mesh.vertices), mesh.faces, len(mesh.vertices)) is None


def test_no_two_are_neighbours_and_nobody_is_alone() -> None:
    mesh = ball_scan(RADIUS, 24)
    found = thinning.thinned(len(mesh.vertices), mesh.faces, 10)
    assert found is not None and 0.2 < found.chosen.mean() < 0.4
    a, b = edges(mesh.faces).T
    assert not (found.chosen[a] & found.chosen[b]).any()
    beside = found.chosen.copy()
    beside[a[found.chosen[b]]] = beside[b[found.chosen[a]]] = True
    assert beside.all()


def test_values_are_means_of_chosen_neighbours() -> None:
    mesh = ball_scan(RADIUS, 24)
    found = thinning.thinned(len(mesh.vertices), mesh.faces, 10)
    assert found is not None
    own = np.random.default_rng(5).normal(size=(int(found.chosen.sum()), 2, 3)).astype(np.float32)
    spread = found.spread(own)
    assert spread.shape == (len(mesh.vertices), 2, 3) and spread.dtype == np.float32
    np.testing.assert_array_equal(spread[found.chosen], own)
    row = np.cumsum(found.chosen) - 1
    a, b = np.concatenate([edges(mesh.faces), edges(mesh.faces)[:, ::-1]]).T
    for v in np.flatnonzero(~found.chosen)[::37]:
        near = np.unique(b[(a == v) & found.chosen[b]])
        np.testing.assert_allclose(spread[v], own[row[near]].mean(0), rtol=1e-5)
    np.testing.assert_allclose(found.spread(np.ones((len(own), 1), np.float32)), 1, rtol=1e-6)


def test_light_on_a_thinned_mesh_is_that_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ball above a ball, so that there are shadows and light from one to the other."""
    low, high = ball_scan(RADIUS, 32), ball_scan(0.5 * RADIUS, 24, (0.0, 1.7 * RADIUS, 0.0))
    vertices, normals = (np.concatenate([getattr(m, n) for m in (low, high)]) for n in ("vertices", "normals"))
    faces = np.concatenate([low.faces, high.faces + len(low.vertices)]).astype(np.int32)
    w = latlong_directions(32, 16)
    lit = lamps(np.repeat((0.2 + np.exp(4 * (w[..., 1:2] - 1))), 3, -1).astype(np.float32), 64)
    albedo = np.full((len(vertices), 3), 0.5)
    whole = standard.arrivals(vertices, normals, faces, lit, albedo)
    monkeypatch.setattr(thinning.thinned, "__defaults__", (10,))
    thin = standard.arrivals(vertices, normals, faces, lit, albedo)
    off = np.abs(thin.irradiance - whole.irradiance)
    assert off.mean() < 0.01 * whole.irradiance.mean() and np.quantile(off, 0.99) < 0.1 * whole.irradiance.mean()
    assert (whole.irradiance.min(0) < 0.7 * whole.irradiance.max(0)).all()
