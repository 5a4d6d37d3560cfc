"""The rim of hair and clothes, which goes on beneath the head's skin: where the parts meet no slit shows.

A part of the dense mesh ends where the skin stands for it. Hair or a collar that leaves the skin at a right angle would
end AWAY (remainder.py) above it, and decimation moves borders by a millimetre. So RIM of the dense mesh is added to the
part, and laid under the skin.

Symbols: p a vertex of the rim, r its distance from the nearest vertex of the part, q the nearest vertex of the skin
with normal n.

    p' = p - w (n . (p - q) + SINK) n,    w = min(r / FALL, 1)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import meshes
from pipeline.meshes import F64, Mask, Mesh
from stages.uv.remainder import AWAY

RIM = 0.008  # metres of the dense mesh that are added
FALL = 0.006  # metres over which the rim falls to its depth
SINK = 0.001  # metres below the skin: more than the decimated skin or rim is off
NEAR = 1.5 * AWAY  # what is further from the skin is not laid under it: a web behind an ear


@dataclass(frozen=True, slots=True)
class Rimmed:
    """The dense mesh with the rim in its place, and the faces (F,) of the part with its rim."""

    mesh: Mesh
    faces: Mask


def with_rim(dense: Mesh, part: Mask, skin: Mesh) -> Rimmed:
    """Add the rim to the faces part (F,) of the dense mesh, metres."""
    from scipy.spatial import cKDTree

    points: F64 = dense.vertices.astype(np.float64)
    own = np.zeros(len(points), np.bool_)
    own[dense.faces[part]] = True
    if not own.any():
        return Rimmed(dense, part)
    r = cKDTree(points[own]).query(points, distance_upper_bound=RIM)[0]
    away, nearest = cKDTree(skin.vertices.astype(np.float64)).query(points, distance_upper_bound=NEAR)
    rim = _reached(dense, own, np.isfinite(r) & np.isfinite(away) & ~own)
    q, n = (x[nearest[rim]].astype(np.float64) for x in (skin.vertices, skin.normals))
    height = ((points[rim] - q) * n).sum(1, keepdims=True)
    moved = points.copy()
    moved[rim] -= np.minimum(r[rim, None] / FALL, 1.0) * (height + SINK) * n
    faces = part | (own | rim)[dense.faces].all(1)
    return Rimmed(Mesh(moved.astype(np.float32), dense.normals, dense.faces), np.asarray(faces, np.bool_))


def _reached(dense: Mesh, own: Mask, near: Mask) -> Mask:
    """(V,) vertices of `near` (V,) that edges within it join to `own` (V,): not those of another sheet close by."""
    pairs = meshes.unique_edges(dense.faces)
    pairs = pairs[(own | near)[pairs].all(1)]
    found = own.copy()
    while True:
        new = np.concatenate([pairs[found[pairs[:, 0]], 1], pairs[found[pairs[:, 1]], 0]])
        new = new[~found[new]]
        if not len(new):
            return np.asarray(found & ~own, np.bool_)
        found[new] = True
