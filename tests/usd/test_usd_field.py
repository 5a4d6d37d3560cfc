"""The look of a light stage's field: its files, the variant, the page's reference, the shader in Blender."""

from __future__ import annotations

import json
import os
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from pxr import Sdf, Usd, UsdShade, UsdUtils
from support.small_field import small_field, written_field
from support.spread import made_once
from support.synthetic_asset import SyntheticInputs, ball, run_stage, write_inputs

from pipeline.errors import StageError
from pipeline.images import read_exr
from pipeline.map_lookup import bilinear
from pipeline.meshes import Charts, Mesh
from stages.reflectance.field import Field, Lamp
from stages.usd.check.validate import validate
from stages.usd.write.field_files import SHADER, write_field

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/field_look.md").read_text()
TEMPLATE = ROOT / "stages/usd/write/reflectance_field.osl"
LAMP, EYE, STRENGTH = np.array([0.5, 0.6, 0.9]), np.array([-0.6, 0.1, 0.5]), np.array([4.0, 3.0, 2.0])
AXIS = -LAMP / np.linalg.norm(LAMP)


def page_code() -> dict:
    names: dict = {}
    exec(re.findall(r"```python\n(.*?)```", PAGE, re.S)[0], names)  # noqa: S102
    return names


def made_field() -> Field:
    mesh = ball()
    return small_field(Mesh(mesh["vertices"], mesh["normals"], mesh["faces"]), Charts(mesh["uvs"], mesh["uv_faces"]))


