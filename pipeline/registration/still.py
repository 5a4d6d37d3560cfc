"""Which parts of a registered head an expression leaves where they are: what two expressions are aligned by.

Symbols: m the largest offset of a vertex in any of the head's expressions, in metres of the template; e how well the
photos show it, 0 to 1.

    still weight    1 / (1 + (m / STILL)^2)^2 on scalp, ears, forehead, the upper nose and the rest of the skin's
                    outside; 0 on the neck (the head turns on it), and inside of mouth, nostrils and sockets
    evidence        e; a place that the photos do not show has what the identity says of it, and counts UNSEEN
"""

from __future__ import annotations

import numpy as np

from pipeline.meshes import F64, Mask
from pipeline.registration.head import Head
from pipeline.registration.neck import NECK
from pipeline.registration.quality import outer_quads
from pipeline.registration.subdivision import edges_of
from pipeline.template.model import Expressions

STILL = 0.0005  # metres of the template: a vertex that moves as far has a quarter of the weight
UNSEEN = 0.02  # evidence of a place that no photo shows
ENOUGH = 0.5  # sum of cosines to the photos that see a place from which it counts fully: one photo at 60 degrees


def movement(expressions: Expressions, count: int) -> F64:
    """(V,) the largest offset of each of `count` vertices in any expression, in the unit of the offsets."""
    out = np.zeros(count)
    np.maximum.at(out, expressions.vertices, np.linalg.norm(expressions.offsets, axis=1))
    return out


def still_weights(head: Head, regions: tuple[str, ...], expressions: Expressions, unit: float) -> F64:
    """(V,) 0 to 1. regions: names that head.region refers to; unit: world units per metre of the template."""
    moves = movement(expressions, len(head.vertices)) / (STILL * unit)
    return np.asarray(np.where(outside(head, regions), 1 / (1 + moves**2) ** 2, 0.0), np.float64)


def outside(head: Head, regions: tuple[str, ...]) -> Mask:
    """(V,) vertices of the skin's outside that do not touch the neck or what lies within."""
    own = outer_quads(head.region, regions)
    if NECK in regions:
        own &= head.region != regions.index(NECK)
    out, other = (np.zeros(len(head.vertices), np.bool_) for _ in range(2))
    out[head.quads[own]], other[head.quads[~own]] = True, True
    return np.asarray(out & ~other)


def evidence(head: Head, regions: tuple[str, ...]) -> F64:
    """(V,) 0 to 1: how well the photos show the surface at each vertex and around it, on the skin's outside with the
    neck; 0 elsewhere. A control vertex is as good as the surface around it that it was fitted to: the lesser of what is
    seen at its own place, and of the mean with its neighbours."""
    count = len(head.vertices)
    seen = np.clip(head.seen[:count].astype(np.float64) / ENOUGH, 0, 1)  # the cage's vertices come first
    ends = edges_of(head.quads, count).ends
    total, number = seen.copy(), np.ones(count)
    for a, b in (ends.T, ends.T[::-1]):
        np.add.at(total, a, seen[b])
        np.add.at(number, a, 1.0)
    own = np.zeros(count, np.bool_)
    own[head.quads[outer_quads(head.region, regions)]] = True
    return np.asarray(np.where(own, np.minimum(seen, total / number), 0.0), np.float64)


def counted(still: F64, *seen: F64) -> F64:
    """(V,) weights for an alignment: still, times the least evidence of all heads and at least UNSEEN of it."""
    return np.asarray(still * (UNSEEN + (1 - UNSEEN) * np.minimum.reduce(seen)), np.float64)
