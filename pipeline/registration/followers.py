"""Parts that are not skin (eyes, teeth, tongue, lashes) follow the skin that is near them.

A part keeps its own shape: it makes the rigid motion that the nearest skin makes from rest to the registered head,
least squares with weights that fall with the distance. Lashes lie on the lids, whose shape changes: each of their
vertices moves with the skin nearest to it.

An eye is made smaller until the skin lies outside. The lids' inner edges count only where they lie outside of the
template's own eye: most are sunk into it, which closes the slit between lid and eye.

Source: Horn, Hilden and Negahdaripour 1988, for the rigid motion (by the singular value decomposition).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.meshes import F64, Indices
from pipeline.template.model import SKIN, Template

BENDING = "lashes"  # parts whose name begins so bend with the skin
ROUND = "eye"  # parts whose name begins so stay behind the skin
GAP = 2e-4  # metres of the template between an eye and its lids
SMALLEST = 0.7  # least scale of an eye
NEAR = 150  # vertices of skin that move a part
FALL = 0.006  # metres of the template: distance at which a vertex of skin has half of its weight


def followed(template: Template, rest: F64, cage: Indices, skin: F64, rotations: F64, unit: float) -> F64:
    """(V, 3) all vertices. rest (V, 3): the identity's; cage (N,): the skin's rows of it; skin (N, 3): registered;
    rotations (N, 3, 3) of the skin; unit: world units per metre of the template."""
    out = rest.copy()
    out[cage] = skin
    tree = cKDTree(rest[cage])
    for name in template.parts:
        if name == SKIN:
            continue
        own = np.setdiff1d(template.part_vertices(name), cage)
        if not len(own):
            continue
        if name.startswith(BENDING):
            _, near = tree.query(rest[own])
            out[own] = skin[near] + np.einsum("nij,nj->ni", rotations[near], rest[own] - rest[cage][near])
            continue
        away, _ = cKDTree(rest[own]).query(rest[cage])
        near = np.argsort(away, kind="stable")[:NEAR]
        weight = 1 / (1 + (away[near] / (FALL * unit)) ** 2)
        turn, shift = rigid_motion(rest[cage][near], skin[near], weight)
        out[own] = rest[own] @ turn.T + shift
        if name.startswith(ROUND):
            seen = near[room(rest[own], rest[cage][near]) >= 1]
            out[own] = behind(out[own], skin[seen], GAP * unit)
    return out


def behind(ball: F64, skin: F64, gap: float) -> F64:
    """A ball's vertices (N, 3) scaled about its middle so far that the skin (M, 3) lies outside: lids that close press
    on an eye that is drawn too large."""
    middle = 0.5 * (ball.min(0) + ball.max(0))
    least = room(ball, skin, gap).min(initial=1.0)
    return np.asarray(middle + (ball - middle) * float(np.clip(least, SMALLEST, 1.0)))


def room(ball: F64, skin: F64, gap: float = 0.0) -> F64:
    """(M,) how far the skin (M, 3) lies from a ball's middle, less the gap, over the ball's radius in that direction: 1
    or more outside of the ball (N, 3)."""
    middle = 0.5 * (ball.min(0) + ball.max(0))
    own, there = ball - middle, skin - middle
    radius, away = np.linalg.norm(own, axis=1), np.linalg.norm(there, axis=1)
    _, nearest = cKDTree(own / np.maximum(radius, 1e-30)[:, None]).query(there / np.maximum(away, 1e-30)[:, None])
    return np.asarray((away - gap) / np.maximum(radius[nearest], 1e-30))


def rigid_motion(start: F64, goal: F64, weights: F64) -> tuple[F64, F64]:
    """Rotation (3, 3) and translation (3,) of least squares from start (N, 3) to goal (N, 3) with weights (N,)."""
    w = weights / weights.sum()
    a, b = w @ start, w @ goal
    u, _, v = np.linalg.svd((w[:, None] * (goal - b)).T @ (start - a))
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(v))]) @ v
    return np.asarray(turn), np.asarray(b - turn @ a)
