"""Skin that scatters light below its surface: the look `subsurface`, its map, and what it takes for granted.

The photos do not tell how far light travels in this skin. So the look has a person's measured values, and its colour is
the same base colour as that of the opaque look. Only its blur is new: it softens the edges of shadows, pores and
freckles, most in red.

    radius * scale_c = 1 / (s_c + a_c)

Symbols: s reduced scattering, a absorption, 1/m, per colour c; the left side is OpenPBR's mean free path (1.1.1,
Subsurface), in units of the scene, which are metres. Values: Jensen et al., A Practical Model for Subsurface Light
Transport, 2001, figure 5, skin1. They are lengths, so that the look exists only in assets of metric scale.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline import tiles
from pipeline.artifacts import Located, TextureSet
from pipeline.faces.labels import EYES, HAIR
from pipeline.images import read_exr, write_exr
from stages.usd.layout import map_file

F32 = npt.NDArray[np.float32]

SCATTERING = (740.0, 880.0, 1010.0)
ABSORPTION = (32.0, 170.0, 480.0)
MAP = "subsurface"
FEATHER = 2.0  # texels: standard deviation of the map's soft border


def mean_free_path() -> tuple[float, float, float]:
    """1 / (s + a), metres, for red, green and blue."""
    r, g, b = (1 / (s + a) for s, a in zip(SCATTERING, ABSORPTION, strict=True))
    return r, g, b


def radius_and_scale() -> tuple[float, tuple[float, float, float]]:
    """OpenPBR's subsurface_radius (m), that of red, and subsurface_radius_scale, at most 1."""
    path = mean_free_path()
    r, g, b = (round(p / max(path), 4) for p in path)
    return round(max(path), 6), (r, g, b)


def write_weights(bake: Located[TextureSet], name: str, asset: Path) -> list[Path]:
    """NAME_subsurface.exr: 1 where skin scatters, 0 in hair and eyes, by the map of regions; 1 everywhere without
    one."""
    count, written = bake.artifact.tiles, []
    for tile in range(count):
        form, side = tiles.form("exr", tile, count), bake.artifact.side(tile)
        region = np.zeros((side, side), np.float32)
        if "region" in bake.artifact.maps:
            region = read_exr(bake.path(bake.artifact.maps["region"].files[form]))[0][..., 0]
        written.append(map_file(asset, name, MAP, form))
        write_exr(written[-1], weights(region)[..., None], half=True, primaries=None)
    return written


def weights(region: F32) -> F32:
    """(H, W) in [0, 1] of a map of region codes (H, W)."""
    skin = (~np.isin(np.rint(region), (EYES, HAIR))).astype(np.float32)
    blurred = cv2.GaussianBlur(skin, (0, 0), FEATHER, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred.clip(0, 1), np.float32)
