"""A closed mouth: what keeps the template's lips together, so that no slit opens between them.

Photos show closed lips as one surface, which says nothing about where they touch; what pulls both lips outwards then
parts them, and rays pass into the mouth. Symbols: u a vertex of the upper lip where the lips of the template touch, l1
and l2 the vertices of the lower lip beside it, a its place between them from left to right; B the stencil of limit
points; p the rest; y up.

    B (x_u - (a x_l1 + (1 - a) x_l2)) = the same of p, but for its part along y, which is GAP at most

Held firmly, the lips stay beside each other, so that data that press them together do not take one through the other.
`meeting` closes what is left between them.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from pipeline.meshes import F64, Indices, triangles_of
from pipeline.meshes import unit as unit_normals
from pipeline.ray_casting import RayCaster
from pipeline.registration.cage import Cage
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.subdivision import limit
from pipeline.template.model import Template

LIPS, INSIDE, OPENS = "lips", "mouth_inside", "jawOpen"
INNER = (13, 14)  # the network's landmarks in the middle of the upper and the lower lip's inner edge
CLOSED = 0.0025  # metres of the template between them: more is an open mouth
RING = 1  # of vertices from the border with the mouth's inside: where closed lips touch
LOWER = 0.25  # of the largest drop in `jawOpen`: what drops by more belongs to the lower lip
SLIT = 0.0015  # metres of the template: wider is no slit of closed lips
SHARE, MEETINGS = 0.4, 3  # of the way that each lip goes in a round, and rounds: they don't pass through each other
FACING = 0.5  # cosine
GAP = 1e-4  # metres of the template


def lips_closed(template: Template, landmarks: F64, unit: float) -> bool:
    """Whether the photos' landmarks (468, 3) show a closed mouth; False if the template has no mouth. unit: world units
    per metre of the template."""
    upper, lower = landmarks[list(INNER)]
    apart = float(np.linalg.norm(upper - lower))
    return bool(_has_mouth(template) and np.isfinite(apart) and apart < CLOSED * unit)


def closing_lips(template: Template, placed: PlacedHead, cage: Cage, rest: F64) -> tuple[csr_array, F64]:
    """Stencil (n, V) over the cage and the places (n, 3) of what joins its lips. rest (V, 3): of the cage."""
    row = np.full(len(template.vertices), -1, np.int64)
    row[cage.of_template] = np.arange(len(cage.of_template))
    ends = [(row[u], row[low], share) for u, low, share in _facing(template)]
    if not ends:
        return csr_array((0, len(rest))), np.zeros((0, 3))
    at = np.repeat(np.arange(len(ends)), 3)
    column = np.array([[u, *low] for u, low, _ in ends]).ravel()
    value = np.array([[1.0, -a, a - 1.0] for _, _, a in ends]).ravel()
    difference = csr_array((value, (at, column)), shape=(len(ends), len(rest)))
    stencil = csr_array(difference @ limit(cage.quads, len(rest)).point)
    up = placed.world_from_template[:3, 1]
    apart = np.asarray(stencil @ rest)
    high = apart @ up / (up @ up)  # in metres of the template
    return stencil, apart + (np.minimum(GAP, high) - high)[:, None] * up


def _facing(template: Template) -> list[tuple[int, Indices, float]]:
    """Of each vertex of the upper lip in the ring: itself, the two of the lower lip beside it, and the first one's
    share."""
    ring = touching(template)
    drop = -template.expression(OPENS)[:, 1]
    lower = ring[drop[ring] > LOWER * drop.max()]
    lower = lower[np.argsort(template.vertices[lower, 0], kind="stable")]
    at, out = template.vertices[lower, 0], []
    for u in np.setdiff1d(ring, lower):
        x = template.vertices[u, 0]
        k = int(np.searchsorted(at, x))
        if 0 < k < len(at):  # beside the corners nothing faces it
            out.append((int(u), lower[k - 1 : k + 1], float((at[k] - x) / max(at[k] - at[k - 1], 1e-9))))
    return out


def touching(template: Template) -> Indices:
    """(n,) vertices of both lips in the ring where they touch."""
    lips, inside = (template.quads[template.regions[n]] for n in (LIPS, INSIDE))
    ring = done = np.intersect1d(lips, inside)
    for _ in range(RING):
        at = np.isin(lips, ring)
        beside = np.concatenate([lips[np.roll(at, turn, axis=1)] for turn in (1, -1)])
        ring = np.setdiff1d(beside, done)
        done = np.union1d(done, ring)
    return np.asarray(ring, np.int64)


def _has_mouth(template: Template) -> bool:
    names = template.expressions.names if template.expressions else ()
    return OPENS in names and {LIPS, INSIDE} <= set(template.regions)


def meeting(points: F64, normals: F64, quads: Indices, unit: float) -> F64:
    """(n,) how far points (n, 3) of closed lips go along unit normals (n, 3) so that the lips meet: towards the
    other lip, where that is at most SLIT away and faces them. quads (Q, 4): those of the lips. unit: world units
    per metre of the template.

    Closed lips touch along a line, and so do closed lids. Registered ones leave a slit behind it, which no light
    reaches: a black line.
    """
    out = np.zeros(len(points))
    rows, faces = np.unique(quads), triangles_of(quads)
    lift = 1e-3 * SLIT * unit
    for _ in range(MEETINGS if len(rows) else 0):
        at = points + out[:, None] * normals
        far, hit = RayCaster(at, faces).hits(at[rows] + lift * normals[rows], normals[rows])
        far, corners = far + lift, at[faces[hit]]
        there = unit_normals(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        meets = (far < SLIT * unit) & ((there * normals[rows]).sum(1) < -FACING)
        out[rows[meets]] += SHARE * far[meets]
    return out
