"""A ball as a head template: quads of a cube laid on a sphere, with regions like a head's, and scans of balls."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.artifacts import Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import Mesh, unit
from pipeline.reflectance_artifacts import ReflectanceField
from pipeline.template.model import Points, Template

RADIUS = 0.1


def ball_quads(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) unit vertices and (6 n^2, 4) quads, counter-clockwise from outside."""
    g = np.tan(np.linspace(-np.pi / 4, np.pi / 4, n + 1))
    a, b = np.meshgrid(g, g, indexing="ij")
    one = np.ones_like(a)
    sides = [(one, a, b), (-one, b, a), (b, one, a), (a, -one, b), (a, b, one), (b, a, -one)]
    points = np.concatenate([np.stack([c.ravel() for c in s], 1) for s in sides])
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    patch = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    quads = np.concatenate([patch + k * (n + 1) ** 2 for k in range(6)])
    _, first, inverse = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return unit(points[first]), inverse.ravel()[quads]


def ball_template(n: int = 8, scalp: bool = False) -> Template:
    """A ball of RADIUS metres whose region is face, above y = 0.06 scalp if asked for."""
    vertices, quads = ball_quads(n)
    vertices = RADIUS * vertices
    top = (vertices[quads].mean(1)[:, 1] > 0.06) & scalp
    regions = {"face": np.flatnonzero(~top), "scalp": np.flatnonzero(top)} if scalp else {"face": np.arange(len(quads))}
    uvs = (0.2 + 0.6 * np.random.default_rng(0).random((len(quads), 1, 2)) + 0.01 * np.array(
        [[0, 0], [1, 0], [1, 1], [0, 1]])).reshape(-1, 2)  # fmt: skip
    marks = np.linspace(0, len(quads) - 1, 12).astype(int)
    return Template(
        name="ball", licence="none", licence_text="", vertices=vertices, quads=quads,
        parts={"skin": np.arange(len(quads))},
        regions=regions, uvs=uvs, uv_quads=np.arange(4 * len(quads)).reshape(-1, 4),
        mirror=np.arange(len(vertices)),
        landmarks=Points(tuple(f"p{i}" for i in marks), np.arange(12), quads[marks, :3], np.full((12, 3), 1 / 3)),
        joints={}, shape=None, expressions=None,
    )  # fmt: skip


def ball_scan(radius: float, n: int = 40, centre: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    """A fine ball of triangles with exact normals."""
    unit_vertices, quads = ball_quads(n)
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)
    return Mesh((radius * unit_vertices + np.array(centre)).astype(np.float32), unit_vertices.astype(np.float32), faces)


def no_head(folder: Path) -> Located[RegisteredHead]:
    """The template stage's artifact of a capture without a face."""
    return Located(RegisteredHead(registered=False, reason="no face"), folder)


def no_field(folder: Path) -> Located[ReflectanceField]:
    """The reflectance stage's artifact of a capture that is no light stage's."""
    return Located(ReflectanceField(present=False), folder)
