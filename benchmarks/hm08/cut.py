"""Cuts the head and what belongs to it out of the base mesh: parts, joints and mirror with their own vertex numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from benchmarks.hm08.source import Source
from pipeline.meshes import F64, Indices

NECK, SLOPE = (
    6.1,
    -0.4,
)  # quads of the body with y > NECK + SLOPE z (decimetres) are the head's: ends at a loop of edges
WIDE = 1.1  # from the middle: the arms rise above the neck
PARTS = {  # name: groups of the base mesh, the skin aside
    "eye_left": ("helper-l-eye",),
    "eye_right": ("helper-r-eye",),
    "teeth_upper": ("helper-upper-teeth",),
    "teeth_lower": ("helper-lower-teeth",),
    "tongue": ("helper-tongue",),
    "lashes_left": ("helper-l-eyelashes-1", "helper-l-eyelashes-2"),
    "lashes_right": ("helper-r-eyelashes-1", "helper-r-eyelashes-2"),
}
JOINTS = {  # name: the base mesh's cube whose middle it is
    "head": "joint-head",
    "head_top": "joint-head-2",
    "neck": "joint-neck",
    "jaw": "joint-mouth",
    "chin": "joint-jaw",
    "eye_left": "joint-l-eye",
    "eye_right": "joint-r-eye",
}


@dataclass(frozen=True, slots=True)
class Cut:
    """rows (V,) the base mesh's vertex of each of ours; quads (Q, 4) ours, part after part; parts: name -> (first
    quad, end); source_uv (Q, 4) the base mesh's texture vertices; mirror (V,); cubes: joint -> its eight vertices."""

    rows: Indices
    quads: Indices
    parts: dict[str, tuple[int, int]]
    source_uv: Indices
    mirror: Indices
    cubes: dict[str, Indices]

    def part(self, name: str) -> Indices:
        """(n, 4) quads of a part."""
        first, end = self.parts[name]
        return self.quads[first:end]


def cut_head(source: Source) -> Cut:
    """Head and neck, eyes, teeth, tongue and lashes."""
    middle = source.vertices[source.quads].mean(1)
    head = (source.group == "body") & (middle[:, 1] > NECK + SLOPE * middle[:, 2]) & (np.abs(middle[:, 0]) < WIDE)
    chosen, parts, first = [], {}, 0
    for name, groups in {"skin": None, **PARTS}.items():
        faces = np.flatnonzero(head if groups is None else np.isin(source.group, groups))
        chosen.append(faces)
        parts[name] = (first, first + len(faces))
        first += len(faces)
    faces = np.concatenate(chosen)
    quads = source.quads[faces]
    rows = _in_order(quads)
    new = np.full(len(source.vertices), -1)
    new[rows] = np.arange(len(rows))
    mirror = new[source.mirror[rows]]
    if (mirror < 0).any():
        raise SystemExit("the mirror leads out of the head")
    cubes = {j: np.unique(source.quads[source.group == g]) for j, g in JOINTS.items()}
    return Cut(rows, new[quads], parts, source.uv_quads[faces], mirror, cubes)


def _in_order(quads: Indices) -> Indices:
    """Vertices in the order in which faces first use them, so that each part's are together."""
    values, first = np.unique(quads, return_index=True)
    return np.asarray(values[np.argsort(first)], np.int64)


def islands(cut: Cut, name: str = "skin") -> list[Indices]:
    """Quads of a part, by the base mesh's texture islands, the largest first. Of the skin: face with scalp, mouth
    inside, neck, and the sockets of the two eyes."""
    first, end = cut.parts[name]
    uv = cut.source_uv[first:end]
    sides = uv[:, [[0, 1], [1, 2], [2, 3], [3, 0]]].reshape(-1, 2)
    n = int(uv.max()) + 1
    graph = coo_array((np.ones(len(sides), np.int8), (sides[:, 0], sides[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1][uv[:, 0]]
    found = [first + np.flatnonzero(label == x) for x in np.unique(label)]
    return sorted(found, key=lambda q: -len(q))


def joint_centres(points: F64, cut: Cut) -> F64:
    """(J, 3) of points (N, 3) of the base mesh."""
    return np.stack([points[rows].mean(0) for rows in cut.cubes.values()])
