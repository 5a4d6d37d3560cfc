"""The eyes' own material, and which faces have it: the wet cornea over the captured colours of sclera and iris.

The eyes lie on a tile that they share with teeth and tongue; they read the same files as the head's material.
"""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom, UsdShade, Vt

from pipeline.eyes.material import IOR, ROUGHNESS
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import Mask
from pipeline.registration.head import Head
from stages.usd.write.materialx import eye_network
from stages.usd.write.shading import Look, eye_preview

EYES = "eyes"  # name of the material and of the faces that have it


def eye_quads(head: Head, found: RegisteredHead) -> Mask:
    """(Q,) quads of the cage that are fitted eyes."""
    fitted = [found.parts.index(eye.part) for eye in found.eyes]
    return np.asarray(np.isin(head.part, fitted), np.bool_)


def eye_material(stage: Usd.Stage, path: str, look: Look, part: tuple[int, int] = (0, 1)) -> UsdShade.Material:
    """Author the eyes' material with the files of the head's; in MaterialX too where that has such networks. part: of
    the texture coordinates (write/shading.py)."""
    material = UsdShade.Material.Define(stage, path)
    eye_preview(stage, material, look, IOR, ROUGHNESS, part)
    if look.roughness and look.f0:
        eye_network(stage, material, look, IOR, ROUGHNESS)
    return material


def bind_eyes(mesh: UsdGeom.Mesh, faces: Mask, eyes: UsdShade.Material, rest: UsdShade.Material) -> None:
    """Give faces (F,) of a mesh the eyes' material, and the others, as a subset too, that of the rest: importers that
    know subsets only by all faces lose none."""
    for name, own, material in ((EYES, faces, eyes), ("skin", ~faces, rest)):
        rows = Vt.IntArray(np.flatnonzero(own).astype(np.int32).tolist())
        subset = UsdGeom.Subset.CreateGeomSubset(
            mesh, name, UsdGeom.Tokens.face, rows, UsdShade.Tokens.materialBind, UsdGeom.Tokens.nonOverlapping
        )
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    UsdGeom.Subset.SetFamilyType(mesh, UsdShade.Tokens.materialBind, UsdGeom.Tokens.partition)
