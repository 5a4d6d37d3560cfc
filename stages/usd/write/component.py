"""The component's layers: root, payload, dense mesh, and the single layer of the preview package.

Structure (ASWF asset-structure guidelines): root = Xform of kind component with assetInfo and a class to inherit;
payload = geo/render, geo/proxy and mtl; high.usdc = the dense mesh, loaded on request. One material has several
networks for the same look (write/shading.py, write/materialx.py). The variant sets `look` and `lod` on the root choose
among them and among the meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdMedia, UsdSkel, Vt

from pipeline.meshes import Mask
from stages.usd.write.cage import TemplateMesh, write_cage
from stages.usd.write.field_files import FieldLook
from stages.usd.write.field_look import write_field_look
from stages.usd.write.mesh import UvSurface, faces_of, tile_count
from stages.usd.write.pieces import bind_pieces, grouped, pieces, together
from stages.usd.write.rig import RIG, MeshRig, bind, with_head, write_skeleton
from stages.usd.write.shading import Look
from stages.usd.write.tile_materials import (
    Made,
    TileMaterial,
    bind_tiles,
    scattering,
    skins,
    split_by_tile,
    tile_materials,
    write_materials,
)
from stages.usd.write.variants import (
    HAIR,
    PROXY,
    RENDER,
    REST,
    SCAN,
    SCAN_MATERIAL,
    without_displacement,
    write_levels,
    write_looks,
    write_meshes,
)


@dataclass(frozen=True, slots=True)
class Identity:
    """Metadata of the asset. Only `name` and `version` are always set; the rest comes from the user, or is empty."""

    name: str
    version: str
    author: str = ""
    license: str = ""
    subject_consent: str = ""

    def stated(self) -> dict[str, str]:
        """The metadata from the user, by the names under which it is recorded."""
        metadata = {"author": self.author, "license": self.license, "subjectConsent": self.subject_consent}
        return {k: v for k, v in metadata.items() if v}


def new_stage(comment: str, default: str) -> Usd.Stage:
    """An empty stage in memory, with units, axis and default prim authored on its root layer."""
    stage = Usd.Stage.CreateInMemory(Usd.Stage.LoadNone)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, f"/{default}").GetPrim())
    stage.GetRootLayer().documentation = comment
    return stage


def detached(stage: Usd.Stage) -> Sdf.Layer:
    """A copy of the root layer that is independent of the stage."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.TransferContent(stage.GetRootLayer())
    return layer


def _as_component(stage: Usd.Stage, who: Identity) -> Usd.Prim:
    """Set kind, asset info and a class, with which a scene can change every instance at once."""
    prim = stage.GetDefaultPrim()
    stage.CreateClassPrim(f"/_class_{who.name}")
    prim.GetInherits().AddInherit(f"/_class_{who.name}")
    model = Usd.ModelAPI(prim)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(who.name)
    model.SetAssetVersion(who.version)
    if who.stated():
        prim.SetAssetInfoByKey("capture", who.stated())
        stage.GetRootLayer().customLayerData = {"capture": who.stated()}
    stage.GetRootLayer().comment = "Made by NeuFace Asset."
    return prim


def root_layer(
    who: Identity,
    extents: list[Gf.Vec3f],
    look: Look,
    *,
    materials: Sequence[TileMaterial],
    high: Sequence[str],
    proxy: bool,
    thumbnail: str | None,
    beside: tuple[str, ...] = (),
    scan: Sequence[TileMaterial] = (),
    field: FieldLook | None = None,
) -> Sdf.Layer:
    """NAME.usd: the file that scenes reference. `extents`: the box of each purpose, shown while it is not loaded.
    high: names of the dense mesh's materials, none without it. beside: names of the meshes beside the template. scan:
    the materials of the scan's mesh, if there is one beside it."""
    stage = new_stage(
        "Captured head. Open or reference this file; lookdev.usda adds the captured light and cameras.", who.name
    )
    prim = _as_component(stage, who)
    Usd.ModelAPI(prim).SetAssetIdentifier(Sdf.AssetPath(f"./{who.name}.usd"))
    prim.GetPayloads().AddPayload("./payload.usdc")
    UsdGeom.ModelAPI.Apply(prim).SetExtentsHint(Vt.Vec3fArray(extents))
    if thumbnail:
        previews = UsdMedia.AssetPreviewsAPI.Apply(prim)
        previews.SetDefaultThumbnails(UsdMedia.AssetPreviewsAPI.Thumbnails(Sdf.AssetPath(thumbnail)))
    shown = [*materials, *scan]
    write_looks(stage, prim, look, skins(shown), scattering(shown) if look.subsurface else ())
    if field is not None:
        write_field_look(stage, prim, skins([m for m in materials if m.tile == 0]), field)
    write_levels(stage, prim, beside=beside, scan=bool(scan), high=high, proxy=proxy)
    if look.displacement:
        without_displacement(stage, prim, look, skins([m for m in materials if m.displaced]))
    if scan:
        write_meshes(stage, prim, beside=beside)
    return detached(stage)


