"""Maps of the 3D view that the glb does not hold, and those of the scan's own material, as addresses of pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline import tiles
from pipeline.artifacts import Located, TextureSet
from pipeline.colour import srgb_from_linear
from pipeline.images import read_encoded, read_exr
from stages.report.pictures import U8, exact_uri

MAP_SIDE = 1024  # texels of a map that only the view shows
MAPS = ("ambient_occlusion", "irradiance_ratio", "confidence", "coverage", "region")
LEAST_F0 = 0.02  # of the largest value of the scan's F0 picture
PERCENT = 99.9  # of the texels that this value covers: outliers must not use up the eight bits


def maps_shown(bake: Located[TextureSet]) -> dict[str, list[str]]:
    """Those of MAPS that there are as PNG: one address a tile."""
    return {n: map_uris(bake, n) for n in MAPS if has_png(bake, n)}


def has_png(bake: Located[TextureSet], name: str) -> bool:
    """Whether there is such a map, with a PNG for every tile."""
    count = bake.artifact.tiles
    kinds = {tiles.form("png", t, count) for t in range(count)}
    return name in bake.artifact.maps and kinds <= bake.artifact.maps[name].files.keys()


def map_uris(bake: Located[TextureSet], name: str) -> list[str]:
    """A map, one address a tile, no texel changed; every second, third, ... texel of a larger one, which keeps codes
    whole."""
    texture, count = bake.artifact.maps[name], bake.artifact.tiles
    pictures = [read_encoded(bake.path(texture.files[tiles.form("png", t, count)])) for t in range(count)]
    return [exact_uri(_bytes(thinned(p))) for p in pictures]


def scan_look(bake: Located[TextureSet]) -> dict[str, Any] | None:
    """The scan's maps, and the addresses that its material takes: albedo, roughness, normal, specular (sRGB-encoded
    F0 over `f0`, its largest value). None without a scan."""
    if bake.artifact.scan is None:
        return None
    scan = Located(bake.artifact.scan, bake.folder)
    own = {n: map_uris(scan, n) for n in ("albedo", "roughness", "normal") if has_png(scan, n)}
    return {"maps": maps_shown(scan), **own, **_specular(scan)}


def _specular(scan: Located[TextureSet]) -> dict[str, Any]:
    if "f0" not in scan.artifact.maps:
        return {}
    files, count = scan.artifact.maps["f0"].files, scan.artifact.tiles
    found = [thinned(read_exr(scan.path(files[tiles.form("exr", t, count)]))[0][..., 0]) for t in range(count)]
    top = max(LEAST_F0, *(float(np.percentile(f, PERCENT)) for f in found))
    stored = [np.repeat(srgb_from_linear((f / top).clip(0, 1))[..., None], 3, -1) for f in found]
    return {"specular": [exact_uri(np.round(255 * s).astype(np.uint8)) for s in stored], "f0": top}


def thinned(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Every n-th row and column of a picture with more than MAP_SIDE."""
    step = -(-max(image.shape[:2]) // MAP_SIDE)
    return np.asarray(image[::step, ::step])


def _bytes(image: npt.NDArray[Any]) -> U8:
    return np.asarray(image >> 8 if image.dtype == np.uint16 else image, np.uint8)
