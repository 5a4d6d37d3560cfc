"""Checks of materials that the USD library does not make: connections, colour spaces, MaterialX."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from stages.usd.check.findings import Finding
from stages.usd.colour_spaces import ACESCG, DATA, LINEAR, SRGB

COLOURS = ("diffuseColor", "specularColor", "emissiveColor")  # inputs of UsdPreviewSurface whose 8-bit maps are sRGB
EIGHT_BIT = (".png", ".jpg", ".jpeg")
SRGB_NAMES = (SRGB, "srgb", "sRGB")
KNOWN_SPACES = (*SRGB_NAMES, DATA, LINEAR, ACESCG, "Raw")
VALUE_TYPES = {
    "float": "float",
    "int": "integer",
    "bool": "boolean",
    "color3f": "color3",
    "color4f": "color4",
    "float2": "vector2",
    "float3": "vector3",
    "vector3f": "vector3",
    "float4": "vector4",
    "string": "string",
    "asset": "filename",
}


def material_findings(stage: Usd.Stage) -> list[Finding]:
    """Every mesh must be bound to a material with a surface; every connection must end at an existing attribute."""
    out = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Mesh):
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
            if not material:
                out.append(Finding("error", "material", "no material is bound", str(prim.GetPath())))
            elif not material.ComputeSurfaceSource()[0]:
                out.append(Finding("error", "material", "it has no surface shader", str(material.GetPath())))
        for attribute in prim.GetAttributes():
            out += [
                Finding("error", "connection", f"connected to {target}, which is missing", str(attribute.GetPath()))
                for target in attribute.GetConnections()
                if not stage.GetAttributeAtPath(target)
            ]
    return out


# ------------------------------------------------------------------ colour spaces
def colour_findings(stage: Usd.Stage) -> list[Finding]:
    """Colours in 8-bit files must be read as sRGB; data, and everything in float files, as raw values."""
    out: list[Finding] = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        shader = UsdShade.Shader(prim)
        if not shader:
            continue
        identifier = str(shader.GetShaderId() or "")
        if identifier == "UsdPreviewSurface":
            out += _preview_colours(shader)
        elif identifier.startswith("ND_image_"):
            file = shader.GetInput("file")
            path = file.Get().path if file and file.Get() else ""
            found = file.GetAttr().GetColorSpace() if file else ""
            want = _is_colour(path, identifier in ("ND_image_color3", "ND_image_color4"))
            if path and found and found not in KNOWN_SPACES:
                message = f"{path} has the colour space {found}, which is none of {', '.join(KNOWN_SPACES)}"
                out.append(Finding("error", "colour_space", message, str(file.GetAttr().GetPath())))
            elif path and want != (found in SRGB_NAMES):
                out.append(_swapped(path, found or "none", want, str(file.GetAttr().GetPath())))
    return list(dict.fromkeys(out))


def _preview_colours(surface: UsdShade.Shader) -> Iterator[Finding]:
    for target in surface.GetInputs():
        for source in target.GetConnectedSources()[0]:
            texture = UsdShade.Shader(source.source.GetPrim())
            if texture.GetShaderId() != "UsdUVTexture":
                continue
            file, space = texture.GetInput("file"), texture.GetInput("sourceColorSpace")
            path = file.Get().path if file and file.Get() else ""
            found = str(space.Get() if space and space.Get() else "auto")
            want = _is_colour(path, target.GetBaseName() in COLOURS)
            if path and found != ("sRGB" if want else "raw"):
                yield _swapped(path, found, want, str(texture.GetPath()))


def _is_colour(path: str, colour: bool) -> bool:
    return colour and path.lower().endswith(EIGHT_BIT)


def _swapped(path: str, found: str, colour: bool, where: str) -> Finding:
    wanted = "sRGB" if colour else "raw"
    return Finding("error", "colour_space", f"{path} is read as {found}, expected {wanted}", where)


# ------------------------------------------------------------------ MaterialX
def materialx_findings(stage: Usd.Stage, known: frozenset[Sdf.Path] = frozenset()) -> list[Finding]:
    """Check each material's `mtlx` surface as a MaterialX document: definitions, types, validity, generated shaders.

    Surfaces in `known` are skipped. Without the MaterialX package a finding states that nothing was checked.
    """
    out = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        material = UsdShade.Material(prim)
        output = material.GetSurfaceOutput("mtlx") if material else None
        if not output or not output.HasConnectedSource():
            continue
        try:
            import MaterialX  # noqa: F401
        except ImportError:
            return [Finding("info", "materialx", "the MaterialX package is not installed: networks were not checked")]
        root = output.GetConnectedSources()[0][0].source.GetPrim()
        if root.GetPath() in known:
            continue
        out += _document_findings(root, str(prim.GetPath()))
    return out


def materialx_surfaces(stage: Usd.Stage) -> frozenset[Sdf.Path]:
    """The shaders that are the `mtlx` surface of a material."""
    outputs = [UsdShade.Material(p).GetSurfaceOutput("mtlx") for p in stage.Traverse() if p.IsA(UsdShade.Material)]
    sources = [s for o in outputs if o for s in o.GetConnectedSources()[0]]
    return frozenset(s.source.GetPrim().GetPath() for s in sources)


def _document_findings(root: Usd.Prim, where: str) -> list[Finding]:
    import MaterialX as mx

    document = mx.createDocument()
    document.importLibrary(_library())
    graph = document.addNodeGraph("captured_network")
    prims = _closure(root)
    names = {path: mx.createValidName(str(path).strip("/").replace("/", "_")) for path in prims}
    faults: list[Finding] = []
    for path, prim in prims.items():
        shader = UsdShade.Shader(prim)
        definition = document.getNodeDef(str(shader.GetShaderId() or ""))
        if definition is None:
            text = f"MaterialX {mx.getVersionString()} has no '{shader.GetShaderId()}'"
            faults.append(Finding("error", "materialx_node", text, str(path)))
            continue
        parent = document if prim == root else graph
        node = parent.addNode(definition.getNodeString(), names[path], definition.getType())
        node.setNodeDefString(definition.getName())
        for given in shader.GetInputs():
            faults += _input_findings(given, node, definition, names, graph, outside=prim == root)
    if faults:
        return faults
    surface = document.getNode(names[root.GetPath()])
    if surface is None or surface.getType() != "surfaceshader":
        return [Finding("error", "materialx", "the surface is not a surface shader", where)]
    material = document.addNode("surfacematerial", "captured_material", "material")
    material.addInput("surfaceshader", "surfaceshader").setNodeName(surface.getName())
    valid, message = document.validate()
    if not valid:
        return [Finding("error", "materialx_document", " ".join(message.split())[:400], where)]
    return _generated(document, material, where)


def _input_findings(
    given: UsdShade.Input, node: Any, definition: Any, names: dict[Sdf.Path, str], graph: Any, *, outside: bool
) -> list[Finding]:
    """Copy one input into the document, and return what does not match its definition."""
    where, name = str(given.GetAttr().GetPath()), given.GetBaseName()
    wanted = definition.getActiveInput(name)
    if wanted is None:
        return [Finding("error", "materialx_input", f"{definition.getName()} has no input '{name}'", where)]
    kind = VALUE_TYPES.get(str(given.GetTypeName()), str(given.GetTypeName()))
    if kind != wanted.getType():
        return [Finding("error", "materialx_type", f"{kind}, the definition has {wanted.getType()}", where)]
    made = node.addInput(name, wanted.getType())
    sources = given.GetConnectedSources()[0]
    if not sources:
        value = given.Get()
        if value is not None:
            made.setValueString(_text(value))
            space = given.GetAttr().GetColorSpace() if given.GetAttr().HasColorSpace() else ""
            if space not in ("", "raw"):
                made.setColorSpace(space)
        return []
    source = names.get(sources[0].source.GetPath())
    if source is None:
        return [Finding("error", "connection", "the source does not exist", where)]
    if outside:
        output = graph.getOutput(f"out_{name}") or graph.addOutput(f"out_{name}", wanted.getType())
        output.setNodeName(source)
        made.setNodeGraphString(graph.getName())
        made.setOutputString(output.getName())
    else:
        made.setNodeName(source)
    return []


def _generated(document: Any, material: Any, where: str) -> list[Finding]:
    """Findings of generating shader code in the three languages that renderers use."""
    import MaterialX as mx
    from MaterialX import PyMaterialXGenGlsl, PyMaterialXGenMdl, PyMaterialXGenOsl
    from MaterialX import PyMaterialXGenShader as gen

    out = []
    for maker in (
        PyMaterialXGenGlsl.GlslShaderGenerator,
        PyMaterialXGenOsl.OslShaderGenerator,
        PyMaterialXGenMdl.MdlShaderGenerator,
    ):
        generator = maker.create()
        context = gen.GenContext(generator)
        context.registerSourceCodeSearchPath(mx.getDefaultDataSearchPath())
        colours = gen.DefaultColorManagementSystem.create(generator.getTarget())
        colours.loadLibrary(document)
        generator.setColorManagementSystem(colours)
        units = gen.UnitSystem.create(generator.getTarget())
        units.loadLibrary(document)
        units.setUnitConverterRegistry(mx.UnitConverterRegistry.create())
        generator.setUnitSystem(units)
        try:
            code = generator.generate("captured", material, context).getSourceCode("pixel")
        except (mx.Exception, LookupError, RuntimeError) as e:
            text = f"{generator.getTarget()}: {' '.join(str(e).split())[:300]}"
            out.append(Finding("error", "materialx_shader", text, where))
            continue
        if not code:
            out.append(Finding("error", "materialx_shader", f"{generator.getTarget()}: no code", where))
    return out


_LIBRARY: list[object] = []


def _library() -> Any:
    """The standard definitions, read once."""
    import MaterialX as mx

    if not _LIBRARY:
        found = mx.createDocument()
        mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), found)
        _LIBRARY.append(found)
    return _LIBRARY[0]


def _closure(root: Usd.Prim) -> dict[Sdf.Path, Usd.Prim]:
    """The shaders that `root` depends on, `root` first."""
    found, waiting = {root.GetPath(): root}, [root]
    while waiting:
        for given in UsdShade.Shader(waiting.pop()).GetInputs():
            for source in given.GetConnectedSources()[0]:
                prim = source.source.GetPrim()
                if prim.GetPath() not in found:
                    found[prim.GetPath()] = prim
                    waiting.append(prim)
    return found


def _text(value: object) -> str:
    if isinstance(value, Sdf.AssetPath):
        return str(value.path)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (Gf.Vec2f, Gf.Vec3f, Gf.Vec4f)):
        return ", ".join(f"{x:g}" for x in value)
    return str(value)
