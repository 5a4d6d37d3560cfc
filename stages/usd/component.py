"""The component's layers: root, payload, and the single layer of the preview package.

Structure (ASWF asset-structure guidelines): root = Xform of kind component with assetInfo and a class to inherit;
payload = geo/render, geo/proxy and mtl. Only UsdPreviewSurface in the metallic workflow is authored: importers agree
on it, while they take `specularColor` for a tint of a 4 % lobe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt

from stages.usd.mesh import UvSurface

MATERIAL = "captured"


@dataclass(frozen=True, slots=True)
class Look:
    """What the preview network shows. Paths are relative to the layer; None leaves the input out."""

    albedo: str
    roughness: str | None
    normal: str | None
    ior: float
    mean_albedo: tuple[float, float, float]


def ior_from_f0(f0: float) -> float:
    """Index of refraction whose reflectance at normal incidence is f0: (1 + sqrt(f0)) / (1 - sqrt(f0)).

    Domain: clamped to [0.005, 0.2], beyond which a dielectric surface is implausible.
    """
    root = float(np.sqrt(np.clip(f0, 0.005, 0.2)))
    return (1 + root) / (1 - root)


def new_stage(comment: str, default: str) -> Usd.Stage:
    """A stage in memory with units, axis and default prim authored on its root layer. Nothing is loaded into it."""
    stage = Usd.Stage.CreateInMemory(Usd.Stage.LoadNone)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, f"/{default}").GetPrim())
    stage.GetRootLayer().documentation = comment
    return stage


def detached(stage: Usd.Stage) -> Sdf.Layer:
    """The root layer's content as a layer that outlives the stage and composes nothing."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.TransferContent(stage.GetRootLayer())
    return layer


def _as_component(stage: Usd.Stage, name: str, version: str) -> Usd.Prim:
    """Kind, asset info and the class that lets a scene restyle every instance at once."""
    prim = stage.GetDefaultPrim()
    stage.CreateClassPrim(f"/_class_{name}")
    prim.GetInherits().AddInherit(f"/_class_{name}")
    model = Usd.ModelAPI(prim)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(name)
    model.SetAssetVersion(version)
    return prim


def root_layer(name: str, version: str, extents: list[Gf.Vec3f]) -> Sdf.Layer:
    """NAME.usd: the file that others reference. `extents`: the box of each purpose present, for display unloaded."""
    stage = new_stage(
        "Captured head. Open or reference this file; lookdev.usda adds the captured light and cameras.", name
    )
    prim = _as_component(stage, name, version)
    prim.GetPayloads().AddPayload("./payload.usdc")
    UsdGeom.ModelAPI.Apply(prim).SetExtentsHint(Vt.Vec3fArray(extents))
    return detached(stage)


def payload_layer(name: str, mesh: UvSurface, proxy: UvSurface | None, look: Look) -> Sdf.Layer:
    """payload.usdc: what is heavy. With a proxy the full mesh has purpose render, else it is shown always."""
    stage = new_stage("Geometry and material of the captured head.", name)
    _fill(stage, name, mesh, proxy, look)
    return detached(stage)


def package_layer(name: str, version: str, mesh: UvSurface, look: Look) -> Sdf.Layer:
    """The one layer of NAME.usdz. No proxy: viewers on phones show every purpose at once."""
    stage = new_stage("Preview of the captured head.", name)
    _as_component(stage, name, version)
    _fill(stage, name, mesh, None, look)
    return detached(stage)


def _fill(stage: Usd.Stage, name: str, mesh: UvSurface, proxy: UvSurface | None, look: Look) -> None:
    UsdGeom.Scope.Define(stage, f"/{name}/geo")
    UsdGeom.Scope.Define(stage, f"/{name}/mtl")
    material = _material(stage, f"/{name}/mtl/{MATERIAL}", look)
    render = _mesh(stage, f"/{name}/geo/render", mesh, material)
    render.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set(Vt.Vec3fArray([Gf.Vec3f(*look.mean_albedo)]))
    if proxy is not None:
        stand_in = _mesh(stage, f"/{name}/geo/proxy", proxy, material)
        stand_in.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set(Vt.Vec3fArray([Gf.Vec3f(*look.mean_albedo)]))
        stand_in.CreatePurposeAttr(UsdGeom.Tokens.proxy)
        render.CreatePurposeAttr(UsdGeom.Tokens.render)
        render.SetProxyPrim(stand_in)


