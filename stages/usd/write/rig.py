"""Expressions and joints of the registered head in USD: blend shapes and a skeleton (UsdSkel).

geo (SkelRoot)
  rig (Skeleton: head, head/jaw, head/eye_left, head/eye_right)
    animation (SkelAnimation: every weight 0, every joint at rest)
  render (Mesh, bound to rig)
    jawOpen, ... (BlendShape: offsets of the points that it moves)
  hair (Mesh, if there is hair: follows the joint head and no expression)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from scipy.sparse import csr_array, eye_array

from pipeline.meshes import F64, Indices
from pipeline.registration.rig import Rig

LEAST = 5e-6  # metres: offsets below this are not written
RIG, ANIMATION = "rig", "animation"
INFLUENCES = 2  # joints of a point: the head and one other


@dataclass(frozen=True, slots=True)
class Shape:
    """An expression of a mesh: rows (n,) of the vertices that it moves, offsets (n, 3)."""

    name: str
    rows: Indices
    offsets: F64


@dataclass(frozen=True, slots=True)
class MeshRig:
    """shapes of a mesh of V vertices; joints, places (J, 3) as in Rig; weights (V, J)."""

    shapes: tuple[Shape, ...]
    joints: tuple[str, ...]
    places: F64
    weights: F64

    def of_vertices(self, rows: Indices) -> MeshRig:
        """The rig of a mesh that has the vertices rows (n,) of this one only."""
        new = np.full(len(self.weights), -1, np.int64)
        new[rows] = np.arange(len(rows))
        shapes = []
        for s in self.shapes:
            keep = new[s.rows] >= 0
            shapes.append(Shape(s.name, new[s.rows[keep]], s.offsets[keep]))
        return MeshRig(tuple(shapes), self.joints, self.places, self.weights[rows])


def with_head(rig: MeshRig, count: int) -> MeshRig:
    """The rig of a mesh of `count` vertices that turns with the head as a whole and that no expression moves."""
    weights = np.zeros((count, len(rig.joints)))
    weights[:, 0] = 1.0
    return MeshRig((), rig.joints, rig.places, weights)


def mesh_rig(rig: Rig, points: csr_array | None = None) -> MeshRig:
    """The rig of a mesh whose vertices are linear in the cage's: points (n, V), None for the cage itself."""
    stencil = csr_array(eye_array(len(rig.weights), format="csr")) if points is None else points
    shapes, e = [], rig.expressions
    for i, name in enumerate(e.names):
        own = slice(int(e.starts[i]), int(e.starts[i + 1]))
        offsets = np.asarray(stencil[:, e.vertices[own]] @ e.offsets[own])
        moved = np.flatnonzero(np.linalg.norm(offsets, axis=1) > LEAST)
        shapes.append(Shape(name, moved, offsets[moved]))
    weights = np.asarray(stencil @ rig.weights).clip(0, None)
    return MeshRig(tuple(shapes), rig.joints, rig.places, weights / weights.sum(1, keepdims=True))


def write_skeleton(stage: Usd.Stage, path: str, rig: MeshRig) -> UsdSkel.Skeleton:
    """Author the joints with all axes along the asset's, and an animation in which nothing moves."""
    out = UsdSkel.Skeleton.Define(stage, path)
    root = rig.joints[0]
    joints = [root, *(f"{root}/{j}" for j in rig.joints[1:])]
    local = rig.places - np.concatenate([np.zeros((1, 3)), np.repeat(rig.places[:1], len(joints) - 1, 0)])
    out.CreateJointsAttr(joints)
    out.CreateBindTransformsAttr(Vt.Matrix4dArray([_shift(p) for p in rig.places]))
    out.CreateRestTransformsAttr(Vt.Matrix4dArray([_shift(p) for p in local]))
    still = UsdSkel.Animation.Define(stage, f"{path}/{ANIMATION}")
    still.CreateJointsAttr(joints)
    still.CreateTranslationsAttr(Vt.Vec3fArray([Gf.Vec3f(*p.tolist()) for p in local]))
    still.CreateRotationsAttr(Vt.QuatfArray([Gf.Quatf(1)] * len(joints)))
    still.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1, 1, 1)] * len(joints)))
    still.CreateBlendShapesAttr([s.name for s in rig.shapes])
    still.CreateBlendShapeWeightsAttr(Vt.FloatArray([0.0] * len(rig.shapes)))
    UsdSkel.BindingAPI.Apply(out.GetPrim()).CreateAnimationSourceRel().SetTargets([still.GetPath()])
    return out


def bind(stage: Usd.Stage, mesh: UsdGeom.Mesh, rig: MeshRig, skeleton: UsdSkel.Skeleton) -> None:
    """Bind a mesh to the skeleton. Shapes that move none of its points are left out."""
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
    strongest = np.argsort(-rig.weights, axis=1, kind="stable")[:, :INFLUENCES]
    weights = np.take_along_axis(rig.weights, strongest, 1)
    weights /= weights.sum(1, keepdims=True)
    binding.CreateJointIndicesPrimvar(False, INFLUENCES).Set(Vt.IntArray(strongest.ravel().tolist()))
    binding.CreateJointWeightsPrimvar(False, INFLUENCES).Set(
        Vt.FloatArray.FromNumpy(np.ascontiguousarray(weights.ravel(), np.float32))
    )
    targets, names = [], []
    for shape in rig.shapes:
        if not len(shape.rows):
            continue
        made = UsdSkel.BlendShape.Define(stage, f"{mesh.GetPath()}/{shape.name}")
        made.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shape.offsets, np.float32)))
        made.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(shape.rows, np.int32)))
        targets.append(made.GetPath())
        names.append(shape.name)
    if names:
        binding.CreateBlendShapesAttr(names)
        binding.CreateBlendShapeTargetsRel().SetTargets([Sdf.Path(t) for t in targets])


def _shift(place: F64) -> Gf.Matrix4d:
    return Gf.Matrix4d(1).SetTranslate(Gf.Vec3d(*place.tolist()))
