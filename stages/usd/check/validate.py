"""Checks an asset with every validator of the USD library, and with checks of our own.

The library does not check extents, face indices, primvar counts, dangling shader connections, absolute paths, kind,
decoding of images, colour spaces, MaterialX networks, and variants that are not selected; these are checked here. Works
on .usd, .usda, .usdc and .usdz files alone, without the pipeline's manifests.
"""

from __future__ import annotations

import os
import re
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from pxr import Ar, Sdf, Usd, UsdGeom, UsdSkel, UsdUtils, UsdValidation

from pipeline.errors import StageError
from stages.usd.check import tile_checks
from stages.usd.check.findings import Finding
from stages.usd.check.geometry_checks import mesh_findings, skeleton_findings
from stages.usd.check.material_checks import colour_findings, material_findings, materialx_findings, materialx_surfaces

ABSOLUTE = re.compile(r"^(/|[A-Za-z]:[\\/]|file:|\\\\|https?:)")
IMAGES = (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tif", ".tiff")
TILE_NAME = "<UDIM>"
MISSING_ID = "MissingShaderIdInRegistry"


def validate(path: Path) -> list[Finding]:
    """Every finding, errors first. StageError if the file is missing or is not a USD file."""
    stage = _open(path)
    out: list[Finding] = []
    for check in CHECKS:
        out += check(stage, path)
    unique = dict.fromkeys(out)  # the library's validators overlap
    return sorted(unique, key=lambda f: ("error", "warning", "info").index(f.level))


def checks_run() -> int:
    """Number of checks that `validate` makes: the library's validators and our own."""
    return len(_validators()) + len(CHECKS) - 1


def found_in(path: Path) -> list[Finding]:
    """As `validate`, but a file that can't be opened is reported as a finding."""
    try:
        return validate(path)
    except StageError as e:
        return [Finding("error", "open", f"{e.what}: {e.value}")]


def _open(path: Path) -> Usd.Stage:
    from pxr import Tf

    value = f"{path.stat().st_size} bytes" if path.is_file() else "no such file"
    if path.is_file():
        try:
            return Usd.Stage.Open(str(path), Usd.Stage.LoadAll)
        except (Tf.ErrorException, RuntimeError) as e:
            value = str(e).strip().splitlines()[-1]
    raise StageError(
        "the asset can't be opened",
        where=path,
        value=value,
        limit="a .usd, .usda, .usdc or .usdz file",
        remedy="check the path; run the usd stage again",
    )


# ------------------------------------------------------------------ the library's validators
def _validators() -> list[object]:
    found: list[object] = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return found


def library(stage: Usd.Stage, path: Path) -> list[Finding]:
    """Findings of UsdValidation. One is lowered to info: MaterialX shader ids, which builds without its node
    definitions do not know."""
    out = []
    with _without_tile_warnings():
        errors = UsdValidation.ValidationContext(_validators()).Validate(stage)
    for e in errors:
        kind = str(e.GetType()).rsplit(".", 1)[-1].lower()
        message, name = " ".join(e.GetMessage().split()), e.GetIdentifier()
        known = MISSING_ID in name and "'ND_" in message
        level = "info" if known or kind == "info" else "warning" if kind.startswith("warn") else "error"
        where = ", ".join(str(s.GetPrim().GetPath()) for s in e.GetSites() if s.IsPrim())
        out.append(Finding(level, name, message, where))  # type: ignore[arg-type]
    return out


@contextmanager
def _without_tile_warnings() -> Iterator[None]:
    """Keep the library from printing that it can't find "NAME.<UDIM>.png": it resolves tiles in UsdUVTexture alone, not
    in MaterialX. That each tile is there is checked by `textures`. What else it has to say is printed afterwards."""
    from pxr import Tf

    held = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        said = [d.commentary for d in held.TakeUncoalescedDiagnostics()]
        del held
        for text in said:
            if TILE_NAME not in text:
                Tf.Warn(text)


# ------------------------------------------------------------------ layers
def metadata(stage: Usd.Stage, path: Path) -> list[Finding]:
    """Default prim, kind and asset info; units and axis on every layer, because each may be opened by itself."""
    out = []
    prim = stage.GetDefaultPrim()
    if not prim:
        out.append(Finding("error", "defaultPrim", "not set, or no such prim", path.name))
    else:
        model, where = Usd.ModelAPI(prim), str(prim.GetPath())
        if model.GetKind() != "component":
            out.append(Finding("error", "kind", f"'{model.GetKind()}' where component is expected", where))
        if not model.GetAssetName():
            out.append(Finding("warning", "assetInfo", "no name", where))
        stray = [str(p.GetPath()) for p in stage.GetPseudoRoot().GetChildren() if p != prim and not p.IsAbstract()]
        if stray:
            out.append(
                Finding("warning", "defaultPrim", f"root prims that a reference does not include: {stray}", where)
            )
    for layer in stage.GetUsedLayers():
        if layer.anonymous:
            continue
        name = Path(layer.realPath or layer.identifier).name
        missing = [k for k in ("metersPerUnit", "upAxis") if not layer.pseudoRoot.HasInfo(k)]
        out += [Finding("error", k, "not authored in this layer", name) for k in missing]
        if "upAxis" not in missing and layer.pseudoRoot.GetInfo("upAxis") != "Y":
            out.append(Finding("error", "upAxis", f"{layer.pseudoRoot.GetInfo('upAxis')} where Y is expected", name))
        if "metersPerUnit" not in missing and layer.pseudoRoot.GetInfo("metersPerUnit") != 1:
            value = layer.pseudoRoot.GetInfo("metersPerUnit")
            out.append(Finding("error", "metersPerUnit", f"{value} where 1 is expected", name))
    return out


def paths(stage: Usd.Stage, path: Path) -> list[Finding]:
    """Every path must be relative and inside the asset's folder, and every file must exist."""
    out, missing = list[Finding](), list[Finding]()
    todo, known = [Sdf.Layer.FindOrOpen(str(path))], {str(path.resolve())}
    while todo:
        layer = todo.pop(0)
        name = Path(layer.realPath or layer.identifier).name
        for p in _asset_paths(layer):
            if ABSOLUTE.match(p):
                out.append(Finding("error", "absolute_path", p, name))
            elif os.path.normpath(p).startswith(".."):
                out.append(Finding("error", "path_outside", f"{p} is outside the asset's folder", name))
            if tile_checks.is_tiled(p):  # `textures` checks them
                continue
            there = layer.ComputeAbsolutePath(p)
            if not Ar.GetResolver().Resolve(there):
                missing.append(Finding("error", "missing_file", "does not resolve", _shown(there, path)))
            elif Sdf.FileFormat.FindByExtension(there) and there not in known:
                known.add(there)
                todo.append(Sdf.Layer.FindOrOpen(there))
    return missing + out


def _asset_paths(layer: Sdf.Layer) -> list[str]:
    """The paths of other files that a layer names, in its order."""
    copy, seen = Sdf.Layer.CreateAnonymous(), list[str]()
    copy.TransferContent(layer)

    def see(p: str) -> str:
        seen.append(p)
        return p

    UsdUtils.ModifyAssetPaths(copy, see)
    return list(dict.fromkeys(seen))


def _shown(text: str, path: Path) -> str:
    """A path relative to the asset's folder."""
    return text.removeprefix(f"{path.resolve().parent}/").removeprefix(f"{path.parent}/")


# ------------------------------------------------------------------ geometry
def meshes(stage: Usd.Stage, path: Path) -> list[Finding]:
    """Topology, extent, normals and primvars of every mesh, and the extent of what moves them."""
    found = [UsdGeom.Mesh(p) for p in stage.Traverse(Usd.TraverseInstanceProxies()) if p.IsA(UsdGeom.Mesh)]
    if not found:
        return [Finding("error", "mesh", "the asset has no mesh", path.name)]
    roots = [UsdSkel.Root(p) for p in stage.Traverse() if p.IsA(UsdSkel.Root)]
    return [f for m in found for f in mesh_findings(m)] + [f for r in roots for f in skeleton_findings(r)]


# ------------------------------------------------------------------ materials
def materials(stage: Usd.Stage, path: Path) -> list[Finding]:
    """Bindings, connections, colour spaces and MaterialX networks."""
    return [*material_findings(stage), *colour_findings(stage), *materialx_findings(stage)]


def variants(stage: Usd.Stage, path: Path) -> list[Finding]:
    """The same checks in every other variant of the default prim; only new findings. The stage is not changed."""
    prim, out = stage.GetDefaultPrim(), []
    known = materialx_surfaces(stage)
    for name in prim.GetVariantSets().GetNames() if prim else ():
        selected = prim.GetVariantSet(name)
        chosen = selected.GetVariantSelection()
        for variant in selected.GetVariantNames():
            if variant == chosen:
                continue
            with Usd.EditContext(stage, stage.GetSessionLayer()):
                selected.SetVariantSelection(variant)
            found = [*material_findings(stage), *colour_findings(stage), *materialx_findings(stage, known)]
            if not any(p.IsA(UsdGeom.Mesh) for p in stage.Traverse()):
                found.append(Finding("error", "mesh", "the variant has no mesh", path.name))
            known |= materialx_surfaces(stage)
            out += [replace(f, message=f"{f.message} [{name}={variant}]") for f in found if f.level != "info"]
            with Usd.EditContext(stage, stage.GetSessionLayer()):
                selected.ClearVariantSelection()
    return out


def textures(stage: Usd.Stage, path: Path) -> list[Finding]:
    """Every image must resolve, decode and contain no NaN; of an image in tiles, every tile that the meshes need."""
    out: list[Finding] = []
    done: set[str] = set()
    wanted = tile_checks.needed(stage)
    sizes: dict[str, set[tuple[int, ...]]] = {}
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        for attribute in prim.GetAttributes():
            value = attribute.Get() if attribute.GetTypeName() == Sdf.ValueTypeNames.Asset else None
            if value is None or not value.path.lower().endswith(IMAGES):
                continue
            where = str(attribute.GetPath())
            if tile_checks.is_tiled(value.path):
                if value.path not in done:
                    done.add(value.path)
                    files = tile_checks.tile_files(value.path, stage, attribute)
                    out += _tiles(value.path, files, sizes, where)
                    out += tile_checks.missing(value.path, files, wanted, where)
            elif not value.resolvedPath:
                out.append(Finding("error", "missing_texture", f"{value.path} does not resolve", where))
            elif value.resolvedPath not in done:
                done.add(value.resolvedPath)
                fault = _image_fault(value.resolvedPath)
                if fault:
                    out.append(Finding("error", "unreadable_texture", f"{value.path}: {fault}", where))
    return out + tile_checks.of_other_size(sizes, path.name)


def _tiles(path: str, files: dict[str, str], sizes: dict[str, set[tuple[int, ...]]], where: str) -> list[Finding]:
    """Findings on files of tiles that do not decode. Changes sizes: those found, by the tile's number."""
    out = []
    for number, file in sorted(files.items()):
        seen: list[tuple[int, ...]] = []
        fault = _image_fault(file, seen)
        sizes.setdefault(number, set()).update(seen)
        if fault:
            named = tile_checks.named(path, number)
            out.append(Finding("error", "unreadable_texture", f"{named}: {fault}", where))
    return out


def _image_fault(resolved: str, sizes: list[tuple[int, ...]] | None = None) -> str:
    """The fault of an image, or "". Its size is added to `sizes`."""
    import numpy as np

    from pipeline.images import MAX_BYTES, read_encoded, read_exr

    member = re.fullmatch(r"(.*\.usdz)\[(.*)\]", resolved)
    try:
        if member:
            with zipfile.ZipFile(member[1]) as z, tempfile.TemporaryDirectory() as scratch:
                if z.getinfo(member[2]).file_size > MAX_BYTES:  # a foreign package may contain a decompression bomb
                    return f"is larger than {MAX_BYTES / 1e9:.0f} GB"
                copy = Path(scratch) / Path(member[2]).name
                copy.write_bytes(z.read(member[2]))
                return _image_fault(str(copy), sizes)
        path = Path(resolved)
        image = read_exr(path)[0] if path.suffix.lower() == ".exr" else read_encoded(path)
    except StageError as e:
        return str(e.value)
    except (OSError, KeyError, RuntimeError, ValueError, zipfile.BadZipFile) as e:  # OpenEXR raises RuntimeError
        return f"can't be decoded: {e}"
    if sizes is not None:
        sizes.append(image.shape[1::-1])
    return "" if np.isfinite(image).all() else "contains values that are not finite"


# ------------------------------------------------------------------ package
def package(stage: Usd.Stage, path: Path) -> list[Finding]:
    """A .usdz: layer first, no compression, data at multiples of 64 bytes, no light (AR viewers reject lights)."""
    if path.suffix.lower() != ".usdz":
        return []
    out = []
    with zipfile.ZipFile(path) as z, path.open("rb") as f:
        members = z.infolist()
        if not members[0].filename.lower().endswith((".usd", ".usda", ".usdc")):
            out.append(Finding("error", "usdz", "the first file is not a USD layer", members[0].filename))
        for m in members:
            f.seek(m.header_offset + 26)
            name, extra = struct.unpack("<HH", f.read(4))
            if (m.header_offset + 30 + name + extra) % 64 or m.compress_type:
                out.append(Finding("error", "usdz", "compressed, or not at a multiple of 64 bytes", m.filename))
        broken = z.testzip()
        if broken:
            out.append(Finding("error", "usdz", "damaged", broken))
    lights = [p for p in stage.Traverse() if "Light" in p.GetTypeName()]
    return out + [Finding("error", "usdz", "a light in a preview package", str(p.GetPath())) for p in lights]


CHECKS: tuple[Callable[[Usd.Stage, Path], list[Finding]], ...] = (
    library,
    metadata,
    paths,
    meshes,
    materials,
    textures,
    variants,
    package,
)
