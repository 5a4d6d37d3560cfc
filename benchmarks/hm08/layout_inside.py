"""Tile 1002 of the texture layout: the inside of the mouth and of the sockets, eyes, teeth, tongue and lashes.

Each piece is one of the base mesh's texture islands, laid flat anew with little stretch. Pieces of the right side are
those of the left mirrored; pieces in the middle are made symmetric. Each fills its box of the tile.
"""

from __future__ import annotations

import numpy as np

from benchmarks.hm08.cut import Cut, islands
from benchmarks.hm08.flatten import relaxed
from benchmarks.hm08.regions import mirrored_quads
from pipeline.meshes import F64, Indices

BOXES = {  # piece: left, bottom, right and top on the tile; of the left side's pieces, the right's are mirrored
    "eye_left:0": (0.68, 0.68, 0.99, 0.99),
    "eye_left:1": (0.82, 0.01, 0.99, 0.18),
    "skin:sockets": (0.68, 0.35, 0.99, 0.66),
    "lashes_left:0": (0.68, 0.27, 0.99, 0.33),
    "lashes_left:1": (0.68, 0.20, 0.99, 0.26),
    "skin:mouth_inside": (0.34, 0.34, 0.66, 0.66),
    "tongue:0": (0.34, 0.68, 0.66, 0.99),
    "teeth_upper:0": (0.34, 0.17, 0.66, 0.32),
    "teeth_lower:0": (0.34, 0.01, 0.66, 0.16),
}


def inside_layout(mean: F64, cut: Cut, source_uv: F64) -> F64:
    """(Q, 4, 2) texture coordinates by corner, those of the skin's outside NaN. source_uv: (N, 2) of the base mesh."""
    out = np.full((len(cut.quads), 4, 2), np.nan)
    other = mirrored_quads(cut)
    for name, quads in _pieces(mean, cut).items():
        flat = _flat(mean, cut, quads, source_uv)
        if set(other[quads]) == set(quads):
            flat = _symmetric(flat, quads, other, cut, mean)
        else:
            flat = _upright(flat, mean[cut.quads[quads]])
        out[quads] = _in_box(flat, BOXES[name]) + [1.0, 0.0]
        if set(other[quads]) != set(quads):
            out[other[quads]] = _seen_in_mirror(out, quads, other[quads], cut) * [-1, 1] + [3, 0]
    return out


def _pieces(mean: F64, cut: Cut) -> dict[str, Indices]:
    """Quads of each piece of BOXES; of an eye, the front first."""
    _, mouth, one, two, _ = islands(cut)
    left = one if mean[cut.quads[one]].mean((0, 1))[0] > 0 else two
    out = {"skin:mouth_inside": mouth, "skin:sockets": left}
    for part in cut.parts:
        if not part.endswith("_right") and part != "skin":
            found = islands(cut, part)
            order = sorted(range(len(found)), key=lambda i: -mean[cut.quads[found[i]]].mean((0, 1))[2])
            out |= {f"{part}:{k}": found[i] for k, i in enumerate(order)}
    return out


def _flat(mean: F64, cut: Cut, quads: Indices, source_uv: F64) -> F64:
    """(n, 4, 2) of a piece, with little stretch."""
    names, own = np.unique(cut.source_uv[quads], return_inverse=True)
    own = own.reshape(-1, 4)
    points = np.zeros((len(names), 3))
    points[own] = mean[cut.quads[quads]]
    start = source_uv[names]
    start = (start - start.mean(0)) * (np.ptp(points, axis=0).max() / np.ptp(start, axis=0).max())
    held = np.zeros(start.shape, np.bool_)
    held[0] = True
    return relaxed(points, own, np.ones(len(own)), start, held, 100)[own]


def _seen_in_mirror(out: F64, quads: Indices, others: Indices, cut: Cut) -> F64:
    """(n, 4, 2) of the corners of `others`, what `out` has at the mirrored corners of `quads`."""
    found = np.zeros((len(quads), 4, 2))
    for row, (q, r) in enumerate(zip(quads, others, strict=True)):
        for corner, v in enumerate(cut.quads[r]):
            found[row, corner] = out[q][cut.quads[q] == cut.mirror[v]][0]
    return found


def _symmetric(flat: F64, quads: Indices, other: Indices, cut: Cut, mean: F64) -> F64:
    """A middle piece, symmetric about the v axis and upright."""
    full = np.zeros((len(cut.quads), 4, 2))
    full[quads] = flat - flat.mean((0, 1))
    here = full[quads].reshape(-1, 2)
    there = _seen_in_mirror(full, other[quads], quads, cut).reshape(-1, 2)
    # the reflection [[c, s], [s, -c]] that takes the mirrored corners nearest to the corners
    c = (here[:, 0] * there[:, 0] - here[:, 1] * there[:, 1]).sum()
    s = (here[:, 0] * there[:, 1] + here[:, 1] * there[:, 0]).sum()
    c, s = np.array([c, s]) / np.hypot(c, s)
    both = (here + there @ np.array([[c, s], [s, -c]])) / 2
    axis = np.arctan2(s, c) / 2
    turn = np.pi / 2 - axis
    both = both @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    across = mean[cut.quads[quads]].reshape(-1, 3)[:, 0]
    return (both if (both[:, 0] * across).sum() > 0 else -both).reshape(-1, 4, 2)


def _upright(flat: F64, corners: F64) -> F64:
    """A piece turned so that it lies as it is seen from the front."""
    a, b = (x.reshape(-1, 2) - x.reshape(-1, 2).mean(0) for x in (flat, corners[..., :2]))
    c, s = (a * b).sum(), (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    c, s = np.array([c, s]) / np.hypot(c, s)
    return (a @ np.array([[c, s], [-s, c]])).reshape(-1, 4, 2)


def _in_box(flat: F64, box: tuple[float, float, float, float]) -> F64:
    """As large as fits, in the middle of the box."""
    low, high = flat.min((0, 1)), flat.max((0, 1))
    left, bottom, right, top = box
    scale = min((right - left) / (high - low)[0], (top - bottom) / (high - low)[1])
    return np.asarray((flat - (low + high) / 2) * scale + [(left + right) / 2, (bottom + top) / 2], np.float64)
