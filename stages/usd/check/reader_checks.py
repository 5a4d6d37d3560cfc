"""Checks that each face lies in the pictures that its own material reads.

A material of one tile moves the texture coordinates into the unit square of that tile's file (UsdTransform2d). A face
of another tile would then show the picture's border. The USD library does not look at this.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from pxr import Usd, UsdGeom, UsdShade

from stages.usd.check.findings import Finding

F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
TRANSFORM, TEXTURE = "UsdTransform2d", "UsdUVTexture"
SLACK = 1e-4  # of a picture: rounding of coordinates that are scaled


def bound_faces(mesh: UsdGeom.Mesh) -> Iterator[tuple[UsdShade.Material, Mask]]:
    """Each material of a mesh that has one, with its faces (F,): those of its face sets, and the others."""
    rest = np.ones(len(mesh.GetFaceVertexCountsAttr().Get()), np.bool_)
    for one in UsdShade.MaterialBindingAPI(mesh.GetPrim()).GetMaterialBindSubsets():
        own = np.zeros_like(rest)
        own[np.array(one.GetIndicesAttr().Get(), np.int64)] = True
        rest &= ~own
        yield UsdShade.MaterialBindingAPI(one.GetPrim()).ComputeBoundMaterial()[0], own
    if rest.any():
        yield UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0], rest


def moves(mesh: UsdGeom.Mesh) -> bool:
    """Whether a material of the mesh moves its texture coordinates."""
    return any(_transforms(t) for material, _ in bound_faces(mesh) for t in _clamped(material))


def reader_findings(mesh: UsdGeom.Mesh, st: F64) -> list[Finding]:
    """Findings on texture coordinates st (N, 2) of all faces' corners, as clamped readers have them: a picture that
    repeats has no outside."""
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(), np.int64)
    start, out = np.cumsum(counts) - counts, []
    for material, faces in bound_faces(mesh):
        for texture in _clamped(material):
            at = st
            for scale, turn, shift in _transforms(texture):
                at = (at * scale) @ turn.T + shift
            beside = np.maximum.reduceat(np.abs(at - 0.5).max(1), start) > 0.5 + SLACK
            outside = int((beside & faces).sum())
            if outside:
                text = f"{outside} faces lie outside of the picture of {texture.GetPath()}"
                out.append(Finding("error", "st", text, str(mesh.GetPath())))
                break  # all readers of a material move them alike
    return out


def _clamped(material: UsdShade.Material) -> list[UsdShade.Shader]:
    """The readers of a material's preview surface, of one file each, that clamp."""
    found = []
    for prim in _closure(material):
        shader = UsdShade.Shader(prim)
        file = shader.GetInput("file")
        if shader.GetShaderId() != TEXTURE or not file or not file.Get():
            continue
        wraps = [shader.GetInput(n) for n in ("wrapS", "wrapT")]
        clamped = all(w and w.Get() == "clamp" for w in wraps)
        if clamped and not UsdShade.UdimUtils.IsUdimIdentifier(file.Get().path):
            found.append(shader)
    return found


def _closure(material: UsdShade.Material) -> list[Usd.Prim]:
    """The shaders of a material's surface in the universal context."""
    surface = material.ComputeSurfaceSource()[0] if material else None
    found = [surface.GetPrim()] if surface else []
    for prim in found:
        for source in (s for i in UsdShade.Shader(prim).GetInputs() for s in i.GetConnectedSources()[0]):
            other = source.source.GetPrim()
            if other.IsA(UsdShade.Shader) and other not in found:
                found.append(other)
    return found


def _transforms(texture: UsdShade.Shader) -> list[tuple[F64, F64, F64]]:
    """Scale, rotation and translation of each UsdTransform2d before a reader, in the order in which they are applied.

    UsdTransform2d (UsdPreviewSurface specification): in * scale, rotated counter-clockwise in degrees, plus
    translation.
    """
    out, given = [], texture.GetInput("st")
    while given and given.GetConnectedSources()[0]:
        node = UsdShade.Shader(given.GetConnectedSources()[0][0].source.GetPrim())
        if not node or node.GetShaderId() != TRANSFORM:
            break
        scale, shift = (
            np.array(_value(node, n, d), np.float64) for n, d in (("scale", (1, 1)), ("translation", (0, 0)))
        )
        angle = np.radians(float(_value(node, "rotation", 0.0)))  # type: ignore[arg-type]
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        out.append((scale, turn, shift))
        given = node.GetInput("in")
    return out[::-1]


def _value(node: UsdShade.Shader, name: str, default: object) -> object:
    found = node.GetInput(name)
    value = found.Get() if found else None
    return default if value is None else value
