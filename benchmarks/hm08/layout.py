"""The texture layout: skin upright and symmetric on tile 1001, everything else on tile 1002.

The left half of the skin is laid into the right half of the tile, as seen from the front: its middle line on u = 1/2, a
seam down the back of the head along the tile's top and outer side, the neck's border along the bottom. All of the tile
is used, and since no quad flips and the outline is the tile's own, nothing overlaps. The insides of the mouth and of
the sockets are laid flat with it, very small, to hold their openings open, and then get charts of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.hm08.cut import Cut
from benchmarks.hm08.flatten import relaxed, tutte
from benchmarks.hm08.regions import NAMES, mirrored_quads
from pipeline.meshes import F64, Indices, area_vectors

MARGIN = 1 / 256  # of a tile, along its sides
FACE = ("face", "brows", "lids", "lips", "nose", "nostrils")
SHARES = {"face": 0.52, "ears": 0.055, "scalp": 0.24, "neck": 0.175, "inside": 0.01}  # of the tile's area
ROUNDS = 8  # in which what is asked for is corrected by what came of it
FINER = {"lids": 1.6, "lips": 1.6, "nose": 1.2, "nostrils": 0.6, "brows": 1.1}  # of the face's own density
SMOOTH = 6  # rounds in which the wanted density is averaged with the neighbours'
SEAM_TOP = 0.45  # of the seam's length: what lies along the tile's top


def group_of_region(name: str) -> str:
    """Which of SHARES a region of the skin is part of."""
    return "face" if name in FACE else "inside" if name in ("mouth_inside", "sockets") else name


@dataclass(frozen=True, slots=True)
class Layout:
    """uvs (U, 2); uv_quads (Q, 4) into them."""

    uvs: F64
    uv_quads: Indices


def wanted_scale(area: F64, quads: Indices, region: np.ndarray, asked: dict[str, float]) -> F64:
    """(n,) texture length over length in space of quads of `area` (n,), smooth from region to region; asked: share of
    the texture for each of SHARES."""
    group = np.array([group_of_region(r) for r in region])
    finer = np.array([FINER.get(r, 1.0) for r in region])
    density = np.zeros(len(quads))
    for name, share in asked.items():
        which = group == name
        density[which] = share * finer[which] / (area * finer)[which].sum()
    density = np.exp(_smoothed(np.log(density), quads, group != "inside"))
    return np.asarray(np.sqrt(density / (density * area).sum()), np.float64)


def _smoothed(value: F64, quads: Indices, which: np.ndarray) -> F64:
    """Quads' values averaged over the vertices they share; only those of `which`, among themselves."""
    out, some, count = value.copy(), quads[which], int(quads.max()) + 1
    for _ in range(SMOOTH):
        total = np.bincount(some.ravel(), np.repeat(out[which], 4), count)
        uses = np.maximum(np.bincount(some.ravel(), minlength=count), 1)
        out[which] = (total / uses)[some].mean(1)
    return out


def skin_layout(mean: F64, cut: Cut, label: Indices, seam_start: int) -> F64:
    """(n, 4, 2) texture coordinates of the skin's quads by corner, tile 1001. seam_start: vertex on the middle line
    from which the seam runs down the back."""
    quads = cut.part("skin")
    left = np.flatnonzero(mean[quads].mean(1)[:, 0] > 0)
    rows = np.unique(quads[left])
    own = np.searchsorted(rows, quads[left])
    start, border = _outline(mean[rows], own, cut.mirror[rows] == rows, int(np.searchsorted(rows, seam_start)))
    uv = tutte(own[:, [0, 1, 1, 2, 2, 3, 3, 0]].reshape(-1, 2), len(rows), border, start)
    region = np.array(NAMES)[label[left]]
    area = quad_areas(mean, quads[left])
    asked = dict(SHARES)
    for _ in range(ROUNDS):
        scale = wanted_scale(area, own, region, asked) * np.sqrt(0.5) * (1 - 2 * MARGIN)
        uv = relaxed(mean[rows], own, scale, uv, _sliding(start, border), 25)
        got = shares(uv[own], region)
        asked = {k: a * (SHARES[k] / got[k]) ** 1.2 for k, a in asked.items()}
    out = np.zeros((len(quads), 4, 2))
    out[left] = uv[own]
    return _mirrored_side(out, cut, left)


