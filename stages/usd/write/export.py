"""Writes every file of the asset into one folder."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pxr import Gf, Sdf

from pipeline.artifacts import CameraSet, FittedFace, Located, Surface, TextureSet, UvMesh
from pipeline.capture_artifacts import Capture
from pipeline.errors import StageError
from pipeline.fitted_cameras import cameras_of
from pipeline.head_artifacts import RegisteredHead
from pipeline.images import write_exr
from pipeline.lighting.captured import captured_environment, irradiance_error
from pipeline.lighting.dome import environment_figures, light_json, read_light, read_moving
from pipeline.lighting.surroundings import surroundings_of
from pipeline.reflectance_artifacts import ReflectanceField
from stages.usd.config import Config
from stages.usd.layout import LIGHT
from stages.usd.texture_names import check_apart, keep_pattern
from stages.usd.write import component
from stages.usd.write.cage import TemplateMesh, template_mesh, with_rest
from stages.usd.write.dense import coarser
from stages.usd.write.field_files import write_field
from stages.usd.write.gltf import write_glb
from stages.usd.write.lookdev import lookdev_layer
from stages.usd.write.maps import Maps, write_maps
from stages.usd.write.mesh import UvSurface, half_gap, read_mesh, tile_count, uv_fault, with_uvs_from, without_overlap
from stages.usd.write.moving_light import write_domes
from stages.usd.write.obj import write_obj
from stages.usd.write.package import bounded_png, write_package
from stages.usd.write.shading import Look
from stages.usd.write.tile_materials import names_on, tile_materials
from stages.usd.write.variants import HIGH_FILE, SCAN, SCAN_MATERIAL

NEAR_HIGH = 4  # candidate triangles for each triangle of the dense mesh, which is finer than the textured mesh
BLENDER = "open_in_blender.py"  # a script for the user, copied as it lies beside this module
SCATTER = "scatter_in_blender.py"  # likewise, of an asset with look=subsurface
THUMBNAIL = "./thumbnails/default.png"  # rendered by the stage after the export


@dataclass(frozen=True, slots=True)
class Export:
    """The written files, notes on parts that were left out, and for the report: figures, and metadata from the user."""

    written: list[Path]
    notes: list[str]
    figures: dict[str, float]
    stated: dict[str, str]


def export(
    surface: Located[Surface],
    uv: Located[UvMesh],
    bake: Located[TextureSet],
    face: Located[FittedFace],
    poses: Located[CameraSet],
    capture: Located[Capture],
    template: Located[RegisteredHead],
    reflectance: Located[ReflectanceField],
    config: Config,
    folder: Path,
    check: Callable[[], None],
) -> Export:
    """Write all files except the thumbnail, which is rendered from them."""
    name = config.name
    mesh = read_mesh(uv.path(uv.artifact.mesh), paired=uv.artifact.quads > 0)
    head, notes = None, _not_written(template, uv, config)
    if uv.artifact.of_template:
        head = template_mesh(
            template, mesh, rigged=config.expressions, measured=config.measured, hair_faces=uv.artifact.hair_faces
        )
    proxy, left_out = _proxy(uv, mesh) if config.proxy else (None, [])
    notes += left_out
    high, left_out = _high(surface, mesh, config.high_faces) if config.high else (None, [])
    notes += left_out
    scatters = config.subsurface and poses.artifact.metric
    if config.subsurface and not scatters:
        notes.append("look=subsurface was left out: the asset's scale is not metric; set poses.unit if you know it")
    check()
    if uv.artifact.scan is not None:
        check_apart(config.texture_name, (name, f"{name}_{SCAN}"))
    names = keep_pattern(folder, config.texture_name)
    fitted_light = face.path(face.artifact.light)
    light, moving = read_light(fitted_light), read_moving(fitted_light)
    maps = write_maps(
        bake, mesh, light, name, folder, check,
        divide=config.divide_shadows and moving is None, acescg=config.acescg,
        heights=None if head is None else head.heights, hair=uv.artifact.hair_faces > 0,
        bands=config.displacement_bands / 1000, space=config.colour_space,
        scatters=scatters,
    )  # fmt: skip
    written, look = maps.written + names, maps.look
    sidecar, field = write_field(reflectance, name, folder)
    written += sidecar
    scan = _scan(uv, bake, light, config, folder, check, scatters=scatters)
    written += [] if scan is None else scan[1].written
    who = component.Identity(name, config.asset_version, config.author, config.license, config.subject_consent)
    hints = _hints(mesh, head, proxy)
    holdout = frozenset(v.index for v in capture.artifact.views if v.holdout)
    cameras = tuple(sorted(cameras_of(poses.artifact, face.artifact).cameras, key=lambda c: c.index))
    materials = tile_materials(head or mesh)
    layers = {
        f"{name}.usd": (
            component.root_layer(
                who,
                hints,
                look,
                materials=materials,
                high=() if high is None else names_on(high, materials),
                proxy=proxy is not None,
                thumbnail=THUMBNAIL,
                beside=() if head is None else head.beside(),
                scan=() if scan is None else tile_materials(scan[0], SCAN_MATERIAL),
                field=field,
            ),
            "usda",
        ),
        "payload.usdc": (
            component.payload_layer(
                name, head or mesh, proxy, look, None if scan is None else (scan[0], scan[1].look), maps.hair
            ),
            "usdc",
        ),
        "lookdev.usda": (lookdev_layer(name, cameras, holdout, poses.artifact.roi_radius, moving), "usda"),
    }
    if high is not None:
        layers[HIGH_FILE] = (component.high_layer(high, look, materials), "usdc")
    for file, (layer, form) in layers.items():
        write_layer(layer, folder / file, form)
    around = surroundings_of(face) if moving is None else None
    dome = captured_environment(light, config.environment_width, around)
    write_exr(folder / "environment.exr", dome, half=True)
    domes = [] if moving is None else write_domes(moving, folder, config.environment_width)
    figures = maps.figures | environment_figures(light, dome)
    if around is not None:
        figures["light_irradiance_error_seen"] = round(irradiance_error(light, dome, around), 5)
    (folder / LIGHT).write_text(light_json(light, face.artifact.attenuation, moving))
    scripts = (BLENDER, *([SCATTER] if scatters else []))
    for script in scripts:
        shutil.copyfile(Path(__file__).with_name(script), folder / script)
    written += [folder / f for f in (*layers, "environment.exr", LIGHT, *scripts)] + domes
    check()
    light_mesh, light_rig, light_eyes = replace(mesh, paired=False), None, None  # viewers want triangles
    if head is not None:
        light_mesh, light_rig, light_eyes = with_rest(head), head.coarse_rig, head.coarse_eyes
    if config.usdz:
        # viewers on phones do not read MaterialX, and some use any preview surface that they find
        plain = _plain(look)
        hair = None if maps.hair is None else _plain(maps.hair)
        single = component.package_layer(who, light_mesh, plain, materials, light_rig, light_eyes, hair)
        written.append(_package(single, folder, name, plain, tile_count(mesh)))
    if config.glb:
        written.append(folder / f"{name}.glb")
        write_glb(written[-1], name, light_mesh, look, folder, who.stated(), light_rig, light_eyes, maps.hair)
    if config.obj:
        written += write_obj(folder, name, mesh, look, maps.hair)
    check()
    return Export(written, notes, figures, who.stated())


def _plain(look: Look) -> Look:
    """The look of the preview surface's metallic workflow alone."""
    return replace(
        look, specular=None, f0=None, inv_kappa=None, coefficients=(), basis=(), displacement=None, subsurface=None
    )


