"""The asset's textures: the baked maps, and further maps for standard shaders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from pipeline import raster, tiles
from pipeline.artifacts import Located, TextureSet
from pipeline.colour import ACESCG, acescg_from_linear
from pipeline.errors import StageError
from pipeline.images import read_alpha, read_exr, stepped, write_exr, write_png, write_png_from_linear
from pipeline.lighting.dome import environment
from pipeline.lighting.median_cut import lamps
from pipeline.lighting.transport import BRIGHTEST_ALBEDO, Transport, occlusion
from pipeline.map_lookup import bilinear
from pipeline.maths import microfacet, sh
from pipeline.meshes import Charts, Mesh
from pipeline.nearest import filled
from pipeline.smoothing import Smoother
from pipeline.store import link_or_copy
from stages.usd.colour_spaces import ACESCG as SPACE_OF_ACES
from stages.usd.colour_spaces import FILES, SRGB
from stages.usd.layout import INTERNAL, TEXTURES, map_file
from stages.usd.render.exported import CAGE_HEIGHT, numbered
from stages.usd.write.ggx_conversion import GROUP, LobeFit, basis_table, fit_figures, in_groups, lobe_fit
from stages.usd.write.mesh import UvSurface, on_tile
from stages.usd.write.shading import Look, ior_from_f0
from stages.usd.write.subsurface import MAP as SUBSURFACE
from stages.usd.write.subsurface import write_weights

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NEEDED = ("albedo", "specular_coefficients", "inv_kappa", "basis_lut")
RAYS = 4_000_000  # about the number of rays for the lamps' visibility
LAMPS = (96, 384)
LIGHT_WIDTH = 128  # columns: an order of 10 has no finer detail
HEIGHT_STEP = 2.0**-23  # metres, of a height above the cage: a tenth of a micrometre
OCCLUSION_SIZE = 1024  # texels: it is computed at the vertices


@dataclass(frozen=True, slots=True)
class Maps:
    """The written files, those that the material reads, and figures for the report. hair: the look of hair, if the last
    tile is hair's."""

    written: list[Path]
    look: Look
    figures: dict[str, float]
    hair: Look | None = None


def write_maps(
    bake: Located[TextureSet],
    mesh: UvSurface,
    light: F32,
    name: str,
    asset: Path,
    check: Callable[[], None],
    *,
    divide: bool,
    acescg: bool = False,
    heights: F32 | None = None,
    hair: bool = False,
    bands: float = 0.005,
    space: str = SRGB,
    scatters: bool = False,
) -> Maps:
    """Write textures/ and internal/. `divide`: divide shadows and interreflections out of the albedo. `acescg`: also
    write that albedo in ACEScg. heights (V,): displacement at the vertices, if there is a map of it; bands: wavelength
    (m) between its two bands. hair: the last tile is hair's. space: of the base colour in MaterialX networks. scatters:
    write where skin scatters light below its surface."""
    for folder in (TEXTURES, INTERNAL):
        (asset / folder).mkdir(parents=True, exist_ok=True)
    written = copy_maps(bake, name, asset)
    if heights is not None:
        written += write_heights(bake, mesh, heights, name, asset, bands)
    written += write_weights(bake, name, asset) if scatters else []
    figures: dict[str, float] = {}
    if divide and not shadows_fitted(bake) and not bake.artifact.standard_fitted:
        shown, found = divided_albedo(bake, mesh, light, name, asset, check)
        written += shown
        figures |= found
    basis = numbered(bake.path(bake.artifact.maps["basis_lut"].files["exr"])).mean(0)
    for i, picture in enumerate(in_groups(basis_table(basis))):
        written.append(map_file(asset, name, f"basis_rgb{i}", "exr"))
        write_exr(written[-1], picture, primaries=None)
    fits = []
    for tile in range(bake.artifact.tiles):
        check()
        shown, fit = _derived(bake, tile, name, asset, basis, acescg=acescg or space == SPACE_OF_ACES)
        written += shown
        fits += [] if fit is None else [fit]
    check()
    every, own = range(bake.artifact.tiles), None
    if hair:
        every = every[:-1]
        own = replace(look_of(bake, name, asset, range(bake.artifact.tiles)[-1:], space), displacement=None)
    return Maps(written, look_of(bake, name, asset, every, space), figures | fit_figures(fits), own)


