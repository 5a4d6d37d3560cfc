"""A whole registration of the project's own template: to a made-up surface of a head whose eyes are closed."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.meshes import Mesh, triangles_of, vertex_normals
from pipeline.registration.head import limit_surface
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.lids import GAP, blink, facing
from pipeline.registration.neck import OVERLAPPED, SUNK, from_border
from pipeline.registration.quality import outer_quads
from pipeline.registration.scan import Scan
from pipeline.registration.subdivision import subdivided
from pipeline.template.load import load_template
from stages.template.register import Registration, index_of, register

pytestmark = pytest.mark.slow

LEVELS = 1
TEMPLATE = load_template()
REGIONS = tuple(TEMPLATE.regions)
STRENGTH = 0.55


@pytest.fixture(scope="module")
def found() -> Registration:
    """The scan is the outside of the head with closed eyes, as photos show it: nothing between the lids."""
    closed = TEMPLATE.vertices + STRENGTH * blink(TEMPLATE)
    level = subdivided(TEMPLATE.quads, len(closed), 2)
    points, _, quads = limit_surface(closed, level)
    outside = outer_quads(index_of(TEMPLATE.regions, len(TEMPLATE.quads)), REGIONS)
    faces = triangles_of(quads[np.repeat(outside, 16)])
    used, rows = np.unique(faces, return_inverse=True)
    vertices, rows = points[used], rows.reshape(-1, 3).astype(np.int32)
    scan = Scan(Mesh(vertices.astype(np.float32), vertex_normals(vertices, rows), rows), np.ones(len(vertices)))
    landmarks = np.full((468, 3), np.nan)
    landmarks[TEMPLATE.landmarks.network] = TEMPLATE.landmark_points(closed)
    placed = PlacedHead(np.eye(4), np.zeros(0), TEMPLATE.vertices, np.zeros(0), 0.0)
    return register(TEMPLATE, landmarks, placed, scan, LEVELS, lambda *_: None)


def test_closed_lids_meet(found: Registration) -> None:
    apart = np.linalg.norm(facing(TEMPLATE) @ found.head.vertices, axis=1)
    assert found.closed and apart.max() < 2 * GAP and np.median(apart) < 1.1 * GAP


def test_the_necks_last_ring_lies_beneath_the_surface(found: Registration) -> None:
    level = subdivided(TEMPLATE.quads, len(TEMPLATE.vertices), LEVELS)
    away = level.stencil @ np.minimum(from_border(TEMPLATE), 1.0)
    ring = away < 0.5 * OVERLAPPED
    depth = -found.head.displacement[ring] / found.placed.scale
    assert ring.sum() > 40 and found.placed.scale == pytest.approx(1, abs=0.01)
    np.testing.assert_allclose(depth, SUNK, rtol=1e-5)
