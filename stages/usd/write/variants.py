"""The component's variant sets: `look` (which network is the material's surface), `lod` (which mesh), and `mesh`
(template or scan), if the asset has both.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from pxr import Sdf, Usd, UsdGeom, UsdShade

from stages.usd.write.materialx import SCATTERS
from stages.usd.write.shading import HEIGHT, MATERIAL, Look

STANDARD, SPECULAR, BASIS, SUBSURFACE = "standard", "specular_workflow", "neuface_basis", "subsurface"
HIGH, RENDER, PROXY = "high", "render", "proxy"
REST = "rest"  # beside the template: clothes, and hair that was not told apart
HAIR = "hair"  # a mesh and its material
TEMPLATE, SCAN = "template", "scan"
SCAN_MATERIAL = f"{MATERIAL}_{SCAN}"
HIGH_FILE = "high.usdc"


def write_looks(
    stage: Usd.Stage, prim: Usd.Prim, look: Look, names: Sequence[str], scattering: Sequence[str] = ()
) -> None:
    """Variant set `look`: which network of the materials of these names is their surface. scattering: names of those
    that have a network with subsurface scattering. Each variant contains only the differences; the payload alone equals
    the first variant."""
    outputs = {STANDARD: {}, SPECULAR: {"outputs:surface": "preview_specular.outputs:surface"}}
    if not look.specular:
        del outputs[SPECULAR]
    if look.coefficients and look.inv_kappa and look.roughness:
        outputs[BASIS] = {"outputs:mtlx:surface": "neuface_basis/surface.outputs:out"}
    if scattering:
        outputs[SUBSURFACE] = {"outputs:mtlx:surface": f"{SCATTERS}/surface.outputs:out"}
    looks = prim.GetVariantSets().AddVariantSet("look")
    for variant, connections in outputs.items():
        looks.AddVariant(variant)
        looks.SetVariantSelection(variant)
        with looks.GetVariantEditContext():
            changed = scattering if variant == SUBSURFACE else names
            materials = [prim.GetPath().AppendPath(f"mtl/{n}") for n in changed]
            for material, (output, source) in product(materials, connections.items()):
                over = stage.OverridePrim(material)
                attribute = over.CreateAttribute(output, Sdf.ValueTypeNames.Token, custom=False)
                attribute.SetConnections([material.AppendPath(source)])
    looks.SetVariantSelection(STANDARD)


def write_levels(
    stage: Usd.Stage, prim: Usd.Prim, *, beside: tuple[str, ...], scan: bool, high: Sequence[str], proxy: bool
) -> None:
    """Variant set `lod`: the textured mesh (with its proxy), the dense mesh alone, or the proxy in its
    place. beside: names of the meshes beside the template (REST, HAIR). high: names of the dense mesh's materials, none
    without it."""
    path = prim.GetPath()
    lods = prim.GetVariantSets().AddVariantSet("lod")
    for variant, made in ((HIGH, bool(high)), (RENDER, True), (PROXY, proxy)):
        if not made:
            continue
        lods.AddVariant(variant)
        lods.SetVariantSelection(variant)
        if variant == RENDER:
            continue
        with lods.GetVariantEditContext():
            # clothes and hair have no proxy: beside the head's they stay as they are
            for hidden in (RENDER, *(beside if variant == HIGH else ()), *([SCAN] if scan else [])):
                stage.OverridePrim(path.AppendPath(f"geo/{hidden}")).SetActive(False)
            if variant == HIGH:
                if proxy:
                    stage.OverridePrim(path.AppendPath("geo/proxy")).SetActive(False)
                dense = stage.OverridePrim(path.AppendPath("geo/high"))
                dense.GetPayloads().AddPayload(f"./{HIGH_FILE}")
                _bind(dense, high[0])
                for name in high if len(high) > 1 else ():
                    _bind(stage.OverridePrim(dense.GetPath().AppendChild(name)), name)
            else:
                shown = stage.OverridePrim(path.AppendPath("geo/proxy"))
                purpose = shown.CreateAttribute("purpose", Sdf.ValueTypeNames.Token, False, Sdf.VariabilityUniform)
                purpose.Set(UsdGeom.Tokens.default_)
    lods.SetVariantSelection(RENDER)


def _bind(prim: Usd.Prim, name: str) -> None:
    """Bind a material of the default prim."""
    root = prim.GetPath().GetPrefixes()[0]
    bound = UsdShade.MaterialBindingAPI.Apply(prim).GetDirectBindingRel()
    bound.SetTargets([root.AppendPath(f"mtl/{name}")])


def without_displacement(stage: Usd.Stage, prim: Usd.Prim, look: Look, names: Sequence[str]) -> None:
    """Take the displacement out of the materials of these names where the mesh is no cage: the dense mesh, the
    proxy."""
    materials = [prim.GetPath().AppendPath(f"mtl/{name}") for name in names]
    outputs = [f"outputs:{HEIGHT}", *([f"outputs:mtlx:{HEIGHT}"] if look.f0 and look.roughness else [])]
    surfaces = ["preview", *(["preview_specular"] if look.specular else [])]
    lods = prim.GetVariantSets().GetVariantSet("lod")
    for variant in lods.GetVariantNames():
        if variant == RENDER:
            continue
        lods.SetVariantSelection(variant)
        with lods.GetVariantEditContext():
            for material, output in product(materials, outputs):
                over = stage.OverridePrim(material)
                over.CreateAttribute(output, Sdf.ValueTypeNames.Token, custom=False).SetConnections([])
            for material, surface in product(materials, surfaces):
                over = stage.OverridePrim(material.AppendPath(surface))
                over.CreateAttribute(f"inputs:{HEIGHT}", Sdf.ValueTypeNames.Float, custom=False).SetConnections([])
    lods.SetVariantSelection(RENDER)


def write_meshes(stage: Usd.Stage, prim: Usd.Prim, *, beside: tuple[str, ...]) -> None:
    """Variant set `mesh`: the template's cage with the meshes beside it, or the scan's triangles."""
    shown = {TEMPLATE: [RENDER, *beside], SCAN: [SCAN]}
    meshes = prim.GetVariantSets().AddVariantSet("mesh")
    for variant, other in ((TEMPLATE, SCAN), (SCAN, TEMPLATE)):
        meshes.AddVariant(variant)
        meshes.SetVariantSelection(variant)
        with meshes.GetVariantEditContext():
            for hidden in shown[other]:
                stage.OverridePrim(prim.GetPath().AppendPath(f"geo/{hidden}")).SetActive(False)
    meshes.SetVariantSelection(TEMPLATE)