def _derived(
    bake: Located[TextureSet], tile: int, name: str, asset: Path, basis: F32, *, acescg: bool
) -> tuple[list[Path], LobeFit | None]:
    """One tile's maps that are computed from others, and the error of GGX there."""
    exr, png = (tiles.form(k, tile, bake.artifact.tiles) for k in ("exr", "png"))
    written = []
    if acescg:
        written.append(map_file(asset, name, "albedo_acescg", exr))
        albedo = read_exr(map_file(asset, name, "albedo", exr))[0][..., :3]
        write_exr(written[-1], acescg_from_linear(albedo), half=True, primaries=ACESCG)
    coefficients = numbered(bake.path(bake.artifact.maps["specular_coefficients"].files[exr]))
    for i, picture in enumerate(in_groups(coefficients)):
        written.append(map_file(asset, name, f"coefficients_rgb{i}", exr))
        if coefficients.shape[2] == GROUP:  # the bake's file has them as red, green and blue already
            link_or_copy(bake.path(bake.artifact.maps["specular_coefficients"].files[exr]), written[-1])
        else:
            write_exr(written[-1], picture, primaries=None)
    if "f0" not in bake.artifact.maps:
        return written, None
    f0 = _map(bake, "f0", tile)[..., 0]
    written.append(map_file(asset, name, "specular_color", png))
    write_png_from_linear(written[-1], np.repeat(f0[..., None].clip(0, 1), 3, -1))
    fit = lobe_fit(coefficients, _map(bake, "inv_kappa", tile)[..., 0], f0, basis, covered_texels(bake, tile))
    written.append(map_file(asset, name, "lobe_fit", png))
    # red: residual of the GGX lobe, 1 = 100 %; green: 1 where the light does not determine kappa; blue: 0
    write_png(written[-1], np.stack([fit.residual, fit.unresolved, np.zeros_like(fit.residual)], -1))
    return written, fit


def shadows_fitted(bake: Located[TextureSet]) -> bool:
    """Whether the fit modelled shadows and interreflections, so that its albedo does not contain them."""
    ratio = bake.artifact.maps.get("irradiance_ratio")
    return ratio is not None and not (ratio.minimum == ratio.maximum == 1)


def copy_maps(bake: Located[TextureSet], name: str, asset: Path) -> list[Path]:
    """Every file of every map as NAME_map.format: under a second name in the same store, which takes no room."""
    count = bake.artifact.tiles
    wanted = {(m, tiles.form("exr", t, count)) for m in NEEDED[:-1] for t in range(count)} | {(NEEDED[-1], "exr")}
    wanted |= {("albedo", tiles.form("png", t, count)) for t in range(count)}
    if wanted - {(m, k) for m, texture in bake.artifact.maps.items() for k in texture.files}:
        raise StageError(
            "maps are missing",
            where="bake",
            value=", ".join(sorted(bake.artifact.maps)) or "no maps",
            limit=f"{', '.join(NEEDED)} as exr, albedo also as png",
            remedy="run the bake stage again",
        )
    written = []
    for which, texture in sorted(bake.artifact.maps.items()):
        if which == "neuface_albedo" and not bake.artifact.standard_fitted:
            continue  # the same as `albedo`
        for form, ref in sorted(texture.files.items()):
            target = map_file(asset, name, which, form)
            link_or_copy(bake.path(ref), target)
            written.append(target)
    return written


