"""The head template in the asset: its control cage with displacement, and a coarser mesh of triangles for programs that
do not subdivide.

The textured mesh (uv stage) begins with the subdivided and displaced quads of the cage, two triangles each. What
follows is beside the head (clothes) and stays triangles, and so does hair, which comes last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt
from scipy.sparse import csr_array

from pipeline import meshes
from pipeline.artifacts import Located
from pipeline.head_artifacts import RegisteredHead
from pipeline.meshes import F32, F64, Charts, Indices, Mask, triangles_of
from pipeline.registration.facets import lifted
from pipeline.registration.head import Head, kept_quads, load_head
from pipeline.registration.quality import outer_quads
from pipeline.registration.rig import load_rig
from pipeline.registration.shapes import load_shapes, with_shapes
from pipeline.registration.subdivision import limit, subdivided
from stages.usd.write.eyes import eye_quads
from stages.usd.write.mesh import UvSurface
from stages.usd.write.rig import MeshRig, mesh_rig
from stages.usd.write.variants import HAIR, REST

COARSE = 1  # subdivisions of the mesh for programs that do not subdivide
LEVELS_KEY = "neufaceSubdivisions"  # customData of the cage: steps after which its vertices carry the displacement


@dataclass(frozen=True, slots=True)
class CageSurface:
    """vertices (V, 3), quads (Q, 4), uvs (U, 2), uv_quads (Q, 4): the cage without what the asset leaves out. rows
    (V,): of its vertices in the template. levels: subdivisions after which its vertices carry the displacement. eyes
    (Q,): fitted eyes, which have a material of their own. outer (Q,): the skin's outside."""

    vertices: F64
    quads: Indices
    uvs: F32
    uv_quads: Indices
    rows: Indices
    levels: int
    eyes: Mask
    outer: Mask


@dataclass(frozen=True, slots=True)
class TemplateMesh:
    """cage: the control cage. coarse: triangles of its first subdivision, displaced. rest: what the scan shows beside
    it; hair: its hair. heights (n,): displacement in metres at the vertices of the textured mesh. rig, coarse_rig:
    expressions and joints of cage and coarse. coarse_eyes (F,): triangles of coarse that are fitted eyes; None without
    any."""

    cage: CageSurface
    coarse: UvSurface
    rest: UvSurface | None
    heights: F32
    rig: MeshRig | None = None
    coarse_rig: MeshRig | None = None
    coarse_eyes: Mask | None = None
    hair: UvSurface | None = None

    def beside(self) -> tuple[str, ...]:
        """Names of the meshes beside the template."""
        return tuple(name for name, part in ((REST, self.rest), (HAIR, self.hair)) if part is not None)


