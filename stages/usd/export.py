"""Writes every file of the asset into one folder."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
from pxr import Gf, Sdf

from pipeline.artifacts import CameraSet, Capture, FittedFace, Located, TextureSet, UvMesh
from pipeline.errors import StageError
from pipeline.images import read_exr, write_exr
from stages.usd import component
from stages.usd.light import environment, light_json, read_light
from stages.usd.lookdev import lookdev_layer
from stages.usd.mesh import UvSurface, read_mesh, uv_fault, with_uvs_from
from stages.usd.package import write_package

F32 = npt.NDArray[np.float32]
SHOWN = ("albedo", "roughness", "normal")  # the maps that the preview network reads
NEEDED = ("albedo", "specular_coefficients", "inv_kappa", "basis_lut")


class Settings(Protocol):
    """The part of the stage's config that matters here."""

    name: str
    asset_version: str
    usdz: bool
    proxy: bool
    environment_width: int


def export(
    uv: Located[UvMesh],
    bake: Located[TextureSet],
    face: Located[FittedFace],
    poses: Located[CameraSet],
    capture: Located[Capture],
    settings: Settings,
    folder: Path,
    check: Callable[[], None],
) -> tuple[list[Path], list[str]]:
    """The files written, and notes on what was left out."""
    name = settings.name
    mesh = read_mesh(uv.path(uv.artifact.mesh))
    proxy, notes = _proxy(uv, mesh) if settings.proxy else (None, [])
    check()
    written = copy_maps(bake, name, folder / "textures")
    look = look_of(bake, name)
    light = read_light(face.path(face.artifact.light))
    boxes = [_corners(mesh)] if proxy is None else [_corners(mesh), _corners(proxy)]
    hints = [Gf.Vec3f(*c.tolist()) for c in (_hints(boxes) if proxy is not None else boxes[0])]
    holdout = frozenset(v.index for v in capture.artifact.views if v.holdout)
    cameras = tuple(sorted(poses.artifact.cameras, key=lambda c: c.index))
    layers = {
        f"{name}.usd": (component.root_layer(name, settings.asset_version, hints), "usda"),
        "payload.usdc": (component.payload_layer(name, mesh, proxy, look), "usdc"),
        "lookdev.usda": (lookdev_layer(name, cameras, holdout, poses.artifact.roi_radius), "usda"),
    }
    for file, (layer, form) in layers.items():
        _write_layer(layer, folder / file, form)
    write_exr(folder / "environment.exr", environment(light, settings.environment_width))
    (folder / "light.json").write_text(light_json(light, attenuation_of(face.artifact)))
    written += [folder / f for f in (*layers, "environment.exr", "light.json")]
    check()
    if settings.usdz:
        single = component.package_layer(name, settings.asset_version, mesh, look)
        written.append(_package(single, folder, name, look))
    return written, notes


