"""The template: one mesh of quads for all heads, with what is known about its places.

Symbols: V vertices (V, 3) metres in asset coordinates (+Y up, +Z out of the face, origin in the head's middle); Q quads
(Q, 4), counter-clockwise seen from outside; L landmarks; K components of identity; J joints.

    x(w) = mean + sum_k w_k deviation_k basis_k

A person's weights w are in standard deviations: they are independent and of variance one over the persons sampled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.errors import UsageError
from pipeline.meshes import F64, Faces, Indices, Mask, triangles_of

SKIN = "skin"  # the part that every template has
LEFT_OUT = ("lashes",)  # regions that the asset leaves out: they need a material with opacity


@dataclass(frozen=True, slots=True)
class Points:
    """Places on the surface: names, network (L,) number among the face network's landmarks (pipeline.faces), corners
    (L, 3) vertices and weights (L, 3) that sum to one."""

    names: tuple[str, ...]
    network: Indices
    corners: Indices
    weights: F64


@dataclass(frozen=True, slots=True)
class IdentityBasis:
    """basis (K, V, 3) orthonormal, by falling deviation (K,) in metres; symmetric (K,): mirrored it stays as it is,
    else it changes its sign. joints (K, J, 3): what the joints do per unit of the basis."""

    basis: F64
    deviation: F64
    symmetric: Mask
    joints: F64


@dataclass(frozen=True, slots=True)
class Expressions:
    """Offsets of few vertices each: those of expression e are rows starts[e] to starts[e + 1] of vertices (n,) and
    offsets (n, 3) in metres."""

    names: tuple[str, ...]
    starts: Indices
    vertices: Indices
    offsets: F64


@dataclass(frozen=True, slots=True)
class Template:
    """parts and regions: name -> quads; each quad is in one of either. uvs (U, 2), uv_quads (Q, 4) into them, UDIM
    tiles in one row. mirror (V,) the vertex on the other side, itself in the middle. joints: name -> (3,)."""

    name: str
    licence: str
    licence_text: str
    vertices: F64
    quads: Indices
    parts: Mapping[str, Indices]
    regions: Mapping[str, Indices]
    uvs: F64
    uv_quads: Indices
    mirror: Indices
    landmarks: Points
    joints: Mapping[str, F64]
    shape: IdentityBasis | None
    expressions: Expressions | None

    def identity(self, weights: npt.ArrayLike) -> F64:
        """(V, 3) vertices of a person; weights (k,), k <= K, of the first components."""
        w = np.asarray(weights, np.float64)
        if self.shape is None:
            return self.vertices.copy()
        scaled = w * self.shape.deviation[: len(w)]
        return np.asarray(self.vertices + np.tensordot(scaled, self.shape.basis[: len(w)], 1), np.float64)

    def joints_of(self, weights: npt.ArrayLike) -> dict[str, F64]:
        """The joints of the person of `identity`."""
        w = np.asarray(weights, np.float64)
        if self.shape is None:
            return dict(self.joints)
        moved = np.tensordot(w * self.shape.deviation[: len(w)], self.shape.joints[: len(w)], 1)
        return {n: x + d for (n, x), d in zip(self.joints.items(), moved, strict=True)}

    def expression(self, name: str) -> F64:
        """(V, 3) offsets of an expression at full strength. UsageError names those that there are."""
        names = self.expressions.names if self.expressions else ()
        if self.expressions is None or name not in names:
            raise UsageError(
                "the template has no such expression",
                where=self.name,
                value=name,
                limit=", ".join(names) or "none: the template has no expressions",
                remedy="choose one of these",
            )
        e = names.index(name)
        rows = slice(int(self.expressions.starts[e]), int(self.expressions.starts[e + 1]))
        out = np.zeros_like(self.vertices)
        out[self.expressions.vertices[rows]] = self.expressions.offsets[rows]
        return out

    def landmark_points(self, vertices: F64) -> F64:
        """(L, 3) the landmarks on the surface of vertices (V, 3)."""
        return np.asarray((vertices[self.landmarks.corners] * self.landmarks.weights[..., None]).sum(1), np.float64)

    def triangles(self) -> Faces:
        """(2 Q, 3): quad q is triangles 2 q and 2 q + 1, cut from its first to its third corner."""
        return triangles_of(self.quads)

    def region_weights(self, name: str) -> F64:
        """(V,) share of each vertex's quads that belong to a region: soft at its border."""
        inside = np.bincount(self.quads[self.regions[name]].ravel(), minlength=len(self.vertices))
        every = np.bincount(self.quads.ravel(), minlength=len(self.vertices))
        return np.asarray(inside / np.maximum(every, 1), np.float64)

    def part_vertices(self, name: str) -> Indices:
        """(n,) vertices of a part."""
        return np.asarray(np.unique(self.quads[self.parts[name]]), np.int64)
