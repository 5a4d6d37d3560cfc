"""Measured blend shapes: what a person's expression is on the neutral head, from two registered heads of one topology.

Symbols: V vertices of the cage; e (V,) evidence: the lesser of the two heads'; d (V, 3) the expression's vertices in
the neutral's frame less the neutral's; b_k the neutral's own expressions (deformation transfer); l length of an edge, h
their mean; L the graph Laplacian of the skin's edges, each weighted by (1 - min e of its ends) h/l; m the sum of
h l / (2 REACH)^2 over a vertex's edges, with which u falls as exp(-distance / REACH).

1. The expression's head comes into the neutral's frame by a rigid motion, robust, on what expressions leave still
   (still.py): first vertex on vertex, then surface on surface, because two registrations of one skull differ by
   millimetres along it and by a tenth of one across. If the unit of one of the captures is unknown, by a similarity.
2. p = sum a_k b_k, 0 <= a_k <= 1, closest to d where both captures show the skin:  min sum e |d - p|^2 + RIDGE a^2
3. offset = p + u.  u = d - p where both show it (e = 1); elsewhere it goes on smoothly and fades within REACH:

       min over u:   sum e/(1 - e) |u - (d - p)|^2 + u . L u + sum m (1 - e) |u|^2

So what neither or only one of the captures shows is the combination of the transferred expressions, with the smooth
rest of what is seen beside it; without expressions of the template it is that rest alone. Teeth and tongue move as the
combination says; eyes not at all, since skin that slid along a face looks like a gaze; lashes neither. Near the border
of the neck nothing moves, as with every expression, and what is still by its weight stays so: there two heads differ by
the registrations' scatter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear
from scipy.sparse import csr_array, diags_array

from pipeline.maths.sparse import factorised
from pipeline.meshes import F64, Indices, Mask
from pipeline.registration.followers import BENDING, ROUND
from pipeline.registration.head import Head
from pipeline.registration.neck import NECK, share_of
from pipeline.registration.procrustes import Aligned, on_planes, robust
from pipeline.registration.rig import Rig
from pipeline.registration.still import counted, evidence, outside, still_weights
from pipeline.registration.subdivision import edges_of, limit
from pipeline.template.model import SKIN, Expressions
from pipeline.transforms import apply, scale_of

REACH = 0.03  # metres of the template within which what is seen fades into the combination
RIDGE = 1e-4  # of the mean diagonal of the combination's equations
NOISE = 1e-4  # metres of the template: residuals of the alignment below this are noise
HARD = 1e-3  # of 1 - e: a place with full evidence has this much freedom
# limits of a usable expression
LEAST_SEEN = 0.3  # share of the moving skin that both captures show
MOST_APART = 0.002  # metres of the template: spread of the still parts across the surface after the alignment
MOST_SCALE = 0.06  # by how much two heads of known unit may differ in size


@dataclass(frozen=True, slots=True)
class Measured:
    """offsets (V, 3) on the neutral's cage, in its unit. refused: why it is no blend shape, or empty. figures:
    `still_mm` spread of the still parts across the surface after the alignment, `size` of the expression's head over
    the neutral's on them (`scale` that was applied, if a unit is unknown), `turn_degrees` and `shift_mm` of the motion,
    `seen` share of the moving skin that both show, `largest_mm` offset, `explained` share of the squared seen offsets
    that the transferred expressions make."""

    offsets: F64
    figures: dict[str, float]
    refused: str = ""


def measured(
    neutral: Head, other: Head, rig: Rig, regions: tuple[str, ...], parts: tuple[str, ...], unit: float, *, metric: bool
) -> Measured:
    """The expression of the head `other` on the head `neutral`, whose rig is known. regions, parts: names that the
    heads refer to; unit: world units per metre of the template, of the neutral; metric: whether both units are metres.

    Raises:
        ValueError: the heads have other topologies.
    """
    if not np.array_equal(neutral.quads, other.quads) or len(neutral.vertices) != len(other.vertices):
        raise ValueError("two heads of other topologies")
    shapes, seen = rig.expressions, np.minimum(evidence(neutral, regions), evidence(other, regions))
    rigid = still_weights(neutral, regions, shapes, unit)
    still = counted(rigid, seen)
    try:
        found = aligned(neutral, other, still, unit, scaled=not metric)
        free = scale_of(aligned(neutral, other, still, unit, scaled=True).matrix) if metric else 1.0
    except ValueError as e:
        return Measured(np.zeros_like(neutral.vertices), {}, f"the heads can't be aligned: {e}")
    difference = apply(found.matrix, other.vertices) - neutral.vertices
    skin = _skin(neutral, parts)
    basis = dense(shapes, len(neutral.vertices))
    share = combination(basis, difference, seen)
    carried = np.tensordot(share, basis, 1) if len(share) else np.zeros_like(difference)
    offsets = carried.copy()
    offsets[skin] += faded(neutral, difference - carried, seen, skin, unit)[skin]
    offsets[_resting(neutral, parts)] = 0.0
    share_here = (1 - rigid) * share_of(
        neutral.vertices / unit, neutral.quads[_quads_of(neutral.part, parts, SKIN)],
        neutral.quads[_quads_of(neutral.region, regions, NECK)],
    )  # fmt: skip
    offsets *= share_here[:, None]
    figures = _figures(neutral, found, difference, carried, offsets, seen, rigid, regions, unit)
    figures |= {"size": 1 / free} if metric else {"scale": scale_of(found.matrix)}
    return Measured(offsets, {k: round(v, 5) for k, v in figures.items()}, refused(figures))


def refused(figures: dict[str, float]) -> str:
    """Why an expression with these figures is no blend shape; empty if it is one."""
    if figures["seen"] < LEAST_SEEN:
        return (
            f"both captures show only {100 * figures['seen']:.0f} % of the skin that expressions move "
            f"(at least {100 * LEAST_SEEN:.0f} %)"
        )
    if abs(figures.get("size", 1.0) - 1) > MOST_SCALE:
        return (
            f"the head is {figures['size']:.2f} times as large as the neutral one (at most {100 * MOST_SCALE:.0f} % "
            "apart): is the unit of both captures metres?"
        )
    if figures["still_mm"] > 1000 * MOST_APART:
        return (
            f"scalp, ears and forehead of the two heads are {figures['still_mm']:.1f} mm apart after the alignment "
            f"(at most {1000 * MOST_APART:.0f})"
        )
    return ""


def aligned(neutral: Head, other: Head, weights: F64, unit: float, *, scaled: bool) -> Aligned:
    """The motion that brings the head `other` into the neutral's frame, by the surfaces' points at the cage's vertices
    with weights (V,)."""
    at = limit(neutral.quads, len(neutral.vertices))
    source, target = np.asarray(at.point @ other.vertices), np.asarray(at.point @ neutral.vertices)
    least = NOISE * unit
    start = robust(source, target, weights, scaled=scaled, least=least).matrix
    return on_planes(start, source, target, at.normals(neutral.vertices), weights, scaled=scaled, least=least)


def combination(basis: F64, wanted: F64, weights: F64) -> F64:
    """(K,) shares in [0, 1] of the shapes basis (K, V, 3) whose sum comes closest to wanted (V, 3) where weights (V,)
    are positive; all 0 where none is."""
    use = np.flatnonzero(weights > 0)
    if not len(use) or not len(basis):
        return np.zeros(len(basis))
    root = np.sqrt(weights[use])[:, None]
    a = (root * basis[:, use]).reshape(len(basis), -1).T
    right = (root * wanted[use]).ravel()
    normal = a.T @ a
    ridge = RIDGE * max(float(np.trace(normal)) / len(basis), 1e-30)
    factor = np.linalg.cholesky(normal + ridge * np.eye(len(basis)))
    goal = np.linalg.solve(factor, a.T @ right)
    return np.asarray(lsq_linear(factor.T, goal, (0, 1), method="bvls", tol=1e-12).x, np.float64)


def faded(head: Head, rest: F64, seen: F64, skin: Mask, unit: float) -> F64:
    """(V, 3) the field that is rest (V, 3) where seen (V,) is 1, and goes on smoothly to 0 within REACH of it, over the
    edges of the skin (V,); 0 beside the skin."""
    count = len(head.vertices)
    ends = edges_of(head.quads, count).ends
    ends = ends[skin[ends].all(1)]
    length = np.linalg.norm(head.vertices[ends[:, 0]] - head.vertices[ends[:, 1]], axis=1) / unit
    mean = length.mean()
    weight = (1 - seen[ends].min(1)) * mean / np.maximum(length, 1e-3 * mean)
    flat = csr_array((weight, (ends[:, 0], ends[:, 1])), shape=(count, count))
    both = flat + flat.T
    mass = np.bincount(ends.ravel(), np.repeat(length, 2), count) * mean / (2 * REACH) ** 2
    known = seen / (1 - seen + HARD)
    system = diags_array(known + np.asarray(both.sum(1)) + mass * (1 - seen) + ~skin) - both
    return np.asarray(factorised(system).solve(known[:, None] * np.where(skin[:, None], rest, 0.0)), np.float64)


def dense(shapes: Expressions, count: int) -> F64:
    """(K, V, 3) offsets of `count` vertices."""
    out = np.zeros((len(shapes.names), count, 3))
    for k, (a, b) in enumerate(zip(shapes.starts[:-1], shapes.starts[1:], strict=True)):
        out[k, shapes.vertices[a:b]] = shapes.offsets[a:b]
    return out


def _figures(
    head: Head, found: Aligned, difference: F64, carried: F64, offsets: F64, seen: F64, rigid: F64,
    regions: tuple[str, ...], unit: float,
) -> dict[str, float]:  # fmt: skip
    moving = outside(head, regions) & (rigid < 0.25)
    use = seen[:, None] * moving[:, None]
    total, least = float((use * difference**2).sum()), float(use.sum()) * (NOISE * unit) ** 2
    rotation = found.matrix[:3, :3] / scale_of(found.matrix)
    middle = head.vertices.mean(0)
    shift = apply(np.asarray(np.linalg.inv(found.matrix)), middle[None])[0] - middle
    return {
        "still_mm": 1000 * found.spread / unit,
        "turn_degrees": float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))),
        "shift_mm": 1000 * float(np.linalg.norm(shift)) / unit,
        "seen": float(seen[moving].mean()) if moving.any() else 0.0,
        "largest_mm": 1000 * float(np.linalg.norm(offsets, axis=1).max()) / unit,
        "explained": 1 - float((use * (difference - carried) ** 2).sum()) / total if total > least else 1.0,
    }


def _skin(head: Head, parts: tuple[str, ...]) -> Mask:
    out = np.zeros(len(head.vertices), np.bool_)
    out[head.quads[_quads_of(head.part, parts, SKIN)]] = True
    return out


def _resting(head: Head, parts: tuple[str, ...]) -> Mask:
    """(V,) vertices of eyes and lashes."""
    out = np.zeros(len(head.vertices), np.bool_)
    for name in (n for n in parts if n.startswith((ROUND, BENDING))):
        out[head.quads[_quads_of(head.part, parts, name)]] = True
    return out & ~_skin(head, parts)


def _quads_of(index: Indices, names: tuple[str, ...], name: str) -> Mask:
    return np.asarray(index == (names.index(name) if name in names else -2))
