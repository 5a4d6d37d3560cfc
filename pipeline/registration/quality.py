"""Figures of a registered head: distances from the fitted surface, quads, and where the face passes through itself.

Symbols: p, N limit points and normals of the subdivided cage; d displacement; the distance of a point is that along its
normal, within FAR; seen: the photos show the place that it meets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.meshes import F64, Indices, Mask, triangles_of
from pipeline.registration.cage import HIDDEN, LOOSE
from pipeline.registration.folds import piercing_edges
from pipeline.registration.head import Head
from pipeline.registration.scan import Scan

FAR = 0.02  # metres of the template
LOOSE_REACH = 0.004  # metres: on scalp and neck, what is further away is hair or clothes and does not count
NOT_SKIN = ("eyes", "teeth", "tongue", "lashes")
NOT_FACE = (*HIDDEN, *LOOSE, *NOT_SKIN, "ears")


@dataclass(frozen=True, slots=True)
class Distances:
    """Millimetres: median and 95 % of the subdivided head, and with its displacement; count: points of seen skin."""

    median: float
    most: float
    displaced_median: float
    displaced_most: float
    count: int


@dataclass(frozen=True, slots=True)
class Quads:
    """Corner angles in degrees (the least, the largest, and those that 1 in 100 quads exceed) and sides: longest over
    shortest (that 1 in 100 exceed)."""

    least: float
    largest: float
    sharp: float
    blunt: float
    aspect: float


def distances(head: Head, names: tuple[str, ...], scan: Scan, unit: float) -> Mapping[str, Distances]:
    """By region, and of all skin that can be shown under the name "skin". unit: world units per metre of the template;
    distances are in metres of the world times 1000."""
    points, normals, quads = head.surface()
    region = np.repeat(head.region, 4**head.levels)
    moved = head.displaced()
    off, seen = scan.along(points, normals, FAR * unit)
    middle, way = moved[quads].mean(1), normals[quads].mean(1)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-30)
    after, after_seen = scan.along(middle, way, FAR * unit)
    loose = np.isin(region, [names.index(n) for n in LOOSE if n in names])
    out, before = {}, np.abs(off[quads])
    ok = (seen[quads] > 0) & ~(loose[:, None] & (before > LOOSE_REACH * unit)) & np.isfinite(before)
    fine = (after_seen > 0) & ok.all(1) & np.isfinite(after)
    shown = outer_quads(region, names)
    regions = {n: region == i for i, n in enumerate(names) if n not in HIDDEN and n not in NOT_SKIN}
    for name, rows in {**regions, "skin": shown}.items():
        a, b = before[rows][ok[rows]], np.abs(after[rows & fine])
        if len(a) and len(b):
            (m, p), (dm, dp) = np.quantile(a, [0.5, 0.95]), np.quantile(b, [0.5, 0.95])
            out[name] = Distances(1000 * m, 1000 * p, 1000 * dm, 1000 * dp, int(ok[rows].any(1).sum()))
    return out


def seen_share(head: Head, names: tuple[str, ...]) -> float:
    """Share of the area of the skin's outside that the photos show."""
    points, _, quads = head.surface()
    region = np.repeat(head.region, 4**head.levels)
    outside = outer_quads(region, names)
    at = points[quads[outside]]
    area = 0.5 * np.linalg.norm(np.cross(at[:, 2] - at[:, 0], at[:, 3] - at[:, 1]), axis=1)
    return float((area * (head.seen[quads[outside]] > 0).mean(1)).sum() / max(area.sum(), 1e-30))


def quad_quality(vertices: F64, quads: Indices) -> Quads:
    """Of quads (Q, 4) of vertices (V, 3)."""
    at = vertices[quads]
    a, b = np.roll(at, -1, axis=1) - at, np.roll(at, 1, axis=1) - at
    length = np.linalg.norm(a, axis=2)
    cosine = (a * b).sum(2) / np.maximum(length * np.linalg.norm(b, axis=2), 1e-30)
    angle = np.degrees(np.arccos(cosine.clip(-1, 1)))
    aspect = length.max(1) / np.maximum(length.min(1), 1e-30)
    return Quads(
        float(angle.min()), float(angle.max()), float(np.quantile(angle.min(1), 0.01)),
        float(np.quantile(angle.max(1), 0.99)), float(np.quantile(aspect, 0.99)),
    )  # fmt: skip


def face_piercings(head: Head, names: tuple[str, ...]) -> int:
    """Edges of the displaced face (with lids, lips and nose) that pass through another part of it."""
    quads = head.surface()[2]
    return len(piercing_edges(head.displaced(), triangles_of(quads[face_quads(head, names)])))


def face_quads(head: Head, names: tuple[str, ...]) -> Mask:
    """(Q 4^levels,) quads of the face: with brows, lids, lips and nose."""
    region = np.repeat(head.region, 4**head.levels)
    return np.asarray(np.array([n not in NOT_FACE for n in names])[region], np.bool_)


def outer_quads(region: Indices, names: tuple[str, ...]) -> Mask:
    """(Q,) quads of the skin's outside."""
    return np.asarray(np.array([n not in HIDDEN and n not in NOT_SKIN for n in names])[region], np.bool_)