def payload_layer(
    name: str,
    mesh: UvSurface | TemplateMesh,
    proxy: UvSurface | None,
    look: Look,
    scan: tuple[UvSurface, Look] | None = None,
    hair: Look | None = None,
) -> Sdf.Layer:
    """payload.usdc: geometry and material. With a proxy the full mesh has purpose render, else purpose default. Clothes
    and hair have purpose default. scan: the scan's mesh with its own maps, beside the template's. hair: the look of the
    template's hair."""
    stage = new_stage("Geometry and material of the captured head.", name)
    _fill(stage, name, mesh, proxy, look, hair)
    if scan is not None:
        _scan(stage, name, *scan, purposes=proxy is not None)
    if isinstance(mesh, TemplateMesh) and mesh.rig is not None:
        _bounded(stage, name, mesh.rig)
    return detached(stage)


def high_layer(mesh: UvSurface, look: Look, materials: Sequence[TileMaterial]) -> Sdf.Layer:
    """high.usdc: the dense mesh as /high. Its materials are bound where it is loaded."""
    stage = Usd.Stage.CreateInMemory(Usd.Stage.LoadNone)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    made = _mesh(stage, "/high", mesh)
    split_by_tile(made, materials)
    made.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set(Vt.Vec3fArray([Gf.Vec3f(*look.mean_albedo)]))
    stage.SetDefaultPrim(made.GetPrim())
    stage.GetRootLayer().documentation = "The captured head's surface before decimation."
    return detached(stage)


def package_layer(
    who: Identity,
    mesh: UvSurface,
    look: Look,
    materials: Sequence[TileMaterial],
    rig: MeshRig | None = None,
    eyes: Mask | None = None,
    hair: Look | None = None,
) -> Sdf.Layer:
    """The layer of NAME.usdz. It has no proxy, because viewers on phones show all purposes at once. Each of several
    tiles is a face set with its own material, because these viewers do not support <UDIM>; what no expression moves is
    a mesh of its own, and so is hair. rig: of the mesh's first vertices; eyes (n,): of its first triangles, those with
    the eyes' material; hair: the look of the last tile, if that is hair."""
    stage = new_stage("Preview of the captured head.", who.name)
    _as_component(stage, who)
    count = tile_count(mesh)
    if count == 1 and rig is None and eyes is None:
        _fill(stage, who.name, mesh, None, look)
    else:
        UsdGeom.Scope.Define(stage, f"/{who.name}/mtl")
        written = write_materials(stage, f"/{who.name}/mtl", materials, look, hair, across=count)
        own = {(m.tile, m.eyes): material for m, material in written.items()}
        skeleton = _geo(stage, who.name, rig)
        found, moving = list(pieces(mesh, count, eyes)), 0 if rig is None else len(rig.weights)
        for kind, some in grouped(found, moving, None if hair is None else count - 1).items():
            whole, faces = together(some, count)
            made = _mesh(stage, f"/{who.name}/geo/{kind}", whole)
            bind_pieces(made, faces, [own[piece.tile, piece.eyes] for piece in some])
            used = np.unique(whole.faces).astype(np.int64)
            if kind == HAIR:
                made.CreateDoubleSidedAttr(True)  # an open shell, which is seen from inside at its rim
            if rig is not None and skeleton is not None and kind in (RENDER, HAIR):
                bind(stage, made, with_head(rig, len(used)) if kind == HAIR else rig.of_vertices(used), skeleton)
        if rig is not None:
            _bounded(stage, who.name, rig)
    return detached(stage)


def _fill(
    stage: Usd.Stage,
    name: str,
    mesh: UvSurface | TemplateMesh,
    proxy: UvSurface | None,
    look: Look,
    hair: Look | None = None,
) -> None:
    template = mesh if isinstance(mesh, TemplateMesh) else None
    rig = None if template is None else template.rig
    skeleton = _geo(stage, name, rig)
    UsdGeom.Scope.Define(stage, f"/{name}/mtl")
    made = write_materials(stage, f"/{name}/mtl", tile_materials(mesh), look, hair)
    shown = _shown(stage, f"/{name}/geo", mesh, made)
    if rig is not None and skeleton is not None:
        bind(stage, shown[0], rig, skeleton)
    hairs = None
    if template is not None and template.hair is not None and hair is not None:
        hairs = _mesh(stage, f"/{name}/geo/{HAIR}", template.hair, made)
        hairs.CreateDoubleSidedAttr(True)  # an open shell, which is seen from inside at its rim
        hairs.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set(Vt.Vec3fArray([Gf.Vec3f(*hair.mean_albedo)]))
        if rig is not None and skeleton is not None:
            bind(stage, hairs, with_head(rig, len(template.hair.vertices)), skeleton)
    stand_in = None if proxy is None else _mesh(stage, f"/{name}/geo/{PROXY}", proxy, made)
    for one in shown if stand_in is None else [*shown, stand_in]:
        one.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set(Vt.Vec3fArray([Gf.Vec3f(*look.mean_albedo)]))
    if proxy is not None and stand_in is not None:
        stand_in.CreatePurposeAttr(UsdGeom.Tokens.proxy)
        shown[0].CreatePurposeAttr(UsdGeom.Tokens.render)  # clothes and hair have no stand-in: they always show
        shown[0].SetProxyPrim(stand_in)
        # the template's proxy has the cage's vertices, in the same order
        if rig is not None and skeleton is not None and len(proxy.vertices) == len(rig.weights):
            bind(stage, stand_in, rig, skeleton)


