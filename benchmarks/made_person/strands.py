"""Hair of a made-up person: strands that grow from the scalp, fall, and lie on what is below them (decimetres)."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from benchmarks.hm08.regions import brow_share
from benchmarks.made_person.figure import Figure, Look
from pipeline.meshes import F64, Indices, triangles_of, unit

PARTING = 0.12  # from the middle
STEPS, STEP = 64, {"bob": 0.055, "long": 0.075}
WAVES = {"bob": 0.0175, "long": 0.05}
OFF, THICK = 0.03, 0.17  # off the skin: of the innermost strands, and how much more of the outermost
FACE = (0.66, 0.95, 7.85, 5.9)  # half width of the face, and z, upper and lower y of what hair keeps free
CLOUD = 400_000  # points of the skin
BROWS = 2500


def hair(figure: Figure, look: Look, rng: np.random.Generator) -> tuple[F64, Indices]:
    """Points (S, STEPS + 1, 3) of strands, root first, and (S,) the number of the last one that counts."""
    scalp = trimesh.Trimesh(figure.vertices, triangles_of(figure.scalp), process=False)
    roots, face = trimesh.sample.sample_surface(scalp, look.strands, seed=3)
    cloud = _cloud(figure)
    side = np.where(roots[:, 0] + rng.normal(size=len(roots)) * 0.04 > PARTING, 1.0, -1.0)
    layer = rng.uniform(0.02, 1, len(roots))
    end = look.end + rng.normal(size=len(roots)) * 0.06
    lock = np.round(roots * 6).sum(1) * 1.7
    at, strand = roots.copy(), [roots.copy()]
    way = unit(0.5 * scalp.face_normals[face] + np.stack([side * 0.5, 0 * side + 0.1, 0 * side - 0.25], 1))
    done, last = np.zeros(len(roots), bool), np.zeros(len(roots), np.int64)
    for k in range(STEPS):
        way = unit(_falling(way, at, k, lock, look.style))
        new = _pushed_out(at + STEP[look.style] * way, (OFF + THICK * layer) * min(1, 0.25 + k * 0.09), cloud)
        _keep_face_free(new, side)
        way = new - at
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        done |= new[:, 1] < end
        new[done] = at[done]
        last[~done] = k + 1
        at = new
        strand.append(at.copy())
    return np.stack(strand, 1), last


def _cloud(figure: Figure) -> tuple[cKDTree, F64, F64]:
    mesh = trimesh.Trimesh(figure.vertices, triangles_of(figure.skin), process=False)
    mesh.remove_unreferenced_vertices()
    points, face = trimesh.sample.sample_surface(mesh, CLOUD, seed=4)
    return cKDTree(points), points, mesh.face_normals[face]


def _falling(way: F64, at: F64, k: int, lock: F64, style: str) -> F64:
    down = min(1.0, 0.12 + 0.02 * k)
    sway = np.stack([np.sin(lock + k * 0.25), 0 * lock, np.cos(lock * 1.3 + k * 0.22)], 1)
    out = way * (1 - down) + down * np.array([0, -1.0, 0]) + WAVES[style] * sway
    if style == "bob":  # turned in at its end
        inward = np.stack([-at[:, 0] * 0.18, 0 * lock, -(at[:, 2] - 0.5) * 0.10], 1)
        out += inward * (at[:, 1:2] < 6.9)
    return out


def _pushed_out(points: F64, margin: F64, cloud: tuple[cKDTree, F64, F64]) -> F64:
    tree, on, normals = cloud
    for _ in range(2):
        away, nearest = tree.query(points, workers=-1)
        gap = ((points - on[nearest]) * normals[nearest]).sum(1)
        points = points + normals[nearest] * (np.clip(margin - gap, 0, 0.3) * (away < 0.8))[:, None]
    return points


def _keep_face_free(points: F64, side: F64) -> None:
    half, front, top, bottom = FACE
    x, y, z = points.T
    inside = (z > front) & (np.abs(x) < half) & (y < top) & (y > bottom)
    points[inside, 0] += (side[inside] * half - points[inside, 0]) * 0.5
    points[inside, 2] -= 0.03


def brows(figure: Figure, rng: np.random.Generator) -> F64:
    """Points (S, 5, 3) of the brows' hairs."""
    mesh = trimesh.Trimesh(figure.vertices, triangles_of(figure.brows), process=False)
    roots, _ = trimesh.sample.sample_surface(mesh, 60_000, seed=5)
    kept = rng.uniform(size=len(roots)) < 0.9 * brow_share(roots, figure.mean, figure.cut)
    roots = roots[kept][:BROWS]
    tree, _, normals = _cloud(figure)
    out = normals[tree.query(roots)[1]]
    side = np.sign(roots[:, 0])
    along = np.stack([side * 0.9, 0 * side + 0.25, 0 * side - 0.3], 1)
    return np.stack(
        [roots + 0.1 * t * along + out * (0.012 * np.sin(2.6 * t) + 0.004) for t in np.linspace(0, 1, 5)], 1
    )
