"""Tangent frames of a mesh with charts, which define x and y of a normal map.

Symbols
    N       interpolated vertex normal, unit
    T       direction of growing u, orthogonal to N, unit
    B       s cross(N, T), direction of growing v; s = -1 in mirrored charts

As in MikkTSpace: a face's direction of growing u is projected onto the plane of each corner's normal, normalised,
weighted by the corner's angle and summed over the corners that share position, normal, texture coordinate and s.
Differs: T is made orthogonal to the interpolated N and both are normalised, as real-time and path-traced shaders do;
MikkTSpace uses them as interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.meshes import F32, F64, Charts, Indices, Mesh


@dataclass(frozen=True, slots=True)
class Frames:
    """tangent (F, 3, 3) unit, one per corner; sign (F,) handedness of the chart."""

    tangent: F32
    sign: F32


def frames(mesh: Mesh, charts: Charts) -> Frames:
    """Tangents at every corner. A corner without a direction (no texture area around it) gets an arbitrary one."""
    x = mesh.vertices.astype(np.float64)[mesh.faces]
    t = charts.uvs.astype(np.float64)[charts.faces]
    n = mesh.normals.astype(np.float64)[mesh.faces]
    e1, e2, d1, d2 = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    twice = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    sign = np.where(twice < 0, -1.0, 1.0)
    along_u = sign[:, None] * (e1 * d2[:, 1:] - e2 * d1[:, 1:])
    along_u[twice == 0] = 0
    group = charts.faces.astype(np.int64) + len(charts.uvs) * (sign < 0)[:, None]
    total = np.zeros((2 * len(charts.uvs), 3))
    for i in range(3):
        corner = _unit(along_u - n[:, i] * (n[:, i] * along_u).sum(1, keepdims=True))
        weighted = corner * _angle(x, n[:, i], i)[:, None]
        for axis in range(3):
            total[:, axis] += np.bincount(group[:, i], weighted[:, axis], len(total))
    mean = total[group]
    lost = (mean * mean).sum(-1) < 1e-12
    mean[lost] = any_across(n[lost])
    return Frames(_unit(mean).astype(np.float32), sign.astype(np.float32))


def at(frame: Frames, mesh: Mesh, face: Indices, weights: npt.NDArray[np.floating]) -> tuple[F64, F64, F64]:
    """T, B, N (M, 3 each) at points of faces (M,) given by barycentric weights (M, 3)."""
    w = np.asarray(weights, np.float64)
    normal = _unit(mixed(mesh.normals[mesh.faces[face]], w))
    raw = mixed(frame.tangent[face], w)
    tangent = raw - normal * dot(normal, raw)[:, None]
    lost = dot(tangent, tangent) < 1e-12
    tangent[lost] = any_across(normal[lost])
    tangent = _unit(tangent)
    return tangent, np.cross(normal, tangent) * frame.sign[face, None], normal


def mixed(corners: npt.NDArray[Any], weights: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(M, C) values of corners (M, 3, C), weighted by barycentric weights (M, 3). Faster than a product and sum."""
    return np.asarray(np.einsum("mic,mi->mc", corners, weights))


def dot(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(...,) scalar products of rows (..., C)."""
    return np.asarray(np.einsum("...c,...c->...", a, b))


def _angle(x: F64, normal: F64, i: int) -> F64:
    """(F,) angle at corner i, between the sides projected along the corner's normal."""
    sides = []
    for j in (1, 2):
        side = x[:, (i + j) % 3] - x[:, i]
        sides.append(_unit(side - normal * (normal * side).sum(1, keepdims=True)))
    out: F64 = np.arccos((sides[0] * sides[1]).sum(1).clip(-1, 1))
    return out


def any_across(n: F64) -> F64:
    """(M, 3) arbitrary unit vectors orthogonal to n (M, 3)."""
    axis = np.eye(3)[np.abs(n).argmin(1)] if len(n) else np.zeros((0, 3))
    return _unit(np.cross(axis, n))


def _unit(v: F64) -> F64:
    out: F64 = v / np.maximum(np.sqrt(dot(v, v))[..., None], 1e-30)
    return out
