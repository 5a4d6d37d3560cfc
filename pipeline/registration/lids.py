"""Closed eyes: whether the scan's lids are closed, and what pulls the template's lids together.

Symbols: b strength of the template's expressions that close the eyes; u a vertex of the upper lid's margin, l1 and l2
the vertices of the lower lid's margin beside it; y up. Both margins run from corner to corner.

    x_u - (a x_l1 + (1 - a) x_l2) = GAP y        a: by u's share of the margin's length
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
LEAST_LOOP = 6  # vertices of a ring around an eye: fewer are none
RINGS = 4  # rings of vertices from the border with the socket that make a lid's margin, of the thickness of the lid
# the face network's landmarks of the upper lids' margins: of closed eyes it places them 4 mm too high
UPPER_LIDS = (157, 158, 159, 160, 161, 173, 246, 384, 385, 386, 387, 388, 398, 466)
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


def between(template: Template, cage: Cage) -> F64:
    """(M,) share of the lids' margins in each limit point of the cage: closed lids touch there, and no surface of the
    photos shows them."""
    margins = np.zeros(len(template.vertices))
    for ring in _rings(template)[:-1] if _closable(template) else ():
        margins[ring] = 1.0
    return np.asarray(cage.stencil @ margins[cage.of_template])


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
        if template.vertices[lower, 0].mean() * side < 0:
            continue
        at, low = _along(template.vertices[upper]), _along(template.vertices[lower])
        for u, share in zip(upper[1:-1], at[1:-1], strict=True):
            k = int(np.clip(np.searchsorted(low, share), 1, len(low) - 1))
            a = float(np.clip((low[k] - share) / max(low[k] - low[k - 1], 1e-12), 0, 1))
            rows += [(count, int(u), 1.0), (count, int(lower[k - 1]), -a), (count, int(lower[k]), a - 1)]
            count += 1
    i, j, value = (np.array(c) for c in zip(*rows, strict=True)) if rows else (np.zeros(0, int),) * 3
    return csr_array((value.astype(np.float64), (i, j)), shape=(count, len(template.vertices)))


def _along(points: F64) -> F64:
    """(n,) share of the length of a line through points (n, 3) up to each."""
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    return np.asarray(length / max(length[-1], 1e-12))


def _margins(template: Template) -> list[tuple[Indices, Indices]]:
    """Of each eye and each ring of the margin: vertices of the upper and of the lower lid, from the right corner to the
    left one of the person, with both corners."""
    if not _closable(template):
        return []
    out, x, down = [], template.vertices[:, 0], -blink(template)[:, 1]
    for ring in _rings(template):
        for own in (ring[x[ring] > 0], ring[x[ring] < 0]):
            loop = _loop(template.quads[template.regions[LIDS]], own)
            if len(loop) < LEAST_LOOP:
                continue
            loop = np.roll(loop, -int(np.argmin(x[loop])))
            end = int(np.argmax(x[loop]))
            one, other = loop[: end + 1], np.r_[loop[:1], loop[end:][::-1]]
            out.append((one, other) if down[one].mean() > down[other].mean() else (other, one))
    return out


def _loop(quads: Indices, rows: Indices) -> Indices:
    """The vertices rows (n,) in turn along the sides of quads (Q, 4); none if they are not one closed line."""
    ends = np.stack([quads, np.roll(quads, -1, axis=1)], 2).reshape(-1, 2)
    ends = np.unique(np.sort(ends[np.isin(ends, rows).all(1)], axis=1), axis=0)
    beside: dict[int, list[int]] = {int(v): [] for v in rows}
    for a, b in ends.tolist():
        beside[a].append(b)
        beside[b].append(a)
    if any(len(n) != 2 for n in beside.values()):
        return rows[:0]
    loop = [int(rows[0])]
    while (following := next((v for v in beside[loop[-1]] if v not in loop[-2:]), loop[0])) != loop[0]:
        loop.append(following)
    return np.array(loop if len(loop) == len(rows) else [], np.int64)


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
