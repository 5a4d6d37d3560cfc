"""The eyes' own material, and which faces have it: the wet cornea over the captured colours of sclera and iris.

The eyes lie on a tile that they share with teeth and tongue; they read the same files as that tile's material.
"""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdShade

from pipeline.eyes.material import IOR, ROUGHNESS
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import Mask
from pipeline.registration.head import Head
from stages.usd.write.materialx import eye_network
from stages.usd.write.shading import WHOLE, Look, Part, eye_preview

EYES = "eyes"  # name of the material and of the faces that have it


def eye_quads(head: Head, found: RegisteredHead) -> Mask:
    """(Q,) quads of the cage that are fitted eyes."""
    fitted = [found.parts.index(eye.part) for eye in found.eyes]
    return np.asarray(np.isin(head.part, fitted), np.bool_)


def eye_material(stage: Usd.Stage, path: str, look: Look, part: Part = WHOLE) -> UsdShade.Material:
    """Author the material of the eyes on a tile; in MaterialX too where the head has such networks."""
    material = UsdShade.Material.Define(stage, path)
    eye_preview(stage, material, look, IOR, ROUGHNESS, part)
    if look.roughness and look.f0:
        eye_network(stage, material, look, IOR, ROUGHNESS)
    return material