def template_mesh(
    registered: Located[RegisteredHead], textured: UvSurface, *, rigged: bool, measured: str = "", hair_faces: int = 0
) -> TemplateMesh:
    """What the asset shows of the registered head, and the rest of the textured mesh; with its rig if asked for and
    there is one. measured: file of further expressions; none if empty. hair_faces: the textured mesh's last ones."""
    ref = registered.artifact.head
    assert ref is not None, "the uv stage made its mesh from the head"
    head = load_head(registered.path(ref))
    kept = kept_quads(head, registered.artifact.regions)
    quads = head.surface()[2][np.repeat(kept, 4**head.levels)]
    used = np.unique(quads)
    heights = np.zeros(len(textured.vertices), np.float32)
    heights[: len(used)] = head.displacement[used]
    eyes = eye_quads(head, registered.artifact)[kept]
    outer = outer_quads(head.region, registered.artifact.regions)[kept]
    cage, (coarse, points) = _cage(head, kept, eyes, outer), _coarse(head, kept)
    fine_eyes = np.repeat(eyes, len(coarse.faces) // len(eyes)) if eyes.any() else None
    first, hair = 2 * len(quads), len(textured.faces) - hair_faces
    rest, hairs = _part(textured, first, hair), _part(textured, hair, len(textured.faces))
    made = TemplateMesh(cage, coarse, rest, heights, coarse_eyes=fine_eyes, hair=hairs)
    found = registered.artifact.rig
    if found is None or not rigged:
        return made
    rig = load_rig(registered.path(found))
    if measured:
        rig = with_shapes(rig, load_shapes(Path(measured)), Path(measured))
    return replace(made, rig=mesh_rig(rig).of_vertices(cage.rows), coarse_rig=mesh_rig(rig, points))


def _cage(head: Head, kept: Mask, eyes: Mask, outer: Mask) -> CageSurface:
    rows, quads = np.unique(head.quads[kept], return_inverse=True)
    used, uv_quads = np.unique(head.uv_quads[kept], return_inverse=True)
    return CageSurface(
        head.vertices[rows], quads.reshape(-1, 4), head.uvs[used].astype(np.float32), uv_quads.reshape(-1, 4),
        rows.astype(np.int64), head.levels, eyes, outer,
    )  # fmt: skip


def _coarse(head: Head, kept: Mask) -> tuple[UvSurface, csr_array]:
    """The mesh, and the stencil (n, V) of its limit points from the template's vertices. A step's vertex points come
    first in the next one, so the vertices of the first steps have the same rows in the finest."""
    steps = min(COARSE, head.levels)
    keep = np.repeat(kept, 4**steps)
    level = subdivided(head.quads, len(head.vertices), steps)
    quads = level.quads[keep]
    uv_quads = subdivided(head.uv_quads, len(head.uvs), steps, "sharp").quads[keep]
    points, fine = head.displaced(), head.surface()[2]
    normals = meshes.vertex_normals(points, triangles_of(fine))
    count = level.stencil.shape[0]
    own, finer = normals[:count].astype(np.float64), points if steps < head.levels else head.finer()
    points = lifted(points[:count], own, level.quads, finer)
    rows, faces = np.unique(quads, return_inverse=True)
    used, uv_faces = np.unique(uv_quads, return_inverse=True)
    made = UvSurface(
        points[rows].astype(np.float32), normals[rows], triangles_of(faces.reshape(-1, 4)),
        head.fine_uvs()[0][used].astype(np.float32), triangles_of(uv_faces.reshape(-1, 4)),
    )  # fmt: skip
    return made, csr_array((limit(level.quads, level.stencil.shape[0]).point @ level.stencil)[rows])


def _part(textured: UvSurface, first: int, end: int) -> UvSurface | None:
    """The triangles from `first` to before `end`, with the vertices that they use; None if there are none."""
    if end <= first:
        return None
    rows, faces = np.unique(textured.faces[first:end], return_inverse=True)
    used, uv_faces = np.unique(textured.uv_faces[first:end], return_inverse=True)
    return UvSurface(
        textured.vertices[rows], textured.normals[rows], faces.reshape(-1, 3).astype(np.int32),
        textured.uvs[used], uv_faces.reshape(-1, 3).astype(np.int32),
    )  # fmt: skip


def with_rest(made: TemplateMesh) -> UvSurface:
    """The coarse mesh, the rest and hair as one; the vertices of the coarse mesh come first, those of hair last."""
    others = [part for part in (made.rest, made.hair) if part is not None]
    return joined([made.coarse, *others]) if others else made.coarse


def joined(parts: list[UvSurface]) -> UvSurface:
    """One mesh of several; their texture coordinates keep their tiles."""
    mesh, charts = meshes.joined(
        [(meshes.Mesh(p.vertices, p.normals, p.faces), Charts(p.uvs, p.uv_faces)) for p in parts]
    )
    return UvSurface(mesh.vertices, mesh.normals, mesh.faces, charts.uvs, charts.faces)


# ------------------------------------------------------------------ USD
def write_cage(stage: Usd.Stage, path: str, cage: CageSurface) -> UsdGeom.Mesh:
    """Author the cage: quads, Catmull-Clark, borders as pipeline.registration.subdivision has them. It has no normals:
    those of a subdivision surface are its limit's. Its materials are bound by the caller."""
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(cage.vertices, np.float32))
    out = UsdGeom.Mesh.Define(stage, path)
    out.CreatePointsAttr(points)
    out.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(cage.quads), 4, np.int32)))
    out.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(cage.quads.ravel(), np.int32)))
    out.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.catmullClark)
    out.CreateInterpolateBoundaryAttr(UsdGeom.Tokens.edgeAndCorner)
    out.CreateFaceVaryingLinearInterpolationAttr(UsdGeom.Tokens.boundaries)
    out.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    out.CreateDoubleSidedAttr(False)
    out.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    st = UsdGeom.PrimvarsAPI(out).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(cage.uvs, np.float32)))
    st.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(cage.uv_quads.ravel(), np.int32)))
    out.GetPrim().SetCustomDataByKey(LEVELS_KEY, cage.levels)
    return out


def is_cage(mesh: UsdGeom.Mesh) -> bool:
    """Whether `write_cage` authored the mesh."""
    return mesh.GetPrim().GetCustomDataByKey(LEVELS_KEY) is not None


def evaluated(mesh: UsdGeom.Mesh, more: int = 0) -> UvSurface:
    """Triangles of an authored cage after its subdivisions and `more`: limit points and limit normals, without
    displacement."""
    points = np.array(mesh.GetPointsAttr().Get(), np.float64)
    quads = np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int64).reshape(-1, 4)
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    uvs, uv_quads = np.array(st.Get(), np.float64), np.array(st.GetIndices(), np.int64).reshape(-1, 4)
    levels = int(mesh.GetPrim().GetCustomDataByKey(LEVELS_KEY)) + more
    none = np.zeros(0, np.int64)
    head = Head(points, quads, uvs, uv_quads, none, none, none.astype(np.float32), none.astype(np.float32), levels)
    limit_points, normals, fine = head.surface()
    fine_uvs, fine_uv_quads = head.fine_uvs()
    return UvSurface(
        limit_points.astype(np.float32), normals.astype(np.float32), triangles_of(fine),
        fine_uvs.astype(np.float32), triangles_of(fine_uv_quads),
    )  # fmt: skip
