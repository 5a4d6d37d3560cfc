"""The expressions of an exported asset: its control cage, and the cage's points under each blend shape."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from pipeline.errors import StageError
from pipeline.meshes import F64, Indices

MESH_VARIANT = "mesh"
TEMPLATE = "template"
UVS = "st"


@dataclass(frozen=True, slots=True)
class ControlCage:
    """points (V, 3) metres, +Y up; faces (F,) vertices of each face; corners, uv_corners (C,) into points and uvs
    (U, 2), of all tiles; shapes: name -> rows (n,) and offsets (n, 3) at weight 1."""

    points: F64
    faces: Indices
    corners: Indices
    uvs: F64
    uv_corners: Indices
    shapes: dict[str, tuple[Indices, F64]]

    def under(self, name: str) -> F64:
        """(V, 3) points with the shape of this name at weight 1."""
        out = self.points.copy()
        rows, offsets = self.shapes[name]
        out[rows] += offsets
        return out


def load_cage(root: Path) -> ControlCage:
    """The cage of NAME.usd with its blend shapes, in their order.

    Raises:
        StageError: the file can't be opened, or has no mesh with blend shapes.
    """
    try:
        stage = Usd.Stage.Open(str(root))
    except Exception as e:
        raise _without(root, "not a USD file") from e
    _select_template(stage)
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh) and UsdSkel.BindingAPI(prim).GetBlendShapeTargetsRel().GetTargets():
            return _cage(UsdGeom.Mesh(prim))
    raise _without(root, "no mesh with blend shapes")


def _select_template(stage: Usd.Stage) -> None:
    """Show the template's mesh, where the asset has that of the scan too. Nothing is written."""
    stage.SetEditTarget(stage.GetSessionLayer())
    root = stage.GetDefaultPrim()
    if root and TEMPLATE in root.GetVariantSet(MESH_VARIANT).GetVariantNames():
        root.GetVariantSet(MESH_VARIANT).SetVariantSelection(TEMPLATE)


def _cage(mesh: UsdGeom.Mesh) -> ControlCage:
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(UVS)
    uvs = np.array(st.Get(), np.float64)
    indices = np.array(st.GetIndices(), np.int64) if st.IsIndexed() else np.arange(len(uvs))
    points = np.array(mesh.GetPointsAttr().Get(), np.float64)
    return ControlCage(
        points,
        np.array(mesh.GetFaceVertexCountsAttr().Get(), np.int64),
        np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int64),
        uvs,
        indices,
        dict(_shapes(mesh, len(points))),
    )


def _shapes(mesh: UsdGeom.Mesh, count: int) -> Iterator[tuple[str, tuple[Indices, F64]]]:
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    targets = binding.GetBlendShapeTargetsRel().GetTargets()
    for name, target in zip(binding.GetBlendShapesAttr().Get(), targets, strict=True):
        shape = UsdSkel.BlendShape.Get(mesh.GetPrim().GetStage(), target)
        offsets = np.array(shape.GetOffsetsAttr().Get(), np.float64).reshape(-1, 3)
        rows = shape.GetPointIndicesAttr().Get()
        yield str(name), (np.arange(count) if rows is None else np.array(rows, np.int64), offsets)


def _without(root: Path, value: str) -> StageError:
    return StageError(
        "this asset has no expressions",
        where=root,
        value=value,
        limit="an asset with the head template's mesh and usd.expressions",
        remedy="run again with --set uv.mesh=template",
    )
