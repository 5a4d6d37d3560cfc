"""The tangent frame against MikkTSpace's rules, written down once more: corner by corner, in plain loops.

Rules [Mikkelsen 2008, Simulation of wrinkled surfaces revisited, section 4; mikktspace.h]: corners are one where
position, normal and texture coordinate are; triangles around such a corner form a group if they are joined by edges
there and wind the same way in the texture; each gives its direction of growing u, projected onto the plane of the
normal and normalised, weighted by its angle as seen in that plane.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import trimesh

from pipeline import tangents
from pipeline.meshes import Charts, Mesh

Corner = tuple[float, ...]


def bent_patch() -> tuple[Mesh, Charts]:
    """A wavy sheet of 6 x 6 cells: half of its texture is mirrored, with a seam in between, and unevenly stretched."""
    n = 7
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n)))
    surface = np.stack([x, y, 0.2 * np.sin(3 * x) * np.cos(4 * y)], 1)
    cell = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (cell[:-1, :-1], cell[:-1, 1:], cell[1:, 1:], cell[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    normals = trimesh.Trimesh(surface, faces, process=False).vertex_normals
    left = x[faces].mean(1) < 0.5
    u = np.where(left[:, None], 0.45 - 0.6 * x[faces] ** 2, 0.5 + 0.5 * (x[faces] - 0.5))
    uv = np.stack([u, 0.1 + 0.7 * y[faces] + 0.1 * x[faces]], -1).astype(np.float32)
    values, index = np.unique(uv.reshape(-1, 2), axis=0, return_inverse=True)
    mesh = Mesh(surface.astype(np.float32), normals.astype(np.float32), faces)
    return mesh, Charts(values, index.reshape(-1, 3).astype(np.int32))


def reference(mesh: Mesh, charts: Charts) -> np.ndarray:
    """(F, 3, 3) tangents at all corners."""
    x, n, t = (np.asarray(a, np.float64) for a in (mesh.vertices, mesh.normals, charts.uvs))
    key: dict[tuple[int, int], Corner] = {}
    around: dict[Corner, list[tuple[int, int]]] = defaultdict(list)
    for f in range(len(mesh.faces)):
        for i in range(3):
            key[f, i] = (*x[mesh.faces[f, i]], *n[mesh.faces[f, i]], *t[charts.faces[f, i]])
            around[key[f, i]].append((f, i))
    share, winds = {}, {}
    for f, i in key:
        p, q, r = (x[mesh.faces[f, (i + k) % 3]] for k in range(3))
        (u0, v0), (u1, v1), (u2, v2) = (t[charts.faces[f, (i + k) % 3]] for k in range(3))
        area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
        along = ((v2 - v0) * (q - p) - (v1 - v0) * (r - p)) / area
        normal = n[mesh.faces[f, i]]

        def flat(w: np.ndarray, normal: np.ndarray = normal) -> np.ndarray:
            w = w - normal * (normal @ w)
            return w / np.sqrt(w @ w)

        angle = np.arccos(np.clip(flat(q - p) @ flat(r - p), -1, 1))
        share[f, i], winds[f] = angle * flat(along), area > 0
    out = np.zeros((len(mesh.faces), 3, 3))
    for corners in around.values():
        left = set(corners)
        while left:
            group, todo = [], [left.pop()]
            while todo:
                f, i = todo.pop()
                group.append((f, i))
                sides = {key[f, (i + 1) % 3], key[f, (i + 2) % 3]}
                near = {
                    (g, j) for g, j in left
                    if winds[g] == winds[f] and sides & {key[g, (j + 1) % 3], key[g, (j + 2) % 3]}
                }  # fmt: skip
                left -= near
                todo += near
            total = np.sum([share[c] for c in group], 0)
            for f, i in group:
                out[f, i] = total / np.sqrt(total @ total)
    return out


def test_tangents_are_those_of_mikktspace() -> None:
    mesh, charts = bent_patch()
    frame = tangents.frames(mesh, charts)
    assert {-1.0, 1.0} == set(frame.sign.tolist())
    assert np.abs(frame.tangent - reference(mesh, charts)).max() < 1e-5
