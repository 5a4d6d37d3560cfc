"""Closed eyes: whether the scan's lids are closed, and what pulls the template's lids together.

Symbols: b strength of the template's expressions that close the eyes; u a vertex of the upper lid's margin, l1 and l2
the vertices of the lower lid's margin beside it; y up.

    x_u - (a x_l1 + (1 - a) x_l2) = GAP y        a: u's place between them from left to right
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from pipeline.meshes import F64, Indices
from pipeline.registration.cage import Cage
from pipeline.registration.identity_fit import PlacedHead
from pipeline.registration.scan import Scan
from pipeline.template.model import Template

BLINK = ("eyeBlinkLeft", "eyeBlinkRight")
LIDS = "lids"  # the region
STRENGTHS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)  # more, and the lids of the mean head pass each other
CLOSED = 0.25  # from this strength the eyes count as closed
REST = 0.3  # strength of the rest of closed eyes: the lids have their length, and do not pass each other yet
MOVES = 5e-4  # metres: skin that the expression moves by more is compared
REACH = 0.004  # metres: a lid without a surface within it counts as this far away
WON = 0.97  # of the mean square distance of open lids: less is won by chance
UPPER = 1e-3  # metres: the upper lid's margin comes down by more, except near the corners, which need no pull
RINGS = 4  # rings of vertices from the border with the socket that make a lid's margin, of the thickness of the lid
GAP = 4e-4  # metres between closed lids


def lids_closed(template: Template, head: PlacedHead, cage: Cage, scan: Scan) -> bool:
    """Whether the skin around the eyes lies nearer to the scan with closed lids. False if the template can't close
    them."""
    if not _closable(template):
        return False
    moved = np.linalg.norm(blink(template), axis=1)[cage.of_template] > MOVES
    rows = np.flatnonzero(cage.shown & (cage.stencil @ moved.astype(np.float64) > 0.5))
    far = REACH * head.scale
    cost = []
    for strength in STRENGTHS:
        x = with_lids(template, head, strength)[cage.of_template]
        away, _ = scan.along(cage.points(x)[rows], cage.normals(x)[rows], far)
        cost.append(float((np.where(np.isfinite(away), away, far) ** 2).mean()))
    best = int(np.argmin(cost))
    return STRENGTHS[best] > CLOSED and cost[best] < WON * cost[0]


def blink(template: Template) -> F64:
    """(V, 3) offsets that close both eyes, metres of the template."""
    return np.asarray(sum(template.expression(name) for name in BLINK), np.float64)


def with_lids(template: Template, head: PlacedHead, strength: float) -> F64:
    """(V, 3) vertices of the head with its lids closed so far."""
    if not strength:
        return head.vertices
    return np.asarray(head.vertices + strength * blink(template) @ head.world_from_template[:3, :3].T, np.float64)


def closing(template: Template, head: PlacedHead, cage: Cage) -> tuple[csr_array, F64]:
    """Stencil (n, V) over the cage and the places (n, 3) of what joins the margins of the lids."""
    stencil = csr_array(facing(template)[:, cage.of_template])
    up = head.world_from_template[:3, 1]
    return stencil, np.tile(GAP * up, (stencil.shape[0], 1))


def facing(template: Template, side: float = 0.0) -> csr_array:
    """Stencil (n, V) of the upper lids' margins minus the lower lids' below them; of one eye by the sign of its x, of
    both with 0."""
    rows: list[tuple[int, int, float]] = []
    count = 0
    for upper, lower in _margins(template):
        at = template.vertices[lower, 0]
        if at[0] * side < 0:
            continue
        for u in upper:
            x = template.vertices[u, 0]
            k = int(np.clip(np.searchsorted(at, x), 1, len(at) - 1))
            a = float(np.clip((at[k] - x) / max(at[k] - at[k - 1], 1e-9), 0, 1))
            rows += [(count, int(u), 1.0), (count, int(lower[k - 1]), -a), (count, int(lower[k]), a - 1)]
            count += 1
    i, j, value = (np.array(c) for c in zip(*rows, strict=True)) if rows else (np.zeros(0, int),) * 3
    return csr_array((value.astype(np.float64), (i, j)), shape=(count, len(template.vertices)))


def _margins(template: Template) -> list[tuple[Indices, Indices]]:
    """Of each eye and each ring of the margin: vertices of the upper and of the lower lid, from the right to the
    left of the person."""
    out = []
    for ring in _rings(template) if _closable(template) else ():
        down = -blink(template)[ring, 1]
        across = template.vertices[ring, 0]
        for side in (across > 0, across < 0):
            order = np.flatnonzero(side)[np.argsort(across[side], kind="stable")]
            upper = down[order] > UPPER
            lower = down[order] < UPPER / 3
            if upper.any() and lower.sum() > 1:
                out.append((ring[order[upper]], ring[order[lower]]))
    return out


def _rings(template: Template) -> list[Indices]:
    """Vertices of the lids by their distance in edges from the sockets."""
    lids, sockets = (template.quads[template.regions[n]] for n in (LIDS, "sockets"))
    rings = [np.intersect1d(lids, sockets)]
    done = rings[0]
    while len(rings) < RINGS:
        at = np.isin(lids, rings[-1])
        beside = np.concatenate([lids[np.roll(at, turn, axis=1)] for turn in (1, -1)])
        rings.append(np.setdiff1d(beside, done))
        done = np.union1d(done, rings[-1])
    return rings


def _closable(template: Template) -> bool:
    names = template.expressions.names if template.expressions else ()
    return set(BLINK) <= set(names) and {LIDS, "sockets"} <= set(template.regions)