@pytest.fixture(scope="module")
def asset(inputs: SyntheticInputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """asset/ of a light stage's run."""

    def export(folder: Path) -> Path:
        lit = replace(inputs, reflectance=written_field(folder / "field", made_field()))
        found = run_stage(lit, folder / "work", render_views=False, film_frames=0)
        assert not found.warnings
        listed = {f.path for f in found.files if f.path.startswith("asset/reflectance_field/")}
        there = {p.relative_to(folder / "work").as_posix() for p in (folder / "work/asset/reflectance_field").iterdir()}
        assert listed == there
        return folder / "work/asset"

    return made_once(tmp_path_factory, "usd_field", export)


def basis_of(asset: Path) -> dict:
    return json.loads((asset / "reflectance_field/head_basis.json").read_text())


def test_basis_json_names_every_file_with_its_channels(asset: Path) -> None:
    folder, basis = asset / "reflectance_field", basis_of(asset)
    named = {one["file"] for one in basis["files"].values()}
    assert named | {"head_basis.json", "head_field.osl"} == {p.name for p in folder.iterdir()}
    for one in basis["files"].values():
        if "channels" in one:
            with OpenEXR.File(str(folder / one["file"]), separate_channels=True) as f:
                assert sorted(f.channels()) == sorted(one["channels"])
    assert len(basis["files"]["rest"]["channels"]) == 3 * len(basis["harmonics"]) == 27
    assert len(basis["files"]["trust"]["channels"]) == len(basis["towards"]) == len(basis["lights"]) == 7


def test_the_page_names_every_file_and_every_entry(asset: Path) -> None:
    rows = PAGE.partition("## In USD")[0]
    for path in (asset / "reflectance_field").iterdir():
        assert f"`{path.name.replace('head', 'NAME', 1)}`" in rows, path.name
    for entry in basis_of(asset):
        assert f"`{entry}`" in rows, entry


def test_the_maps_are_second_names_of_the_fields(asset: Path) -> None:
    field = asset.parents[1] / "field/reflectance"
    for path in (asset / "reflectance_field").glob("*.exr"):
        assert path.samefile(field / path.name.removeprefix("head_"))


def test_the_look_adds_the_files_and_keeps_what_viewers_show(asset: Path) -> None:
    stage = Usd.Stage.Open(str(asset / "head.usd"))
    looks = stage.GetDefaultPrim().GetVariantSet("look")
    assert looks.GetVariantSelection() == "standard" and "reflectance_field" in looks.GetVariantNames()
    material = UsdShade.Material.Get(stage, "/head/mtl/captured")
    before = [material.ComputeSurfaceSource(c)[0].GetPath() for c in ("", "mtlx")]
    assert not fields(material.GetPrim())
    looks.SetVariantSelection("reflectance_field")
    assert [material.ComputeSurfaceSource(c)[0].GetPath() for c in ("", "mtlx")] == before
    said = {a.GetBaseName(): Path(a.Get().resolvedPath) for a in fields(material.GetPrim())}
    folder = asset / "reflectance_field"
    assert set(said.values()) == set(folder.iterdir())
    assert said["trust"] == folder / "head_trust.exr" and said["field"] == folder / "head_field.osl"


def fields(prim: Usd.Prim) -> list[Usd.Attribute]:
    return [a for a in prim.GetAttributes() if a.GetNamespace() == "reflectance_field"]


def test_it_is_a_valid_asset_also_where_the_look_is_chosen(asset: Path) -> None:
    """The library's validators see the chosen variant only."""
    layer = Sdf.Layer.OpenAsAnonymous(str(asset / "head.usd"))
    layer.GetPrimAtPath("/head").variantSelections["look"] = "reflectance_field"
    chosen = asset / "chosen.usda"
    layer.Export(str(chosen))
    for path in (asset / "head.usd", chosen):
        assert [f for f in validate(path) if f.level != "info"] == []
        assert not UsdUtils.ComputeAllDependencies(str(path))[2]
    chosen.unlink()


def test_only_the_first_tile_has_the_field(tmp_path: Path) -> None:
    lit = replace(write_inputs(tmp_path / "in", tiled=True), reflectance=written_field(tmp_path / "f", made_field()))
    run_stage(lit, tmp_path / "work", render_views=False, film_frames=0, glb=False, obj=False, usdz=False)
    stage = Usd.Stage.Open(str(tmp_path / "work/asset/head.usd"))
    stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection("reflectance_field")
    assert [str(p.GetPath()) for p in stage.Traverse() if fields(p)] == ["/head/mtl/captured_1001"]


def test_other_captures_have_nothing_of_it(exported) -> None:
    asset = exported[0] / "asset"
    assert not (asset / "reflectance_field").exists()
    assert "reflectance_field" not in (asset / "head.usd").read_text()


def test_a_field_without_its_files_is_named(tmp_path: Path) -> None:
    whole = written_field(tmp_path, made_field())
    files = tuple(f for f in whole.artifact.files if not f.path.endswith(("trust.exr", "blocker.obj")))
    with pytest.raises(StageError, match=r"trust\.exr, blocker\.obj"):
        write_field(replace(whole, artifact=whole.artifact.model_copy(update={"files": files})), "head", tmp_path / "a")


def test_the_pages_reference_is_the_projects_evaluation(asset: Path) -> None:
    """From the exported files alone; half of the texels face away from the lamp or lie in shadow."""
    field, code = made_field(), page_code()
    opened = code["opened"](asset / "reflectance_field/head_basis.json")
    lamp = Lamp(LAMP, AXIS, STRENGTH)
    arrives = field.arrives(lamp)
    found = field.radiance(lamp, EYE, arrives)
    towards = LAMP - field.points.position
    cosine = (field.normal * towards).sum(1) / np.linalg.norm(towards, axis=1)
    grazing = np.flatnonzero((cosine > 0) & (cosine < 0.02) & (arrives > 0.5))[:20]
    assert len(grazing) > 5  # where the least n.l of a lobe matters
    picked = np.concatenate([np.random.default_rng(0).permutation(len(found))[:150], grazing])
    assert (arrives[picked] < 0.5).sum() > 20 and (arrives[picked] > 0.5).sum() > 20
    for t in picked:
        row, column = divmod(int(field.points.texel[t]), field.points.size)
        said = code["at_texel"](opened, row, column, LAMP, AXIS, STRENGTH, EYE)
        np.testing.assert_allclose(said, found[t], rtol=1e-5, atol=1e-6)


def test_the_page_shows_the_shader() -> None:
    assert re.findall(r"```c\n(.*?)```", PAGE, re.S) == [TEMPLATE.read_text()]


def test_the_shader_is_told_the_numbers_of_basis_json(asset: Path) -> None:
    """Each name in capitals is defined once, and the lists are as long as they say."""
    text, basis = (asset / "reflectance_field/head_field.osl").read_text(), basis_of(asset)
    defined = dict(re.findall(r"^#define (\w+) (.*)$", text, re.M))
    body = re.sub(r"//.*|\"[^\"]*\"", "", TEMPLATE.read_text())
    used = set(re.findall(r"\b[A-Z][A-Z_]+\b", body)) - {"M_PI", "M_2PI", "READ", "UV"}
    assert used <= set(defined) and TEMPLATE.read_text() in text
    for name in ("TOWARDS", "TERMS", "ALPHAS"):
        values = [float(x) for x in defined[name].strip("{} ").split(",")]
        assert len(values) == int(defined[f"{name}_COUNT"])
    np.testing.assert_allclose(
        [float(x) for x in defined["TOWARDS"].strip("{} ").split(",")], np.ravel(basis["towards"]), rtol=1e-7
    )
    assert int(defined["LIGHTS"]) == len(basis["towards"]) and defined["TRUST"] == '"head_trust.exr"'


# ------------------------------------------------------------------ in Blender
PROBES = {
    "uv": "color(UV[0], UV[1], 0)",
    "place": 'color(transform("object", P))',
    "across": 'color(normalize(transform("object", vector(N))))',
}
PROBE = (
    "shader probe(point UV = point(u, v, 0), output closure color Surface = 0) {{ Surface = emission() * ({} + 4); }}"
)
SCRIPT = """
import json, os, sys
import bpy
sys.path.append(os.path.join(bpy.utils.resource_path("LOCAL"), "python", "lib",
                             "python%d.%d" % sys.version_info[:2], "site-packages"))  # oslquery
from cycles import osl
from mathutils import Matrix, Vector
job = json.loads(open(sys.argv[-1]).read())
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=job["asset"])
scene = bpy.context.scene
scene.render.engine, scene.cycles.device, scene.cycles.shading_system = "CYCLES", "CPU", True
mesh = next(o for o in scene.objects if o.type == "MESH" and o.name.startswith("render"))
for other in [o for o in scene.objects if o.type == "MESH" and o is not mesh]:
    bpy.data.objects.remove(other)
camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
back = Vector(job["eye"]).normalized()
right = Vector((0, 1, 0)).cross(back).normalized()
turned = Matrix((right, back.cross(right), back)).transposed().to_4x4()
camera.matrix_world = mesh.matrix_world @ Matrix.Translation(job["eye"]) @ turned
camera.data.angle = 0.4
scene.collection.objects.link(camera)
scene.camera = camera
render = scene.render
render.resolution_x = render.resolution_y = job["side"]
render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
render.film_transparent = True
scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 1, False, False
scene.view_settings.view_transform = "Raw"
for name, file in job["shaders"].items():
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    node = tree.nodes.new("ShaderNodeScript")
    node.mode, node.filepath = "EXTERNAL", file
    osl.update_script_node(node, lambda kind, text: print(kind, text))
    place = tree.nodes.new("ShaderNodeUVMap")
    tree.links.new(place.outputs[0], node.inputs["UV"])
    for key, value in job["values"].items():
        if key in node.inputs:
            node.inputs[key].default_value = value
    tree.links.new(node.outputs["Surface"], tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    mesh.data.materials.clear()
    mesh.data.materials.append(material)
    render.filepath = os.path.join(job["out"], name + ".exr")
    bpy.ops.render.render(write_still=True)
print("DONE")
"""


def in_blender(asset: Path, folder: Path, side: int = 96) -> dict[str, np.ndarray]:
    """(side, side, 4) pictures of the field's shader and of the probes, each of one ray through the same place of a
    pixel. Skips without Blender."""
    program = os.environ.get("NEUFACE_BLENDER", "")
    if not program:
        pytest.skip("NEUFACE_BLENDER names no Blender: OSL is not run")
    folder.mkdir(parents=True, exist_ok=True)
    shaders = {"field": str(asset / "reflectance_field" / f"head_{SHADER}.osl")}
    for name, value in PROBES.items():
        (folder / f"{name}.osl").write_text(PROBE.format(value))
        shaders[name] = str(folder / f"{name}.osl")
    values = {"folder": f"{asset}/reflectance_field/", "lamp": LAMP.tolist(), "axis": AXIS.tolist(),
              "strength": [*STRENGTH.tolist(), 1.0]}  # fmt: skip
    job = {"asset": str(asset / "head.usd"), "shaders": shaders, "values": values, "out": str(folder), "side": side,
           "eye": EYE.tolist()}  # fmt: skip
    (folder / "job.json").write_text(json.dumps(job))
    (folder / "script.py").write_text(SCRIPT)
    words = [str(folder / "script.py")]
    if "python" not in Path(program).name:
        words = ["--background", "--factory-startup", "--python", *words]
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    ran = subprocess.run([program, *words, "--", str(folder / "job.json")], capture_output=True, text=True,
                         timeout=900, env=clean)  # fmt: skip
    assert "DONE" in ran.stdout, ran.stdout[-2000:] + ran.stderr[-2000:]
    return {name: read_exr(folder / f"{name}.exr")[0] for name in shaders}


def grazing_pixels(maps: dict[str, np.ndarray], shown: dict[str, np.ndarray], inside: np.ndarray) -> np.ndarray:
    """(N, 2) up to 20 of the pixels whose n.l is between 0 and a lobe's least."""
    uv, place = (shown[name][*inside.T, :3].astype(np.float64) - 4 for name in ("uv", "place"))
    normal = bilinear(maps["normal"].astype(np.float32), uv[:, :2]).astype(np.float64)
    towards = LAMP - place
    cosine = (normal * towards).sum(1) / np.linalg.norm(normal, axis=1) / np.linalg.norm(towards, axis=1)
    return inside[(cosine > 0.001) & (cosine < 0.019)][:20]


@pytest.mark.slow
def test_the_shader_gives_the_numbers_of_the_page_in_blender(asset: Path, tmp_path: Path) -> None:
    """Each pixel's place and texture coordinates, as Blender has them, into the page's reference."""
    shown = in_blender(asset, tmp_path / "blender")
    code = page_code()
    basis, maps, triangles = code["opened"](asset / "reflectance_field/head_basis.json")
    inside = np.argwhere(shown["uv"][..., 3] > 0.999)
    assert len(inside) > 1000
    differences, open_shares, largest = [], [], 0.0
    grazing = grazing_pixels(maps, shown, inside)
    assert len(grazing) > 5  # where the least n.l of a lobe matters
    for y, x in np.concatenate([np.random.default_rng(0).permutation(inside)[:400], grazing]):
        uv, p, n = (shown[name][y, x, :3].astype(np.float64) - 4 for name in PROBES)
        texel = {k: bilinear(m.astype(np.float32), uv[None, :2])[0].astype(np.float64) for k, m in maps.items()}
        share = code["traced"](p, n, LAMP, AXIS, triangles, basis["shadow"])
        said = code["radiance"](p, texel, basis, LAMP, AXIS, STRENGTH, EYE, share)
        open_shares.append(share)
        differences.append(np.abs(said - shown["field"][y, x, :3]).max())
        largest = max(largest, float(said.max()))
    print(f"OSL against the page: median {np.median(differences):.2e}, 99 % {np.quantile(differences, 0.99):.2e}, "
          f"largest {max(differences):.2e} of values up to {largest:.2f}")  # fmt: skip
    assert min(np.mean(open_shares), 1 - np.mean(open_shares)) > 0.2  # lit and shadowed
    assert np.quantile(differences, 0.99) < 1e-4 * largest
