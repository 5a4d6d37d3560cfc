"""A ball as a mesh with one chart: longitude and latitude."""

from __future__ import annotations

import numpy as np

from pipeline.meshes import Charts, Mesh


def ball_mesh(radius: float = 0.1, columns: int = 48, rows: int = 24) -> tuple[Mesh, Charts]:
    """The seam's vertices are doubled, the poles are one row each; faces point outward."""
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    turn, up = 2 * np.pi * u.ravel(), np.pi * (v.ravel() - 0.5)
    normals = np.stack([np.cos(up) * np.sin(turn), np.sin(up), np.cos(up) * np.cos(turn)], 1)
    at = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    corners = radius * normals[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces = faces[area > 1e-9]
    uvs = np.stack([0.02 + 0.96 * u.ravel(), 0.02 + 0.96 * v.ravel()], 1)
    mesh = Mesh((radius * normals).astype(np.float32), normals.astype(np.float32), faces)
    return mesh, Charts(uvs.astype(np.float32), faces)
