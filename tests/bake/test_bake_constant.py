"""A field of one material bakes to maps of one value, between the charts too, whatever the shape."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from pipeline.fields.protocol import F32, Material
from pipeline.meshes import Mesh
from stages.bake.build import build
from stages.bake.write import KINDS
from stages.uv import unwrap
from tests.support.analytic_fields import AnalyticField, Distance

MAJOR, MINOR = 0.07, 0.025


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
        n = len(points)
        one = np.ones(n, np.float32)
        albedo, c = np.tile(np.float32([0.4, 0.3, 0.2]), (n, 1)), np.tile(np.float32([0.5, 0.3, 0.1]), (n, 1))
        return Material(albedo, 0.3 * one, c, 0.1 * one)


SHAPES: dict[str, tuple[Distance, trimesh.Trimesh]] = {
    "torus": (torus, trimesh.creation.torus(MAJOR, MINOR, major_sections=24, minor_sections=12)),
    "thin plate": (plate, trimesh.creation.cylinder(0.07, 0.002, sections=48)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_one_material_gives_even_maps(name: str) -> None:
    distance, made = SHAPES[name]
    mesh = Mesh(*(np.asarray(a, np.float32) for a in (made.vertices, made.vertex_normals)), made.faces.astype(np.int32))
    charts = unwrap.unwrap(mesh, unwrap.Options(256, 2))
    twice = [build(EvenField(distance, cell=0.004), mesh, charts, (), 256, lambda *_: None) for _ in range(2)]
    for kind in ("albedo", "specular_coefficients", "specular_intensity", "shininess", "inv_kappa", "roughness", "f0"):
        images = [KINDS[kind].values(b.samples)[b.nearest] for b in twice]
        flat = images[0].reshape(256 * 256, -1)
        assert np.ptp(flat, axis=0).max() <= 2e-6 * np.abs(flat).max()
        assert images[0].tobytes() == images[1].tobytes()
    normal = KINDS["normal"].values(twice[0].samples)
    assert np.isfinite(normal).all() and np.allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    assert twice[0].samples.deviation() < 0.002  # facets of 15 degrees: r (1 - cos) is 0.6 mm