def _mirrored_side(out: F64, cut: Cut, left: Indices) -> F64:
    """The coordinates of the right side's quads from the left's."""
    other, quads = mirrored_quads(cut)[left], cut.quads
    for q, r in zip(left, other, strict=True):
        corner = [int(np.flatnonzero(cut.mirror[quads[q]] == v)[0]) for v in quads[r]]
        out[r] = out[q][corner] * [-1, 1] + [1, 0]
    return out


def quad_areas(points: F64, quads: Indices) -> F64:
    """(n,)"""
    return np.linalg.norm(area_vectors(points, quads[:, :3]) + area_vectors(points, quads[:, [0, 2, 3]]), axis=1)


def texture_areas(uv: F64) -> F64:
    """(n,) signed areas of quads (n, 4, 2) in the texture."""
    a, b = uv[:, 2] - uv[:, 0], uv[:, 3] - uv[:, 1]
    return np.asarray(0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.float64)


def shares(uv: F64, region: np.ndarray) -> dict[str, float]:
    """Part of the texture under quads (n, 4, 2) that each of SHARES has."""
    area, group = texture_areas(uv), np.array([group_of_region(r) for r in region])
    return {k: float(area[group == k].sum() / area.sum()) for k in SHARES}


def border_path(quads: Indices) -> Indices:
    """(n,) vertices along the border of a disc, counter-clockwise as its faces turn."""
    sides = quads[:, [0, 1, 1, 2, 2, 3, 3, 0]].reshape(-1, 2)
    there = {(a, b) for a, b in sides.tolist()}
    following = {a: b for a, b in there if (b, a) not in there}
    path = [min(following)]
    while following[path[-1]] != path[0]:
        path.append(following[path[-1]])
    if len(path) != len(following):
        raise SystemExit("a piece is not a disc")
    return np.array(path)


def _outline(points: F64, quads: Indices, middle: np.ndarray, seam: int) -> tuple[F64, np.ndarray]:
    """Start (n, 2) of the border on the right half of the tile, and (n,) which vertices it has."""
    path = border_path(quads)
    path = np.roll(path, -int(np.flatnonzero(path == seam)[0]))
    on = middle[path]
    # from the seam's start one way along the middle: over the face, or down the back
    neck = np.flatnonzero(~on)
    corners = [0, int(neck[0]) - 1, int(neck[-1]) + 1, len(path)]
    lengths = np.linalg.norm(np.diff(points[np.append(path, path[0])], axis=0), axis=1)
    at = np.zeros((len(path), 2))
    lo, hi = MARGIN, 1 - MARGIN
    runs = [_along(lengths[a:b]) for a, b in zip(corners[:-1], corners[1:], strict=True)]
    forward = points[path[1 : corners[1]]][:, 2].mean() > points[path[corners[2] + 1 :]][:, 2].mean()
    front, bottom, back = runs
    if not forward:
        raise SystemExit("the border runs down the back first")
    at[: corners[1] + 1] = np.stack([np.full(len(front), 0.5), hi + (lo - hi) * front], 1)
    at[corners[1] : corners[2] + 1] = np.stack([0.5 + (hi - 0.5) * bottom, np.full(len(bottom), lo)], 1)
    side = back < 1 - SEAM_TOP
    bend = corners[2] + int(side.sum())
    up = back[: int(side.sum()) + 1] / back[int(side.sum())]
    over = (back[int(side.sum()) :] - back[int(side.sum())]) / (1 - back[int(side.sum())])
    at[corners[2] : bend + 1] = np.stack([np.full(len(up), hi), lo + (hi - lo) * up], 1)
    top = np.stack([hi + (0.5 - hi) * over, np.full(len(over), hi)], 1)
    at[bend:] = top[:-1]
    start, border = np.full((len(points), 2), 0.5), np.zeros(len(points), np.bool_)
    start[path], border[path] = at, True
    return start, border


def _along(lengths: F64) -> F64:
    """(n + 1,) from 0 to 1 along n lengths."""
    total = np.concatenate([[0.0], np.cumsum(lengths)])
    return np.asarray(total / total[-1], np.float64)


def _sliding(start: F64, border: np.ndarray) -> np.ndarray:
    """(n, 2) what stays held when border vertices may slide along their side of the tile; corners stay."""
    held = np.zeros(start.shape, np.bool_)
    upright = (start[:, 0] == 0.5) | (start[:, 0] == 1 - MARGIN)
    level = (start[:, 1] == MARGIN) | (start[:, 1] == 1 - MARGIN)
    held[:, 0], held[:, 1] = border & upright, border & level
    return held
