"""The materials of the asset's tiles: which there are, what they are called, and which faces have which.

Each tile has a material whose preview surface reads the files of that tile, and a face set in each mesh that has it. So
programs without <UDIM> show every tile, and an artist has skin, mouth, clothes and hair apart. Texture coordinates stay
those of UDIM: a material moves them (write/shading.py), and MaterialX networks read the row of tiles.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdGeom, UsdShade

from pipeline import tiles
from pipeline.meshes import Charts, Indices, Mask
from stages.usd.write.cage import TemplateMesh
from stages.usd.write.eyes import EYES, eye_material
from stages.usd.write.materialx import materialx_networks
from stages.usd.write.mesh import UvSurface
from stages.usd.write.pieces import bind_pieces, face_sets
from stages.usd.write.shading import MATERIAL, Look, Part, preview_networks
from stages.usd.write.variants import HAIR

SKIN, MOUTH, EYES_AND_MOUTH = "skin", "mouth", "eyes_and_mouth"
CLOTHES = "clothes"  # of what lies beside the template: also shoulders, and hair that was not told apart

Made = Mapping["TileMaterial", UsdShade.Material]


@dataclass(frozen=True, slots=True)
class TileMaterial:
    """The material of one tile's faces, of fitted eyes or of the others. displaced: of a mesh that is subdivided."""

    name: str
    tile: int
    eyes: bool = False
    displaced: bool = True


def tile_materials(mesh: UvSurface | TemplateMesh, base: str = MATERIAL) -> tuple[TileMaterial, ...]:
    """The materials of a mesh, the skin's first. What they show is known of the head template only; others have the
    name `base`. A name that several tiles share ends with the tile's number."""
    found = [TileMaterial(base, t) for t in _tiles(mesh)] if isinstance(mesh, UvSurface) else list(_of_template(mesh))
    if len({m.tile for m in found}) == 1:
        return tuple(m if m.eyes else replace(m, name=base) for m in found)
    often = Counter(m.name for m in found)
    return tuple(m if often[m.name] == 1 else replace(m, name=f"{m.name}_{tiles.FIRST + m.tile}") for m in found)


def _of_template(mesh: TemplateMesh) -> Iterator[TileMaterial]:
    cage = mesh.cage
    tile = tiles.of_face(Charts(cage.uvs, cage.uv_quads.astype(np.int32)))
    for t in np.unique(tile).tolist():
        own = tile == t
        eyes = bool(cage.eyes[own].any())
        inside = MOUTH if eyes else EYES_AND_MOUTH
        yield TileMaterial(SKIN if cage.outer[own].mean() > 0.5 else inside, t)
        if eyes:
            yield TileMaterial(EYES, t, eyes=True)
    for name, part in ((CLOTHES, mesh.rest), (HAIR, mesh.hair)):
        for t in [] if part is None else _tiles(part):
            yield TileMaterial(name, t, displaced=False)


def _tiles(mesh: UvSurface) -> list[int]:
    return list(np.unique(tiles.of_face(Charts(mesh.uvs, mesh.uv_faces))).tolist())


def skins(materials: Sequence[TileMaterial]) -> tuple[str, ...]:
    """Names of all but the eyes' materials: those with the looks of the variant set."""
    return tuple(m.name for m in materials if not m.eyes)


def scattering(materials: Sequence[TileMaterial]) -> tuple[str, ...]:
    """Names of the materials that show skin: those that may scatter light below the surface."""
    other = (MOUTH, EYES_AND_MOUTH, CLOTHES, HAIR)
    return tuple(m.name for m in materials if not m.eyes and not m.name.startswith(other))


def names_on(mesh: UvSurface, materials: Sequence[TileMaterial]) -> tuple[str, ...]:
    """Names of the materials that a mesh without eyes of its own needs (the dense mesh)."""
    used = set(_tiles(mesh))
    return tuple(m.name for m in materials if m.tile in used and not m.eyes)


def write_materials(
    stage: Usd.Stage,
    scope: str,
    materials: Sequence[TileMaterial],
    look: Look,
    hair: Look | None = None,
    across: int = 1,
) -> Made:
    """Author the materials below a scope. hair: the look of HAIR. across: tiles that the texture coordinates have in
    the unit square."""
    made, skin = {}, scattering(materials)
    for m in materials:
        own = hair if m.name == HAIR and hair is not None else look if m.displaced else replace(look, displacement=None)
        path, part = f"{scope}/{m.name}", Part(m.tile, across)
        if m.name not in skin:
            own = replace(own, subsurface=None)
        if m.eyes:
            made[m] = eye_material(stage, path, own, part)
            continue
        made[m] = UsdShade.Material.Define(stage, path)
        preview_networks(stage, made[m], own, part)
        materialx_networks(stage, made[m], own)
    return made


def bind_tiles(mesh: UsdGeom.Mesh, made: Made, eyes: Mask | None = None) -> None:
    """Give each face of an authored mesh the material of its tile. eyes (F,): faces that are fitted eyes."""
    tile = _tile_of_face(mesh)
    eye = np.zeros(len(tile), np.bool_) if eyes is None else eyes
    rows = {m: np.flatnonzero((tile == m.tile) & (eye == m.eyes)) for m in made}
    used = [m for m in made if len(rows[m])]
    bind_pieces(mesh, [rows[m] for m in used], [made[m] for m in used])


def split_by_tile(mesh: UsdGeom.Mesh, materials: Sequence[TileMaterial]) -> None:
    """Face sets of an authored mesh by tile, without materials: these are bound where the mesh is loaded."""
    tile = _tile_of_face(mesh)
    sets = {m.name: np.flatnonzero(tile == m.tile) for m in materials if not m.eyes}
    used = {name: rows for name, rows in sets.items() if len(rows)}
    if len(used) > 1:
        face_sets(mesh, list(used.values()), list(used))


def _tile_of_face(mesh: UsdGeom.Mesh) -> Indices:
    """(F,) tile of each face, by the mean of its corners."""
    u = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened(), np.float64)[:, 0]
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(), np.int64)
    mean = np.add.reduceat(u, np.cumsum(counts) - counts) / counts
    return np.asarray(np.floor(mean).clip(0), np.int64)
