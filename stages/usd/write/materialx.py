"""The material's MaterialX networks, of standard nodes only, because importers fail on custom node definitions.

`openpbr`        OpenPBR with albedo, roughness, normal, and F0 as `specular_weight`
`openpbr_subsurface`  the same, of skin that scatters light below its surface (subsurface.py)
`neuface_basis`  OpenPBR whose specular tint is the learned lobe itself:

    tint = sum_j c_j(x) T_j(n.v, 1/kappa(x)),     T_j = B_j / R of the layer

    viewdirection, normal -> facingratio -> combine2(n.v, 2/kappa) -> image T -> dotproduct(image c) -> specular_color

View direction and normal are connected explicitly, because renderers have different defaults.
"""

from __future__ import annotations

from pxr import Gf, Sdf, Usd, UsdShade

from pipeline import tiles
from stages.usd.colour_spaces import DATA, SRGB
from stages.usd.write.ggx_conversion import INV_KAPPA_SCALE, REFERENCE_F0, REFERENCE_IOR
from stages.usd.write.shading import HEIGHT, Look, T, connect, shader
from stages.usd.write.subsurface import radius_and_scale

SURFACE, DISPLACEMENT = "ND_open_pbr_surface_surfaceshader", "ND_displacement_float"
CONFIG_SCHEMA, VERSION = "MaterialXConfigAPI", "1.39"
SCATTERS = "openpbr_subsurface"
LARGEST_F0 = 0.16  # `specular_weight` = 4: limits the reflectance of a failed fit


class _Nodes:
    """Authors nodes below one prim of the material, and reuses texture readers."""

    def __init__(self, stage: Usd.Stage, path: str) -> None:
        self.stage, self.path = stage, path
        UsdShade.NodeGraph.Define(stage, path)
        node = shader(stage, f"{path}/st", "ND_geompropvalue_vector2")
        node.CreateInput("geomprop", T.String).Set("st")
        self.st = node.CreateOutput("out", T.Float2)

    def node(self, name: str, identifier: str, out: Sdf.ValueTypeName, **inputs: object) -> UsdShade.Output:
        """Author a node; inputs are outputs of other nodes, or (type, value)."""
        made = shader(self.stage, f"{self.path}/{name}", identifier)
        for key, value in inputs.items():
            key = key.rstrip("_")
            if isinstance(value, UsdShade.Output):
                connect(made.CreateInput(key, value.GetTypeName()), value)
            elif isinstance(value, tuple):
                made.CreateInput(key, value[0]).Set(value[1])
        return made.CreateOutput("out", out)

    def image(self, name: str, kind: str, out: Sdf.ValueTypeName, file: str, space: str) -> UsdShade.Output:
        """Author a texture lookup at st."""
        return self.image_at(name, kind, out, file, space, self.st)

    def image_at(
        self, name: str, kind: str, out: Sdf.ValueTypeName, file: str, space: str, at: UsdShade.Output
    ) -> UsdShade.Output:
        """Author a texture lookup at `at`; clamped, unless it has tiles."""
        made = shader(self.stage, f"{self.path}/{name}", f"ND_image_{kind}")
        picture = made.CreateInput("file", T.Asset)
        picture.Set(Sdf.AssetPath(file))
        picture.GetAttr().SetColorSpace(space)
        connect(made.CreateInput("texcoord", T.Float2), at)
        for axis in "uv" if tiles.TOKEN not in file else "":  # clamping would apply to the whole row of tiles
            made.CreateInput(f"{axis}addressmode", T.String).Set("clamp")
        return made.CreateOutput("out", out)


def materialx_networks(stage: Usd.Stage, material: UsdShade.Material, look: Look) -> list[str]:
    """Author the networks for which the look has maps. The first becomes outputs:mtlx:surface. Returns their names."""
    path, made = str(material.GetPath()), []
    if look.roughness and look.f0:
        made.append("openpbr")
        _surface(stage, f"{path}/openpbr", look, basis=False)
        if look.subsurface:
            made.append(SCATTERS)
            _surface(stage, f"{path}/{SCATTERS}", look, basis=False, scatters=True)
    if look.roughness and look.coefficients and look.inv_kappa:
        made.append("neuface_basis")
        _surface(stage, f"{path}/neuface_basis", look, basis=True)
    if made:
        _outputs(stage, material, f"{path}/{made[0]}", look)
    return made


def eye_network(stage: Usd.Stage, material: UsdShade.Material, look: Look, ior: float, roughness: float) -> None:
    """Author `openpbr` of an eye: the head's colours under a clear surface of one roughness."""
    path = f"{material.GetPath()}/openpbr"
    nodes = _Nodes(stage, path)
    surface = shader(stage, f"{path}/surface", SURFACE)
    connect(surface.CreateInput("base_color", T.Color3f), nodes.image("albedo", "color3", T.Color3f, *look.base()))
    for name, value in (
        ("base_weight", 1.0),
        ("specular_weight", 1.0),
        ("specular_ior", ior),
        ("specular_roughness", roughness),
    ):
        surface.CreateInput(name, T.Float).Set(value)
    surface.CreateOutput("out", T.Token)
    _outputs(stage, material, path, look)