def _bounded(stage: Usd.Stage, name: str, rig: MeshRig) -> None:
    """Author the extent of the SkelRoot: all meshes below, grown by what expressions move at most. Without it, USD
    computes one from the joints alone."""
    geo = stage.GetPrimAtPath(f"/{name}/geo")
    boxes = [UsdGeom.Mesh(p).GetExtentAttr().Get() for p in geo.GetChildren() if p.IsA(UsdGeom.Mesh)]
    corners = np.array([np.array(box, np.float64) for box in boxes])
    grown = max((float(np.linalg.norm(s.offsets, axis=1).max()) for s in rig.shapes if len(s.rows)), default=0.0)
    ends = corners[:, 0].min(0) - grown, corners[:, 1].max(0) + grown
    UsdGeom.Boundable(geo).CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(*end.tolist()) for end in ends]))


def _scan(stage: Usd.Stage, name: str, mesh: UvSurface, look: Look, *, purposes: bool) -> None:
    materials = write_materials(stage, f"/{name}/mtl", tile_materials(mesh, SCAN_MATERIAL), look)
    made = _mesh(stage, f"/{name}/geo/{SCAN}", mesh, materials)
    made.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set(Vt.Vec3fArray([Gf.Vec3f(*look.mean_albedo)]))
    if purposes:
        made.CreatePurposeAttr(UsdGeom.Tokens.render)
        made.SetProxyPrim(UsdGeom.Mesh.Get(stage, f"/{name}/geo/{PROXY}"))


def _geo(stage: Usd.Stage, name: str, rig: MeshRig | None) -> UsdSkel.Skeleton | None:
    """The parent of the meshes; with a rig a SkelRoot with its skeleton."""
    if rig is None:
        UsdGeom.Scope.Define(stage, f"/{name}/geo")
        return None
    UsdSkel.Root.Define(stage, f"/{name}/geo")
    return write_skeleton(stage, f"/{name}/geo/{RIG}", rig)


def _shown(stage: Usd.Stage, geo: str, mesh: UvSurface | TemplateMesh, materials: Made) -> list[UsdGeom.Mesh]:
    """The meshes of full detail: one of triangles, or the template's cage and what lies beside it."""
    if isinstance(mesh, UvSurface):
        return [_mesh(stage, f"{geo}/{RENDER}", mesh, materials)]
    cage = write_cage(stage, f"{geo}/{RENDER}", mesh.cage)
    bind_tiles(cage, materials, mesh.cage.eyes)
    return [cage] if mesh.rest is None else [cage, _mesh(stage, f"{geo}/{REST}", mesh.rest, materials)]


def _mesh(stage: Usd.Stage, path: str, mesh: UvSurface, materials: Made | None = None) -> UsdGeom.Mesh:
    """Author a mesh of triangles, or of quads if it is paired. Vertices without a face are left out; normals are
    normalised. materials: of the tiles, if it gets one here."""
    counts, corners, uv_corners = faces_of(mesh)
    used, faces = np.unique(corners, return_inverse=True)
    uv_used, uv_faces = np.unique(uv_corners, return_inverse=True)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertices[used], np.float32))
    normals = mesh.normals[used].astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    out = UsdGeom.Mesh.Define(stage, path)
    out.CreatePointsAttr(points)
    out.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    out.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.ravel(), np.int32)))
    out.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, np.float32)))
    out.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    out.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    out.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    out.CreateDoubleSidedAttr(False)
    out.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    st = UsdGeom.PrimvarsAPI(out).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    # xatlas may put a border vertex outside the square by a rounding error
    kept = mesh.uvs[uv_used].clip(0, [tile_count(mesh), 1])
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(kept, np.float32)))
    st.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(uv_faces.ravel(), np.int32)))
    if materials is not None:
        bind_tiles(out, materials)
    return out
