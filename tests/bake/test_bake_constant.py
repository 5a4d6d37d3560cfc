"""The chain on simple bodies: valid charts, and from one material maps of one value, between the charts too."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from pipeline.fields.protocol import F32, Material
from pipeline.meshes import Charts, Mesh
from stages.bake.build import Baker
from stages.bake.write import KINDS
from stages.uv import chart_quality, unwrap
from stages.uv.config import Config
from tests.support.analytic_fields import AnalyticField, Distance, sphere, union

MAJOR, MINOR = 0.07, 0.025
SIZE = 256
APART = (0.06, 0.0, 0.0)


def torus(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact distance to a torus around z."""
    ring = np.hypot(p[:, 0], p[:, 1])
    toward = np.stack([p[:, 0], p[:, 1], np.zeros(len(p))], 1) / np.maximum(ring, 1e-9)[:, None]
    offset = p - MAJOR * toward
    length = np.linalg.norm(offset, axis=1)
    return length - MINOR, offset / np.maximum(length, 1e-9)[:, None]


def plate(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The thin round plate |z| < 1 mm, r < 70 mm, by its nearest face."""
    ring = np.hypot(p[:, 0], p[:, 1])
    flat, rim = np.abs(p[:, 2]) - 0.001, ring - 0.07
    side = np.stack([p[:, 0], p[:, 1], np.zeros(len(p))], 1) / np.maximum(ring, 1e-9)[:, None]
    up = np.stack([np.zeros(len(p)), np.zeros(len(p)), np.sign(p[:, 2])], 1)
    return np.maximum(flat, rim), np.where((flat > rim)[:, None], up, side)


class EvenField(AnalyticField):
    """One material everywhere."""

    def material(self, points: F32) -> Material:
        """The same for all."""
        n = len(points)
        one = np.ones(n, np.float32)
        albedo, c = np.tile(np.float32([0.4, 0.3, 0.2]), (n, 1)), np.tile(np.float32([0.5, 0.3, 0.1]), (n, 1))
        return Material(albedo, 0.3 * one, c, 0.1 * one)


def ball(centre: tuple[float, float, float] = (0.0, 0.0, 0.0), radius: float = 0.08, finer: int = 3) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(finer, radius).apply_translation(centre)


def noisy() -> trimesh.Trimesh:
    """A ball whose vertices are off by a twentieth of an edge."""
    made = ball(finer=2)
    made.vertices += 0.0012 * np.random.default_rng(6).standard_normal(made.vertices.shape)
    return made


def two_balls() -> trimesh.Trimesh:
    other = (-APART[0], *APART[1:])
    return trimesh.util.concatenate([ball(APART, 0.04), ball(other, 0.03)])


SHAPES: dict[str, tuple[Distance, Callable[[], trimesh.Trimesh]]] = {
    "sphere": (sphere(0.08), ball),
    "torus": (torus, lambda: trimesh.creation.torus(MAJOR, MINOR, major_sections=24, minor_sections=12)),
    "two parts": (union(sphere(0.04, APART), sphere(0.03, (-APART[0], 0.0, 0.0))), two_balls),
    "thin plate": (plate, lambda: trimesh.creation.cylinder(0.07, 0.002, sections=48)),
    "noisy": (sphere(0.08), noisy),
}


def unwrapped(name: str) -> tuple[AnalyticField, Mesh, Charts]:
    distance, make = SHAPES[name]
    made = make()
    mesh = Mesh(*(np.asarray(a, np.float32) for a in (made.vertices, made.vertex_normals)), made.faces.astype(np.int32))
    return EvenField(distance, cell=0.004), mesh, unwrap.unwrap(mesh, Config(texture_size=SIZE, padding=2))


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_one_material_gives_even_maps(name: str) -> None:
    field, mesh, charts = unwrapped(name)
    again = unwrapped(name)[2]
    assert charts.uvs.tobytes() == again.uvs.tobytes() and charts.faces.tobytes() == again.faces.tobytes()
    assert np.isfinite(charts.uvs).all() and charts.uvs.min() >= 0 and charts.uvs.max() <= 1
    assert (unwrap.signed_areas(charts.uvs.astype(np.float64), charts.faces) > 0).all()  # none empty, none flipped
    assert chart_quality.measure(mesh, charts).overlap == 0
    twice = [Baker(field, mesh, charts, (), SIZE, lambda *_: None).tile(0) for _ in range(2)]
    for kind in KINDS:
        images = [KINDS[kind].values(b.samples)[b.nearest] for b in twice]
        assert images[0].tobytes() == images[1].tobytes()
        if kind in ("normal", "displacement", "ambient_occlusion", "curvature", "cavity", "thickness", "measured"):
            continue
        flat = images[0].reshape(SIZE * SIZE, -1)
        assert np.ptp(flat, axis=0).max() <= 2e-6 * np.abs(flat).max()
    normal = KINDS["normal"].values(twice[0].samples)
    assert np.isfinite(normal).all() and np.allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    assert twice[0].statistics.deviation < 0.002  # facets of 15 degrees: r (1 - cos) is 0.6 mm
