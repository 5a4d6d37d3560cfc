"""Where a file of the asset lies: what an artist imports in textures/, everything else in internal/.

internal/ has what the asset was made from and says about itself: the fitted lobe in all its forms, the light's
coefficients, and maps of how well each place was seen. The material's variant `look=neuface_basis` and `neuface render`
read from there; nobody has to open it.
"""

from __future__ import annotations

import re
from pathlib import Path

from stages.usd.texture_names import DEFAULT, pattern_of, texture_name

TEXTURES, INTERNAL = "textures", "internal"
FIELD = "reflectance_field"  # of a light stage: measured maps for a shader of its own
LIGHT = f"{INTERNAL}/light.json"
OLD_LIGHT = "light.json"  # where it was in assets of older versions
# Maps of standard shaders, by their name without the asset's.
FOR_ARTISTS = frozenset({
    "albedo", "albedo_acescg", "normal", "roughness", "f0", "specular_color", "ambient_occlusion", "displacement",
    "cage_displacement", "cage_displacement_low", "cage_displacement_high", "curvature", "cavity", "thickness",
    "measured", "subsurface",
})  # fmt: skip
READ = re.compile(r"_(basis_rgb\d+|coefficients_rgb\d+|inv_kappa|neuface_albedo)\.(\d{4}\.)?(exr|png)$")


def folder_of(which: str) -> str:
    """The folder of a map, named without the asset's name: "albedo", "basis_rgb0"."""
    return TEXTURES if which in FOR_ARTISTS else INTERNAL


def map_file(asset: Path, name: str, which: str, form: str) -> Path:
    """The file of a map. name: of the asset; form: "exr", "1001.png", ... Names: texture_names.py."""
    udim, _, kind = form.rpartition(".")
    pattern = pattern_of(asset) if folder_of(which) == TEXTURES else DEFAULT
    return asset / folder_of(which) / f"{texture_name(pattern, name, which, udim)}.{kind}"


def existing(asset: Path, name: str, which: str, form: str) -> Path:
    """The same; of an asset of an older version, which had all maps in textures/, its file there."""
    path = map_file(asset, name, which, form)
    old = asset / TEXTURES / f"{name}_{which}.{form}"
    return old if not path.is_file() and old.is_file() else path


def light_file(asset: Path) -> Path:
    """The coefficients of the asset's light; of an older version, where it had them."""
    return asset / OLD_LIGHT if not (asset / LIGHT).is_file() and (asset / OLD_LIGHT).is_file() else asset / LIGHT


def is_read_by_the_asset(path: str) -> bool:
    """Whether a layer of the asset reads a file of internal/, named by its path below the asset's folder."""
    return READ.search(path) is not None
