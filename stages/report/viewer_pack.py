"""Meshes as text for the 3D view: numbers on a fixed lattice, as differences from row to row, in planes of bytes.

Neighbouring rows are neighbours on the surface, so that the high bytes of differences are mostly 0, and gzip stores
them in few bits. `viewer/meshes.js` is the inverse.

    positions   lattice of 2^14 steps over the longest side of the mesh's box: 0.03 mm of a head
    normals     512 steps to one: 0.1 degree
    uvs         lattice of 2^15 steps in the tile's unit square, v downwards as in glTF
"""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline import tiles
from pipeline.meshes import Charts, Mesh, split_at_seams

POSITION_STEPS, NORMAL_STEPS, UV_STEPS = (1 << 14) - 1, 511, (1 << 15) - 1
F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Packed:
    """A mesh in the page. parts: tile, vertices and faces of each of its pieces, in the order of the data; low (m) and
    step (m): of the lattice of positions."""

    faces: int
    low: tuple[float, float, float]
    step: float
    parts: tuple[dict[str, int], ...]
    text: str

    def head(self) -> dict[str, Any]:
        """All but the data."""
        return {"faces": self.faces, "low": self.low, "step": self.step, "parts": self.parts}


def pack(mesh: Mesh, charts: Charts) -> Packed:
    """One piece for each tile that has faces. Vertices are split where a chart ends."""
    low, high = mesh.vertices.min(0).astype(np.float64), mesh.vertices.max(0).astype(np.float64)
    step = max(float((high - low).max()), 1e-9) / POSITION_STEPS
    parts, content = [], []
    for tile in range(tiles.count(charts)):
        own, laid = tiles.single_tile(mesh, charts, tile)
        if len(own.faces):
            vertex, uv, faces = split_at_seams(own.faces, laid.faces)
            parts.append({"tile": tile, "vertices": len(vertex), "faces": len(faces)})
            flat = laid.uvs[uv].astype(np.float64).clip(0, 1) * [1, -1] + [0, 1]
            content += [
                planes(np.round((own.vertices[vertex] - low) / step).astype(np.uint16)),
                planes(np.round(own.normals[vertex] * NORMAL_STEPS).astype(np.int16)),
                planes(np.round(flat * UV_STEPS).astype(np.uint16)),
                planes(faces.astype(np.uint32).reshape(-1, 1)),
            ]
    text = base64.b64encode(gzip.compress(b"".join(content), 6, mtime=0)).decode()
    return Packed(len(mesh.faces), (float(low[0]), float(low[1]), float(low[2])), step, tuple(parts), text)


def planes(values: npt.NDArray[Any]) -> bytes:
    """(N, C) integers of 16 or 32 bits: for each column the differences of the rows, modulo their type, the low bytes
    of all rows first."""
    unsigned = values.view(np.dtype(f"u{values.itemsize}"))
    steps = np.diff(unsigned, axis=0, prepend=np.zeros((1, values.shape[1]), unsigned.dtype))
    columns = np.ascontiguousarray(steps.T).view(np.uint8).reshape(values.shape[1], len(values), values.itemsize)
    return np.ascontiguousarray(columns.transpose(0, 2, 1)).tobytes()