def _mesh(stage: Usd.Stage, path: str, mesh: UvSurface, material: UsdShade.Material) -> UsdGeom.Mesh:
    """A triangle mesh. Vertices without a face are left out; normals are made unit length."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    uv_used, uv_faces = np.unique(mesh.uv_faces, return_inverse=True)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertices[used], np.float32))
    normals = mesh.normals[used].astype(np.float64)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    out = UsdGeom.Mesh.Define(stage, path)
    out.CreatePointsAttr(points)
    out.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    out.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.ravel(), np.int32)))
    out.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, np.float32)))
    out.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    out.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    out.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    out.CreateDoubleSidedAttr(False)
    out.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    st = UsdGeom.PrimvarsAPI(out).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    # xatlas may put a border vertex a rounding error outside of the square
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uvs[uv_used].clip(0, 1), np.float32)))
    st.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(uv_faces.ravel(), np.int32)))
    UsdShade.MaterialBindingAPI.Apply(out.GetPrim()).Bind(material)
    return out


# ------------------------------------------------------------------ material
def _material(stage: Usd.Stage, path: str, look: Look) -> UsdShade.Material:
    """UsdPreviewSurface: diffuse albedo, roughness and normal maps over a dielectric of the measured mean F0."""
    T = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, path)
    st_name = material.CreateInput("st_name", T.String)
    st_name.Set("st")
    reader = UsdShade.Shader.Define(stage, f"{path}/st_reader")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", T.String).ConnectToSource(st_name)
    reader.CreateOutput("result", T.Float2)
    surface = UsdShade.Shader.Define(stage, f"{path}/preview")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("useSpecularWorkflow", T.Int).Set(0)
    surface.CreateInput("metallic", T.Float).Set(0.0)
    surface.CreateInput("ior", T.Float).Set(look.ior)
    _connect(
        surface.CreateInput("diffuseColor", T.Color3f), _texture(stage, reader, path, "albedo", look.albedo, "sRGB")
    )
    roughness = surface.CreateInput("roughness", T.Float)
    if look.roughness:
        _connect(roughness, _texture(stage, reader, path, "roughness", look.roughness, "raw", "r"))
    else:
        roughness.Set(0.5)
    if look.normal:
        normal = _texture(stage, reader, path, "normal", look.normal, "raw")
        shader = UsdShade.Shader(normal.GetPrim())
        shader.CreateInput("scale", T.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
        shader.CreateInput("bias", T.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        _connect(surface.CreateInput("normal", T.Normal3f), normal)
    surface.CreateOutput("surface", T.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _texture(
    stage: Usd.Stage, reader: UsdShade.Shader, path: str, name: str, file: str, space: str, channel: str = "rgb"
) -> UsdShade.Output:
    """A texture reader. Clamped: charts never wrap, and wrapping would mix opposite borders."""
    T = Sdf.ValueTypeNames
    shader = UsdShade.Shader.Define(stage, f"{path}/{name}")
    shader.CreateIdAttr("UsdUVTexture")
    shader.CreateInput("file", T.Asset).Set(Sdf.AssetPath(file))
    shader.CreateInput("sourceColorSpace", T.Token).Set(space)
    shader.CreateInput("wrapS", T.Token).Set("clamp")
    shader.CreateInput("wrapT", T.Token).Set("clamp")
    shader.CreateInput("st", T.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    return shader.CreateOutput(channel, T.Float if channel == "r" else T.Float3)


def _connect(target: UsdShade.Input, source: UsdShade.Output) -> None:
    target.ConnectToSource(UsdShade.ConnectableAPI(source.GetPrim()), source.GetBaseName())
