"""A made-up reflectance field of a light stage: random coefficients on the mesh of an asset, as the stage writes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.artifacts import FileRef, Located
from pipeline.meshes import Charts, Mesh
from pipeline.reflectance_artifacts import ReflectanceField
from stages.reflectance.field import Field, save
from stages.reflectance.sidecar import write_sidecar
from stages.reflectance.texels import points_of

ALPHAS = (0.34, 0.17, 0.06)


def small_field(mesh: Mesh, charts: Charts, size: int = 64, lights: int = 7, order: int = 2, seed: int = 0) -> Field:
    """Every map is smooth over the surface, and each of its values matters under a lamp that is near the lights'."""
    points = points_of(mesh, charts, size)
    rng = np.random.default_rng(seed)
    wave = np.sin(points.position @ rng.normal(0, 40, (3, 24)) + rng.uniform(0, 6, 24)) / 2 + 0.5  # (T, 24) in 0 to 1

    def mixed(channels: int, low: float, high: float) -> np.ndarray:
        weights = rng.dirichlet(np.ones(24), channels).T
        return (low + (high - low) * (wave @ weights)).astype(np.float16).astype(np.float32)

    towards = rng.normal(size=(lights, 3)) * 0.4 + [0.3, 0.3, 1]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    normal = points.normal + mixed(3, -0.3, 0.3)
    arrays = {
        "albedo": mixed(3, 0.1, 0.9), "lobes": mixed(3, 0, 0.05),
        "normal": (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float16).astype(np.float32),
        "rest": mixed(3 * (order + 1) ** 2, -0.02, 0.06), "openpbr": mixed(5, 0, 0.5),
        "shadow": mixed(lights, -0.8, 0.4), "trust": mixed(lights, 0, 1),
        "coverage": np.ones((len(points.texel), 1), np.float32),
    }  # fmt: skip
    return Field(mesh, charts, points, arrays, ALPHAS, towards, np.array([0.01, 0.02, -0.01]))


def written_field(folder: Path, field: Field) -> Located[ReflectanceField]:
    """The artifact of a field."""
    save(field, folder / "reflectance", {"lights": list(range(len(field.towards)))}
         | write_sidecar(field, folder / "reflectance"))  # fmt: skip
    files = tuple(FileRef.of(folder, p) for p in sorted((folder / "reflectance").iterdir()))
    found = ReflectanceField(present=True, files=files, size=field.points.size, lights=len(field.towards),
                             alphas=field.alphas)  # fmt: skip
    return Located(found, folder)