def _write_layer(layer: Sdf.Layer, path: Path, form: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    args = {"format": form} if path.suffix == ".usd" else {}
    if not layer.Export(str(path), args=args):
        raise StageError(
            "a USD layer can't be written",
            where=path.name,
            value="the USD library refused",
            limit="a writable folder",
            remedy="check the disk's space and permissions",
        )


def _corners(mesh: UvSurface) -> npt.NDArray[np.float64]:
    points = mesh.vertices[np.unique(mesh.faces)]
    return np.stack([points.min(0), points.max(0)]).astype(np.float64)


def _hints(boxes: list[npt.NDArray[np.float64]]) -> list[npt.NDArray[np.float64]]:
    """extentsHint holds a box for each purpose in the order default, render, proxy; an unused one is empty."""
    empty = np.stack([np.full(3, 3.0e38), np.full(3, -3.0e38)])
    return [row for box in (empty, *boxes) for row in box]


def _proxy(uv: Located[UvMesh], mesh: UvSurface) -> tuple[UvSurface | None, list[str]]:
    """The coarse mesh with the full mesh's texture coordinates, unless they would be misleading."""
    if uv.artifact.proxy is None:
        return None, []
    proxy = with_uvs_from(read_mesh(uv.path(uv.artifact.proxy), with_uvs=False), mesh)
    fault = uv_fault(proxy, mesh)
    return (None, [f"the proxy mesh was left out: {fault}"]) if fault else (proxy, [])


# ------------------------------------------------------------------ maps
def copy_maps(bake: Located[TextureSet], name: str, folder: Path) -> list[Path]:
    """Every file of every map as NAME_map.format."""
    missing = [m for m in NEEDED if "exr" not in getattr(bake.artifact.maps.get(m), "files", {})]
    if missing or "png" not in bake.artifact.maps["albedo"].files:
        raise StageError(
            "maps are missing",
            where="bake",
            value=", ".join(sorted(bake.artifact.maps)) or "no maps",
            limit=f"{', '.join(NEEDED)} as exr, albedo as png too",
            remedy="run the bake stage again",
        )
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for which, texture in sorted(bake.artifact.maps.items()):
        for form, ref in sorted(texture.files.items()):
            target = folder / f"{name}_{which}.{form}"
            shutil.copyfile(bake.path(ref), target)
            written.append(target)
    return written


def look_of(bake: Located[TextureSet], name: str) -> component.Look:
    """The preview network's files, and the index of refraction of the mean F0 over covered texels."""
    maps = bake.artifact.maps
    files = {m: f"./textures/{name}_{m}.png" if m in maps and "png" in maps[m].files else None for m in SHOWN}
    covered = _covered(bake)
    albedo = tuple(float(round(x, 6)) for x in _mean(bake, "albedo", covered))
    f0 = float(_mean(bake, "f0", covered)[0]) if "f0" in maps and "exr" in maps["f0"].files else 0.028
    return component.Look(
        str(files["albedo"]),
        files["roughness"],
        files["normal"],
        round(component.ior_from_f0(f0), 5),
        (albedo[0], albedo[1], albedo[2]),
    )


def _covered(bake: Located[TextureSet]) -> npt.NDArray[np.bool_] | None:
    files = bake.artifact.maps["coverage"].files if "coverage" in bake.artifact.maps else {}
    if "exr" in files:
        return np.asarray(read_exr(bake.path(files["exr"]))[0][..., 0] > 0.5)
    if "png" in files:
        from pipeline.images import read_alpha

        return np.asarray(read_alpha(bake.path(files["png"])) > 0.5)
    return None


def _mean(bake: Located[TextureSet], which: str, covered: npt.NDArray[np.bool_] | None) -> F32:
    values = read_exr(bake.path(bake.artifact.maps[which].files["exr"]))[0]
    use = covered is not None and covered.shape == values.shape[:2] and covered.any()
    return np.asarray((values[covered] if use else values.reshape(-1, values.shape[2])).mean(0), np.float32)


def attenuation_of(face: FittedFace) -> str:
    """How the fit attenuated the light's bands; the paper's exponential where its model does not say."""
    found = [v["attenuation"] for v in face.model.values() if "attenuation" in v]
    return str(found[0]) if found else "exponential"


# ------------------------------------------------------------------ package
def _package(content: Sdf.Layer, folder: Path, name: str, look: component.Look) -> Path:
    """NAME.usdz: one binary layer and the PNG textures that it reads."""
    with tempfile.TemporaryDirectory() as scratch:
        layer = Path(scratch) / f"{name}.usdc"
        _write_layer(content, layer, "usdc")
        members = [(layer.name, layer.read_bytes())]
    for file in (look.albedo, look.roughness, look.normal):
        if file:
            relative = file.removeprefix("./")
            members.append((relative, (folder / relative).read_bytes()))
    path = folder / f"{name}.usdz"
    write_package(path, members)
    return path
