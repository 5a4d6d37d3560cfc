"""The files that the asset's material reads, and helpers to author shader prims."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdShade

from pipeline import tiles
from stages.usd.colour_spaces import SRGB

T = Sdf.ValueTypeNames
MATERIAL = "captured"
HEIGHT = "displacement"  # reader of the displacement map, and the output of both kinds of network


@dataclass(frozen=True, slots=True)
class Look:
    """Inputs of the material's networks. Paths are relative to the layer, with <UDIM> in place of the tile's number if
    there are several tiles (MaterialX reads these, preview surfaces one tile each); None leaves a map out.

    coefficients, basis: pictures of three coefficients c_j(x) each, and of three tables B_j / R each; () for none.
    displacement: metres along the normal, of a mesh that is subdivided.
    neuface_albedo: the field's own albedo, if `albedo` is the base colour of a fitted standard material.
    iors: the index of refraction of each tile; () if all have `ior`.
    subsurface: picture of where skin scatters light below its surface.
    base_color, base_space: picture and colour space of the base colour in MaterialX networks; None: `albedo`.
    """

    albedo: str
    roughness: str | None
    normal: str | None
    ior: float
    mean_albedo: tuple[float, float, float]
    specular: str | None = None
    f0: str | None = None
    inv_kappa: str | None = None
    coefficients: tuple[str, ...] = ()
    basis: tuple[str, ...] = ()
    displacement: str | None = None
    neuface_albedo: str | None = None
    base_color: str | None = None
    base_space: str = SRGB
    subsurface: str | None = None
    iors: tuple[float, ...] = ()

    def base(self) -> tuple[str, str]:
        """The picture of the base colour for MaterialX networks, and its colour space."""
        return self.base_color or self.albedo, self.base_space if self.base_color else SRGB

    def on_tile(self, tile: int) -> Look:
        """The same look with the files and the index of refraction of one tile."""
        number = str(tiles.FIRST + tile)
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        named: dict[str, Any] = {k: p.replace(tiles.TOKEN, number) for k, p in values.items() if isinstance(p, str)}
        ior = self.iors[tile] if tile < len(self.iors) else self.ior
        own = tuple(c.replace(tiles.TOKEN, number) for c in self.coefficients)
        return replace(self, **named, coefficients=own, ior=ior)


@dataclass(frozen=True, slots=True)
class Part:
    """The tile whose files a preview surface reads, and how many tiles the texture coordinates have in the unit square:
    1 where each tile has a unit of its own (UDIM), else they lie side by side in it."""

    tile: int = 0
    across: int = 1


WHOLE = Part()  # of an asset with one tile


def ior_from_f0(f0: float) -> float:
    """Index of refraction whose reflectance at normal incidence is f0: (1 + sqrt(f0)) / (1 - sqrt(f0)).

    Domain: clamped to [0, 0.2], beyond which a dielectric surface is implausible. 0, where the fit has no layer: 1.
    """
    root = float(np.sqrt(np.clip(f0, 0.0, 0.2)))
    return (1 + root) / (1 - root)


def shader(stage: Usd.Stage, path: str, identifier: str) -> UsdShade.Shader:
    """A shader prim of a registered kind."""
    out = UsdShade.Shader.Define(stage, path)
    out.CreateIdAttr(identifier)
    return out


def connect(target: UsdShade.Input, source: UsdShade.Output) -> None:
    """target <- source."""
    target.ConnectToSource(UsdShade.ConnectableAPI(source.GetPrim()), source.GetBaseName())


# ------------------------------------------------------------------ UsdPreviewSurface
def preview_networks(stage: Usd.Stage, material: UsdShade.Material, look: Look, part: Part = WHOLE) -> None:
    """Author `preview` as the material's surface, in the metallic workflow, which all importers read in the same way.
    Author `preview_specular` with a map of F0; it is a variant, because many importers misread it. Both read the files
    of one tile.
    """
    path, look = str(material.GetPath()), look.on_tile(part.tile)
    name = material.CreateInput("st_name", T.String)
    name.Set("st")
    reader = shader(stage, f"{path}/st_reader", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", T.String).ConnectToSource(name)
    st = _in_part(stage, path, reader.CreateOutput("result", T.Float2), part)
    albedo = _texture(stage, st, f"{path}/albedo", look.albedo, "sRGB")
    roughness = _texture(stage, st, f"{path}/roughness", look.roughness, "raw", "r") if look.roughness else None
    normal = _normal_texture(stage, st, f"{path}/normal", look.normal) if look.normal else None
    height = _texture(stage, st, f"{path}/{HEIGHT}", look.displacement, "raw", "r") if look.displacement else None
    for which in ("preview", "preview_specular") if look.specular else ("preview",):
        surface = shader(stage, f"{path}/{which}", "UsdPreviewSurface")
        surface.CreateInput("useSpecularWorkflow", T.Int).Set(int(which != "preview"))
        if which == "preview":
            surface.CreateInput("metallic", T.Float).Set(0.0)
        else:
            specular = _texture(stage, st, f"{path}/specular_color", str(look.specular), "sRGB")
            connect(surface.CreateInput("specularColor", T.Color3f), specular)
        surface.CreateInput("ior", T.Float).Set(look.ior)
        connect(surface.CreateInput("diffuseColor", T.Color3f), albedo)
        if roughness is not None:
            connect(surface.CreateInput("roughness", T.Float), roughness)
        else:
            surface.CreateInput("roughness", T.Float).Set(0.5)
        if normal is not None:
            connect(surface.CreateInput("normal", T.Normal3f), normal)
        surface.CreateOutput("surface", T.Token)
        if height is not None:
            connect(surface.CreateInput("displacement", T.Float), height)
            surface.CreateOutput("displacement", T.Token)
    preview = UsdShade.Shader.Get(stage, f"{path}/preview").ConnectableAPI()
    material.CreateSurfaceOutput().ConnectToSource(preview, "surface")
    if height is not None:
        material.CreateDisplacementOutput().ConnectToSource(preview, "displacement")


def eye_preview(
    stage: Usd.Stage,
    material: UsdShade.Material,
    look: Look,
    ior: float,
    roughness: float,
    part: Part = WHOLE,
) -> None:
    """Author `preview` of an eye: the colours and displacement of its tile under a clear surface of one roughness."""
    path, look = str(material.GetPath()), look.on_tile(part.tile)
    reader = shader(stage, f"{path}/st_reader", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", T.String).Set("st")
    st = _in_part(stage, path, reader.CreateOutput("result", T.Float2), part)
    surface = shader(stage, f"{path}/preview", "UsdPreviewSurface")
    surface.CreateInput("useSpecularWorkflow", T.Int).Set(0)
    for name, value in (("metallic", 0.0), ("ior", ior), ("roughness", roughness)):
        surface.CreateInput(name, T.Float).Set(value)
    connect(surface.CreateInput("diffuseColor", T.Color3f), _texture(stage, st, f"{path}/albedo", look.albedo, "sRGB"))
    surface.CreateOutput("surface", T.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    if look.displacement:
        height = _texture(stage, st, f"{path}/{HEIGHT}", look.displacement, "raw", "r")
        connect(surface.CreateInput("displacement", T.Float), height)
        surface.CreateOutput("displacement", T.Token)
        material.CreateDisplacementOutput().ConnectToSource(surface.ConnectableAPI(), "displacement")


def _in_part(stage: Usd.Stage, path: str, st: UsdShade.Output, part: Part) -> UsdShade.Output:
    """Texture coordinates in the unit square of one tile: (across u - tile, v)."""
    if part == WHOLE:
        return st
    out = shader(stage, f"{path}/st_of_part", "UsdTransform2d")
    connect(out.CreateInput("in", T.Float2), st)
    out.CreateInput("scale", T.Float2).Set(Gf.Vec2f(part.across, 1))
    out.CreateInput("translation", T.Float2).Set(Gf.Vec2f(-part.tile, 0))
    return out.CreateOutput("result", T.Float2)


def _texture(
    stage: Usd.Stage, st: UsdShade.Output, path: str, file: str, space: str, channel: str = "rgb"
) -> UsdShade.Output:
    """Author a texture reader of one file. It is clamped: charts never wrap, and wrapping would mix opposite borders.
    It never has <UDIM>: the USD library does not resolve that in normal maps, and many programs not at all."""
    out = shader(stage, path, "UsdUVTexture")
    out.CreateInput("file", T.Asset).Set(Sdf.AssetPath(file))
    out.CreateInput("sourceColorSpace", T.Token).Set(space)
    out.CreateInput("wrapS", T.Token).Set("clamp")
    out.CreateInput("wrapT", T.Token).Set("clamp")
    connect(out.CreateInput("st", T.Float2), st)
    return out.CreateOutput(channel, T.Float if channel == "r" else T.Float3)


def _normal_texture(stage: Usd.Stage, st: UsdShade.Output, path: str, file: str) -> UsdShade.Output:
    """Author a reader of a normal map, which stores (n + 1) / 2 in eight bits."""
    output = _texture(stage, st, path, file, "raw")
    out = UsdShade.Shader(output.GetPrim())
    out.CreateInput("scale", T.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
    out.CreateInput("bias", T.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
    return output
