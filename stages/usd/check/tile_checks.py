"""Checks of textures in UDIM tiles: every tile that a mesh needs must exist, and the maps of a tile must have the same
size. (Tiles may differ; a map of another size than its tile's others is from another export.)

The USD library does not report a missing tile; renderers show it black.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pxr import Sdf, Usd, UsdGeom, UsdShade

from pipeline import tiles
from stages.usd.check.findings import Finding

F64 = npt.NDArray[np.float64]
SLACK = 1e-5  # of a tile: rounding of coordinates on a border


def is_tiled(path: str) -> bool:
    """Whether a path contains <UDIM>."""
    return bool(UsdShade.UdimUtils.IsUdimIdentifier(path))


def tiled(mesh: UsdGeom.Mesh) -> bool:
    """Whether the material of a mesh reads textures in tiles."""
    material = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
    return bool(material) and any(is_tiled(p) for p in _asset_paths(material.GetPrim()))


def _asset_paths(material: Usd.Prim) -> list[str]:
    found = []
    for prim in Usd.PrimRange(material):
        for attribute in prim.GetAttributes():
            if attribute.GetTypeName() == Sdf.ValueTypeNames.Asset and attribute.Get():
                found.append(str(attribute.Get().path))
    return found


def coordinate_findings(mesh: UsdGeom.Mesh, st: F64) -> list[Finding]:
    """Texture coordinates (N, 2) of all faces' corners must be inside the row of tiles, and no face in two of them."""
    where = str(mesh.GetPath())
    if (
        st[:, 0].min() < -SLACK
        or st[:, 0].max() > tiles.MAX_TILES + SLACK
        or np.abs(st[:, 1] - 0.5).max() > 0.5 + SLACK
    ):
        found = f"from {st.min():.4f} to {st.max():.4f}, expected 0 to {tiles.MAX_TILES} across and 0 to 1 up"
        return [Finding("error", "st", found, where)]
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(), np.int64)
    start = np.cumsum(counts) - counts
    low, high = np.minimum.reduceat(st[:, 0], start), np.maximum.reduceat(st[:, 0], start)
    across = int((np.floor(low + SLACK) < np.ceil(high - SLACK) - 1).sum())
    return [Finding("error", "st", f"{across} faces are in two UDIM tiles", where)] if across else []


def needed(stage: Usd.Stage) -> set[str]:
    """Numbers of the tiles that contain faces of meshes with textures in tiles."""
    out: set[str] = set()
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        mesh = UsdGeom.Mesh(prim)
        st = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
        if not mesh or not st or not st.HasAuthoredValue() or not tiled(mesh):
            continue
        u = np.array(st.ComputeFlattened(), np.float64)[:, 0]
        out |= {str(tiles.FIRST + int(t)) for t in np.unique(np.floor((u - SLACK).clip(0)))}
    return out


def tile_files(path: str, stage: Usd.Stage, attribute: Usd.Attribute) -> dict[str, str]:
    """The existing files of a path with <UDIM>, by tile number."""
    layers = [spec.layer for spec in attribute.GetPropertyStack()] or [stage.GetRootLayer()]
    return {number: file for file, number in UsdShade.UdimUtils.ResolveUdimTilePaths(path, layers[0])}


def named(path: str, number: str) -> str:
    """The path of one tile."""
    return str(UsdShade.UdimUtils.ReplaceUdimPattern(path, number))


def missing(path: str, files: dict[str, str], wanted: set[str], where: str) -> list[Finding]:
    """A finding for each tile that there is no file of."""
    return [
        Finding("error", "missing_texture", f"{named(path, number)} is missing", where)
        for number in sorted(wanted - files.keys())
    ]


def of_other_size(sizes: dict[str, set[tuple[int, ...]]], where: str) -> list[Finding]:
    """A finding for each tile whose maps have different sizes. sizes: by the tile's number."""
    out = []
    for number, found in sorted(sizes.items()):
        if len(found) > 1:
            text = " and ".join("x".join(map(str, s)) for s in sorted(found))
            out.append(Finding("error", "tile_size", f"the maps of tile {number} have different sizes: {text}", where))
    return out
