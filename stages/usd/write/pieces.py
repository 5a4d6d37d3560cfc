"""The triangles of a mesh by tile and material, for files whose viewers have no UDIM tiles (USDZ, glTF), and how USDZ
holds them: face sets of one mesh, each with its own material.

One mesh, because the inside of the mouth alone would be a surface that faces inwards. Its texture coordinates hold the
tiles side by side in the unit square, so that no two places have the same; each material takes its own part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from pxr import UsdGeom, UsdShade, Vt

from pipeline import tiles
from pipeline.meshes import Charts, Indices, Mask
from stages.usd.write.mesh import UvSurface, on_tile
from stages.usd.write.variants import HAIR, RENDER, REST


@dataclass(frozen=True, slots=True)
class Piece:
    """The triangles of one tile that have one material; texture coordinates in the unit square."""

    tile: int
    eyes: bool
    mesh: UvSurface


def pieces(mesh: UvSurface, count: int, eyes: Mask | None) -> Iterator[Piece]:
    """The pieces of a mesh of `count` tiles. eyes (n,): of its first triangles, those that are eyes."""
    whole = np.zeros(len(mesh.faces), np.bool_)
    if eyes is not None:
        whole[: len(eyes)] = eyes
    tile = tiles.of_face(Charts(mesh.uvs, mesh.uv_faces)) if count > 1 else np.zeros(len(whole), np.int64)
    for t in range(count):
        part, own = on_tile(mesh, t, count), whole[tile == t]
        for is_eye, keep in ((False, ~own), (True, own)):
            if keep.all():
                yield Piece(t, is_eye, part)
            elif keep.any():
                some = UvSurface(part.vertices, part.normals, part.faces[keep], part.uvs, part.uv_faces[keep])
                yield Piece(t, is_eye, some)


def grouped(found: Sequence[Piece], moving: int, hair: int | None = None) -> dict[str, list[Piece]]:
    """The pieces of each mesh by its name: those that use the first `moving` vertices only (which a rig moves), the
    tile `hair`, and the rest. Without a rig (0) all but hair are one mesh."""
    out: dict[str, list[Piece]] = {}
    for piece in found:
        moves = not moving or int(piece.mesh.faces.max()) < moving
        out.setdefault(HAIR if piece.tile == hair else RENDER if moves else REST, []).append(piece)
    return out


def together(parts: Sequence[Piece], count: int) -> tuple[UvSurface, list[Indices]]:
    """Pieces of one mesh as one again, with `count` tiles side by side in the unit square, and the rows of its
    triangles by piece."""
    first = parts[0].mesh
    shift = np.cumsum([0, *(len(p.mesh.uvs) for p in parts)])
    ends = np.cumsum([0, *(len(p.mesh.faces) for p in parts)])
    size = np.array([count, 1], np.float32)
    whole = UvSurface(
        first.vertices,
        first.normals,
        np.concatenate([p.mesh.faces for p in parts]),
        np.concatenate([(p.mesh.uvs + np.array([p.tile, 0], np.float32)) / size for p in parts]),
        np.concatenate([p.mesh.uv_faces + s for p, s in zip(parts, shift, strict=False)]).astype(np.int32),
    )
    return whole, [np.arange(a, b) for a, b in zip(ends, ends[1:], strict=False)]


def bind_pieces(mesh: UsdGeom.Mesh, faces: Sequence[Indices], materials: Sequence[UsdShade.Material]) -> None:
    """Give rows of faces their materials as face sets. The mesh itself has the first, for programs that know none."""
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(materials[0])
    if len(materials) == 1:
        return
    sets = face_sets(mesh, faces, [m.GetPrim().GetName() for m in materials])
    for one, material in zip(sets, materials, strict=True):
        UsdShade.MaterialBindingAPI.Apply(one.GetPrim()).Bind(material)


def face_sets(mesh: UsdGeom.Mesh, faces: Sequence[Indices], names: Sequence[str]) -> list[UsdGeom.Subset]:
    """Rows of faces as face sets of materials. Together they are all faces: importers that know a mesh by its face sets
    only lose none."""
    made = [
        UsdGeom.Subset.CreateGeomSubset(
            mesh, name, UsdGeom.Tokens.face, Vt.IntArray(rows.astype(np.int32).tolist()),
            UsdShade.Tokens.materialBind, UsdGeom.Tokens.nonOverlapping,
        )
        for rows, name in zip(faces, names, strict=True)
    ]  # fmt: skip
    UsdGeom.Subset.SetFamilyType(mesh, UsdShade.Tokens.materialBind, UsdGeom.Tokens.partition)
    return made