def write_layer(layer: Sdf.Layer, path: Path, form: str) -> None:
    """Write a layer to a file; form: "usda" or "usdc", because .usd may be either.

    Raises:
        StageError: the file can't be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    args = {"format": form} if path.suffix == ".usd" else {}
    if not layer.Export(str(path), args=args):
        raise StageError(
            "a USD layer can't be written",
            where=path.name,
            value="the USD library reported a failure",
            limit="a writable folder",
            remedy="check the disk's space and permissions",
        )


def _corners(mesh: UvSurface) -> npt.NDArray[np.float64]:
    points = mesh.vertices[np.unique(mesh.faces)]
    return np.stack([points.min(0), points.max(0)]).astype(np.float64)


def _hints(mesh: UvSurface, head: TemplateMesh | None, proxy: UvSurface | None) -> list[Gf.Vec3f]:
    """Boxes for extentsHint: of the whole; with a proxy one per purpose, in the order default, render, proxy."""
    boxes = [_corners(mesh)]
    if proxy is not None:
        beside = [] if head is None else [_corners(part) for part in (head.rest, head.hair) if part is not None]
        nothing = np.stack([np.full(3, 3.0e38), np.full(3, -3.0e38)])
        always = np.stack([np.min([b[0] for b in beside], 0), np.max([b[1] for b in beside], 0)]) if beside else nothing
        boxes = [always, *boxes, _corners(proxy)]
    return [Gf.Vec3f(*corner.tolist()) for box in boxes for corner in box]


def _scan(
    uv: Located[UvMesh],
    bake: Located[TextureSet],
    light: npt.NDArray[np.float32],
    config: Config,
    folder: Path,
    check: Callable[[], None],
    *,
    scatters: bool,
) -> tuple[UvSurface, Maps] | None:
    """The scan's mesh beside the template's, and its maps NAME_scan_*; None if there is none."""
    if uv.artifact.scan is None or bake.artifact.scan is None:
        return None
    mesh = read_mesh(uv.path(uv.artifact.scan.mesh), paired=uv.artifact.scan.quads > 0)
    baked, name = Located(bake.artifact.scan, bake.folder), f"{config.name}_{SCAN}"
    made = write_maps(baked, mesh, light, name, folder, check, divide=config.divide_shadows, acescg=config.acescg,
                      space=config.colour_space, scatters=scatters)  # fmt: skip
    return mesh, made


def _not_written(template: Located[RegisteredHead], uv: Located[UvMesh], config: Config) -> list[str]:
    """A note if measured expressions have no place in this asset."""
    if not config.measured or (uv.artifact.of_template and template.artifact.rig is not None and config.expressions):
        return []
    return ["the measured expressions were left out: the mesh has no expressions of the template"]


def _proxy(uv: Located[UvMesh], mesh: UvSurface) -> tuple[UvSurface | None, list[str]]:
    """The proxy with texture coordinates from the full mesh, or a note why it is left out."""
    if uv.artifact.proxy is None:
        return None, []
    proxy = without_overlap(with_uvs_from(read_mesh(uv.path(uv.artifact.proxy), with_uvs=False), mesh))
    fault = uv_fault(proxy, mesh)
    return (None, [f"the proxy mesh was left out: {fault}"]) if fault else (proxy, [])


def _high(surface: Located[Surface], mesh: UvSurface, most: int) -> tuple[UvSurface | None, list[str]]:
    """The dense mesh, of about `most` triangles at most, with texture coordinates from the textured mesh. At seams its
    corners reach into the padding."""
    dense = coarser(read_mesh(surface.path(surface.artifact.mesh), with_uvs=False), most)
    high = with_uvs_from(dense, mesh, NEAR_HIGH, half_gap(mesh))
    fault = uv_fault(high, mesh)
    return (None, [f"the dense mesh was left out: {fault}"]) if fault else (high, [])


# ------------------------------------------------------------------ package
def _package(content: Sdf.Layer, folder: Path, name: str, look: Look, count: int) -> Path:
    """Write NAME.usdz: one binary layer and the PNG textures that it reads, of `count` tiles."""
    with tempfile.TemporaryDirectory() as scratch:
        layer = Path(scratch) / f"{name}.usdc"
        write_layer(content, layer, "usdc")
        members = [(layer.name, layer.read_bytes())]
    for one in (look.on_tile(t) for t in range(count)):
        for file in (one.albedo, one.roughness, one.normal):
            if file:
                members.append((file.removeprefix("./"), bounded_png(folder / file)))
    path = folder / f"{name}.usdz"
    write_package(path, members)
    return path
