"""Hair of a capture: told on the scan, and taken out of what the registration follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from support import persons
from support.hairy import DARK, SKIN, hairy_head

from pipeline.meshes import Mesh
from pipeline.registration.hair import BENEATH
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.scan import Scan
from stages.template.hair import ToldHair, smooth, told_hair, under_hair

THICK = 0.015


@dataclass(frozen=True)
class Painted:
    """A field that is dark where the painted head has hair."""

    mesh: Mesh
    share: np.ndarray

    def material(self, points: np.ndarray) -> Any:
        from scipy.spatial import cKDTree

        row = cKDTree(self.mesh.vertices).query(points)[1]
        dark = self.share[row, None] > 0.5

        class Material:
            albedo = np.where(dark, DARK, SKIN).astype(np.float32)

        return Material()


def told(thickness: float, colour: np.ndarray | None = None) -> tuple[ToldHair, Scan, np.ndarray]:
    t = persons.template()
    mesh, share = hairy_head(thickness)
    landmarks = np.full((468, 3), np.nan)
    landmarks[t.landmarks.network] = t.landmark_points(t.vertices)
    known = np.isfinite(landmarks).all(1)
    landmarks[~known] = landmarks[known].mean(0)
    placed = PlacedHead(np.eye(4), np.zeros(0), t.vertices, np.zeros(0), 0.0)
    scan = Scan(mesh, np.full(len(mesh.vertices), 2.0))
    return told_hair(t, landmarks, placed, scan, Painted(mesh, share)), scan, share  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def hairy() -> tuple[ToldHair, Scan, np.ndarray]:
    return told(THICK)


def test_the_scan_under_hair_is_unseen(hairy: tuple[ToldHair, Scan, np.ndarray]) -> None:
    found, scan, share = hairy
    ears = persons.template().regions["ears"]
    assert len(ears) and not found.reason
    assert found.inside[share > 0.99].mean() > 0.97 and found.inside[share == 0].mean() < 0.03
    assert found.beneath.max() == pytest.approx(BENEATH) and (found.beneath[~found.inside] == 0).all()
    under = under_hair(scan, found)
    assert (under.seen[found.inside] == 0).all() and (under.seen[~found.inside] == 2).all()
    assert (found.inside & (found.beneath == 0)).any()  # the rim
    assert under.beneath is not None and under.mesh is scan.mesh


def test_its_figures(hairy: tuple[ToldHair, Scan, np.ndarray]) -> None:
    f = hairy[0].figures
    assert 3 < f["hair_rise_mm"] <= 1000 * THICK + 1 and f["hair_change"] > 30 and f["hair_seen"] == 1
    assert 250 < f["hair_cm2"] < 700


def test_without_hair_the_scan_stays_as_it_is() -> None:
    found, scan, _ = told(0.0)
    assert found.reason and not found.inside.any() and found.figures["hair_cm2"] == 0
    assert under_hair(scan, found) is scan


def test_the_border_has_no_steps() -> None:
    """Half of a plane in cells of 5 vertices, whose diagonal border becomes straighter; whole and none stay."""
    n = 60
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    points = np.stack([i.ravel(), j.ravel(), 0 * i.ravel()], 1).astype(np.float32)
    mesh = Mesh(points, np.tile(np.float32([0, 0, 1]), (n * n, 1)), faces)
    stairs, line = (i // 5 > j // 5).ravel(), (i >= j + 1).ravel()
    middle = ((i > 9) & (i < n - 10) & (j > 9) & (j < n - 10)).ravel()
    before, after = ((x != line)[middle].sum() for x in (stairs, smooth(mesh, stairs)))
    assert after < 0.5 * before
    every = np.ones(n * n, bool)
    assert smooth(mesh, every).all() and not smooth(mesh, ~every).any()