def divided_albedo(
    bake: Located[TextureSet], mesh: UvSurface, light: F32, name: str, asset: Path, check: Callable[[], None]
) -> tuple[list[Path], dict[str, float]]:
    """Divide shadows and interreflections out of the albedo files, and write `occlusion`: albedo * occlusion = baked.

    The closed form of the fit has neither, so that those of the photos were fitted into the albedo. A path tracer
    computes both: with the albedo as fitted they would appear twice.
    """
    count = bake.artifact.tiles
    share = vertex_occlusion(mesh, light, vertex_albedo(bake, mesh), check)
    written, shown = [], []
    for tile in range(count):
        check()
        fitted = _map(bake, "albedo", tile)[..., :3]
        image = vertex_image(on_tile(mesh, tile, count), share, min(len(fitted), OCCLUSION_SIZE))
        if len(image) != len(fitted):
            import cv2

            image = np.asarray(cv2.resize(image, fitted.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float32)
        albedo = np.minimum(fitted / image, np.maximum(fitted, BRIGHTEST_ALBEDO)).astype(np.float32)
        image = np.where(albedo > 0, fitted / np.maximum(albedo, 1e-9), image).astype(np.float32)
        exr, png = (tiles.form(k, tile, count) for k in ("exr", "png"))
        for form in (exr, png):  # names of the bake's files, which stay as they are
            map_file(asset, name, "albedo", form).unlink()
        write_exr(map_file(asset, name, "albedo", exr), albedo, half=True)
        write_png_from_linear(map_file(asset, name, "albedo", png), albedo)
        written.append(map_file(asset, name, "occlusion", exr))
        write_exr(written[-1], image, half=True)
        shown.append(image[covered_texels(bake, tile)][::count])  # in total as many as in one tile
    found = np.concatenate(shown)
    figures = {
        "occlusion_mean": round(float(found.mean(dtype=np.float64)), 5),
        "occlusion_p05": round(float(np.percentile(found, 5)), 5),
    }
    return written, figures


def vertex_albedo(bake: Located[TextureSet], mesh: UvSurface) -> F64:
    """(V, 3) the baked albedo at the vertices; at a seam, from one of its sides."""
    uv, count = np.zeros((len(mesh.vertices), 2), np.float32), bake.artifact.tiles
    uv[mesh.faces] = mesh.uvs[mesh.uv_faces]
    out = np.zeros((len(uv), 3))
    for tile in range(count):
        own = np.floor(uv[:, 0]).clip(0, count - 1) == tile
        out[own] = bilinear(_map(bake, "albedo", tile)[..., :3], uv[own] - np.array([tile, 0], np.float32))
    return out


def vertex_occlusion(mesh: UvSurface, light: F32, albedo: F64, check: Callable[[], None]) -> F64:
    """(V, 3) see transport.occlusion; albedo (V, 3)."""
    count = int(np.clip(RAYS // max(len(mesh.vertices), 1), *LAMPS))
    transport = Transport(mesh.vertices, mesh.normals, mesh.faces)
    normals = torch.from_numpy(transport.normals.astype(np.float32))
    unblocked = sh.irradiance(torch.from_numpy(np.asarray(light, np.float32)), normals).numpy().astype(np.float64)
    lit = lamps(environment(light, LIGHT_WIDTH), count)
    return occlusion(transport, lit, unblocked, albedo, check)


def write_heights(
    bake: Located[TextureSet], mesh: UvSurface, heights: F32, name: str, asset: Path, wavelength: float
) -> list[Path]:
    """NAME_cage_displacement.exr: metres along the cage's limit normal. heights (V,) at the vertices of the textured
    mesh. (NAME_displacement.exr is the bake's: from the textured mesh to the zero set.) The same in two bands beside
    it, as _low and _high: all are multiples of HEIGHT_STEP, so that the bands' sum is the whole to the last bit."""
    count, written = bake.artifact.tiles, []
    low = low_band(mesh, heights.astype(np.float64), wavelength)
    values = np.stack([heights.astype(np.float64), low], 1)
    for tile in range(count):
        whole, smooth = np.moveaxis(vertex_image(on_tile(mesh, tile, count), values, bake.artifact.side(tile)), -1, 0)
        whole, smooth = stepped(whole, HEIGHT_STEP), stepped(smooth, HEIGHT_STEP)
        for ending, image in (("", whole), ("_low", smooth), ("_high", whole - smooth)):
            written.append(map_file(asset, name, CAGE_HEIGHT + ending, tiles.form("exr", tile, count)))
            write_exr(written[-1], image[..., None], step=HEIGHT_STEP, primaries=None, units="m")
    return written


def low_band(mesh: UvSurface, heights: F64, wavelength: float) -> F64:
    """(V,) heights (V,) without what is finer than a wavelength (m), of which the low band keeps half.

    A wave of length L keeps (1 + (pi w / L)^2)^-2 (pipeline/smoothing.py), which is 1/2 at L = pi w / (2^.5 - 1)^.5.
    """
    width = wavelength * float(np.sqrt(np.sqrt(2) - 1)) / np.pi
    smooth = Smoother(Mesh(mesh.vertices, mesh.normals, mesh.faces), width)
    return np.asarray(smooth(heights[:, None])[:, 0])


def vertex_image(mesh: UvSurface, values: F64, size: int) -> F32:
    """(size, size, C) texture of vertex values (V, C); texels between charts are filled from the nearest one."""
    charts = Charts(mesh.uvs, mesh.uv_faces)
    hits = raster.rasterise(raster.texel_corners(charts, size), size, 0, size)
    image = np.zeros((size * size, values.shape[1]), np.float32)
    corners = values[mesh.faces[hits.face]].astype(np.float32)
    image[hits.texel] = np.einsum("nic,ni->nc", corners, hits.weights)
    known = np.zeros(size * size, np.bool_)
    known[hits.texel] = True
    return filled(image.reshape(size, size, -1), known.reshape(size, size))


# ------------------------------------------------------------------ what the material reads
def look_of(
    bake: Located[TextureSet], name: str, asset: Path, of_tiles: Sequence[int] | None = None, space: str = SRGB
) -> Look:
    """The files for the material's networks, and the index of refraction of the mean F0 over covered texels of some
    tiles, and of each of them; None: of all."""

    count = bake.artifact.tiles

    def found(map_name: str, kind: str, of: int = count) -> str | None:
        first = map_file(asset, name, map_name, tiles.form(kind, 0, of))
        if not first.is_file():
            return None
        file = first if of == 1 else map_file(asset, name, map_name, f"{tiles.TOKEN}.{kind}")
        return f"./{file.relative_to(asset).as_posix()}"

    def counted(map_name: str, of: int) -> tuple[str, ...]:
        return tuple(f for i in range(99) if (f := found(f"{map_name}_rgb{i}", "exr", of)))

    has_f0, texels = "f0" in bake.artifact.maps, 0
    albedo, f0, own = np.zeros(3), 0.0, dict[int, float]()
    for tile in range(count) if of_tiles is None else of_tiles:
        covered = covered_texels(bake, tile)
        texels += int(covered.sum())
        shown = read_exr(map_file(asset, name, "albedo", tiles.form("exr", tile, count)))[0][..., :3]
        albedo += shown[covered].sum(0, dtype=np.float64)
        reflected = float(_map(bake, "f0", tile)[covered].sum(dtype=np.float64)) if has_f0 else 0.0
        f0, own[tile] = f0 + reflected, reflected / max(int(covered.sum()), 1)
    red, green, blue = (round(float(x), 6) for x in albedo / texels)
    usual = f0 / texels if has_f0 else microfacet.SKIN_F0
    iors = [round(ior_from_f0(own.get(tile, usual)), 5) for tile in range(count)]
    return Look(
        str(found("albedo", "png")),
        found("roughness", "png"),
        found("normal", "png"),
        round(ior_from_f0(usual), 5),
        (red, green, blue),
        specular=found("specular_color", "png"),
        f0=found("f0", "exr"),
        inv_kappa=found("inv_kappa", "exr"),
        coefficients=counted("coefficients", count),
        basis=counted("basis", 1),
        displacement=found(CAGE_HEIGHT, "exr"),
        neuface_albedo=found("neuface_albedo", "png"),
        base_color=None if space == SRGB else found(*FILES[space]),
        base_space=space,
        subsurface=found(SUBSURFACE, "exr"),
        iors=tuple(iors) if has_f0 else (),
    )


def covered_texels(bake: Located[TextureSet], tile: int = 0) -> Mask:
    """(H, W) mask of the texels that a chart touches; all texels if `coverage` was not baked."""
    size, count = bake.artifact.side(tile), bake.artifact.tiles
    files = bake.artifact.maps["coverage"].files if "coverage" in bake.artifact.maps else {}
    exr, png = (tiles.form(k, tile, count) for k in ("exr", "png"))
    found: Mask | None = None
    if exr in files:
        found = np.asarray(read_exr(bake.path(files[exr]))[0][..., 0] > 0.25)
    elif png in files:
        found = np.asarray(read_alpha(bake.path(files[png])) > 0.25)
    if found is None or found.shape != (size, size) or not found.any():
        return np.ones((size, size), np.bool_)
    return found


def _map(bake: Located[TextureSet], which: str, tile: int = 0) -> F32:
    return read_exr(bake.path(bake.artifact.maps[which].files[tiles.form("exr", tile, bake.artifact.tiles)]))[0]