def _outputs(stage: Usd.Stage, material: UsdShade.Material, network: str, look: Look) -> None:
    """Make a network the material's MaterialX surface, with its displacement."""
    prim = material.GetPrim()
    prim.AddAppliedSchema(CONFIG_SCHEMA)  # not ApplyAPI: some builds have no plugin of this schema
    prim.CreateAttribute("config:mtlx:version", T.String, False, Sdf.VariabilityUniform).Set(VERSION)
    output = UsdShade.Shader.Get(stage, f"{network}/surface").ConnectableAPI()
    material.CreateSurfaceOutput("mtlx").ConnectToSource(output, "out")
    if look.displacement:
        height = _displacement(stage, network, look.displacement)
        material.CreateDisplacementOutput("mtlx").ConnectToSource(height.ConnectableAPI(), "out")


def _displacement(stage: Usd.Stage, path: str, file: str) -> UsdShade.Shader:
    """Displacement in metres, which are the units of the scene. It is the same in all networks."""
    nodes = _Nodes(stage, path)
    height = nodes.image("height", "float", T.Float, file, DATA)
    out = shader(stage, f"{path}/{HEIGHT}", DISPLACEMENT)
    connect(out.CreateInput("displacement", T.Float), height)
    out.CreateInput("scale", T.Float).Set(1.0)
    out.CreateOutput("out", T.Token)
    return out


def _surface(stage: Usd.Stage, path: str, look: Look, *, basis: bool, scatters: bool = False) -> None:
    nodes = _Nodes(stage, path)
    surface = shader(stage, f"{path}/surface", SURFACE)
    surface.CreateInput("base_weight", T.Float).Set(1.0)
    colour = (look.neuface_albedo, SRGB) if basis and look.neuface_albedo else look.base()
    albedo = nodes.image("albedo", "color3", T.Color3f, *colour)
    connect(surface.CreateInput("base_color", T.Color3f), albedo)
    roughness = nodes.image("roughness", "float", T.Float, str(look.roughness), DATA)
    connect(surface.CreateInput("specular_roughness", T.Float), roughness)
    surface.CreateInput("specular_ior", T.Float).Set(REFERENCE_IOR)
    normal = _normal(nodes, look)
    connect(surface.CreateInput("geometry_normal", T.Float3), normal)
    if basis:
        surface.CreateInput("specular_weight", T.Float).Set(1.0)
        connect(surface.CreateInput("specular_color", T.Color3f), _tint(nodes, look, normal))
    else:
        f0 = nodes.image("f0", "float", T.Float, str(look.f0), DATA)
        bounded = nodes.node("f0_bounded", "ND_clamp_float", T.Float, **{"in": f0, "high": (T.Float, LARGEST_F0)})
        weight = nodes.node(
            "weight", "ND_multiply_float", T.Float, in1=bounded, in2=(T.Float, round(1 / REFERENCE_F0, 6))
        )
        connect(surface.CreateInput("specular_weight", T.Float), weight)
    if scatters:
        _scatter(surface, nodes, look, albedo)
    surface.CreateOutput("out", T.Token)


def _scatter(surface: UsdShade.Shader, nodes: _Nodes, look: Look, albedo: UsdShade.Output) -> None:
    """Let the base scatter where the map says so."""
    weight = nodes.image("scatters", "float", T.Float, str(look.subsurface), DATA)
    connect(surface.CreateInput("subsurface_weight", T.Float), weight)
    connect(surface.CreateInput("subsurface_color", T.Color3f), albedo)
    radius, scale = radius_and_scale()
    surface.CreateInput("subsurface_radius", T.Float).Set(radius)
    surface.CreateInput("subsurface_radius_scale", T.Color3f).Set(Gf.Vec3f(*scale))


def _normal(nodes: _Nodes, look: Look) -> UsdShade.Output:
    smooth = nodes.node("mesh_normal", "ND_normal_vector3", T.Float3, space=(T.String, "world"))
    if not look.normal:
        return smooth
    stored = nodes.image("normal", "vector3", T.Float3, look.normal, DATA)
    tangent = nodes.node("tangent", "ND_tangent_vector3", T.Float3, space=(T.String, "world"))
    return nodes.node(
        "bent_normal", "ND_normalmap_float", T.Float3, **{"in": stored, "normal": smooth, "tangent": tangent}
    )


def _tint(nodes: _Nodes, look: Look, normal: UsdShade.Output) -> UsdShade.Output:
    view = nodes.node("view", "ND_viewdirection_vector3", T.Float3, space=(T.String, "world"))
    cosine = nodes.node("cosine", "ND_facingratio_float", T.Float, viewdirection=view, normal=normal)
    inv_kappa = nodes.image("inv_kappa", "float", T.Float, str(look.inv_kappa), DATA)
    row = nodes.node("row", "ND_multiply_float", T.Float, in1=inv_kappa, in2=(T.Float, INV_KAPPA_SCALE))
    at = nodes.node("place", "ND_combine2_vector2", T.Float2, in1=cosine, in2=row)
    total: UsdShade.Output | None = None
    for i, (c, b) in enumerate(zip(look.coefficients, look.basis, strict=True)):
        coefficients = nodes.image(f"coefficients_{i}", "vector3", T.Float3, c, DATA)
        table = nodes.image_at(f"basis_{i}", "vector3", T.Float3, b, DATA, at)
        dot = nodes.node(f"dot_{i}", "ND_dotproduct_vector3", T.Float, in1=coefficients, in2=table)
        total = dot if total is None else nodes.node(f"sum_{i}", "ND_add_float", T.Float, in1=total, in2=dot)
    assert total is not None
    return nodes.node("tint", "ND_convert_float_color3", T.Color3f, **{"in": total})
