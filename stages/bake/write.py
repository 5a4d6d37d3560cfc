"""Maps to files, one after the other, so that only one full picture is in memory.

Every map is float32 EXR; those that preview shaders and people look at are PNG too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.artifacts import FileRef, TextureMap
from pipeline.colour import REC709
from pipeline.contract import Context
from pipeline.images import write_exr, write_png, write_png_from_linear
from pipeline.maths import microfacet
from pipeline.meshes import F32
from stages.bake.build import Baked
from stages.bake.texels import Samples

FOLDER = "textures"
MM = 1000.0
LEAST_INV_KAPPA = 1e-6


@dataclass(frozen=True, slots=True)
class MapKind:
    """How a map is made from the samples (N, ...) and stored. png: bits, 0 for none; encoded: png holds v/2 + 1/2.
    colour: its three channels are colours; units: of its values, for the EXR's header."""

    values: Callable[[Samples], F32]
    png: int = 0
    encoded: bool = False
    numbered: bool = False
    space: Literal["srgb_png", "raw"] = "raw"
    colour: bool = False
    units: str = ""


KINDS: dict[str, MapKind] = {
    "albedo": MapKind(lambda s: s.albedo, png=8, space="srgb_png", colour=True),
    "specular_coefficients": MapKind(lambda s: s.rho[:, None] * s.coefficients, numbered=True),
    "specular_intensity": MapKind(lambda s: s.rho, png=8),
    "shininess": MapKind(lambda s: (1 / np.maximum(s.inv_kappa, LEAST_INV_KAPPA)).astype(np.float32)),
    "inv_kappa": MapKind(lambda s: s.inv_kappa),
    "roughness": MapKind(lambda s: microfacet.roughness_from_inv_kappa(s.inv_kappa).astype(np.float32), png=8),
    "f0": MapKind(lambda s: s.f0, png=16),  # about 0.03: 8 bits would leave 8 steps
    "normal": MapKind(lambda s: s.normal, png=8, encoded=True),
    "irradiance_ratio": MapKind(lambda s: s.irradiance_ratio, png=8, colour=True),
    "displacement": MapKind(lambda s: s.displacement * np.float32(MM), units="mm"),
}


def write_maps(baked: Baked, context: Context) -> dict[str, TextureMap]:
    """Write every map into `textures/` and describe it; figures are over covered texels."""
    maps = {}
    for name, kind in KINDS.items():
        context.check()
        values = kind.values(baked.samples)
        values = values[:, None] if values.ndim == 1 else values
        image = values[baked.nearest]
        maps[name] = _store(name, image, values, kind, context)
    covered = baked.covered()
    seen = resized(baked.confidence, baked.size)[..., None]
    flags = covered.astype(np.float32)[..., None]
    maps["confidence"] = _store("confidence", seen, seen[covered], MapKind(_none, png=8), context)
    maps["coverage"] = _store("coverage", flags, flags, MapKind(_none, png=8), context)
    flat = baked.lut.reshape(-1, baked.lut.shape[2])
    maps["basis_lut"] = _store("basis_lut", baked.lut, flat, MapKind(_none, numbered=True), context)
    return maps


def resized(image: F32, size: int) -> F32:
    """(size, size), linear between texel centres."""
    import cv2

    if len(image) == size:
        return image
    return np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR), np.float32)


def _none(samples: Samples) -> F32:
    raise NotImplementedError("this map is not made from samples")


def _store(name: str, image: F32, values: F32, kind: MapKind, context: Context) -> TextureMap:
    folder = context.workdir / FOLDER
    channels = tuple(f"c{i}" for i in range(image.shape[2])) if kind.numbered else None
    primaries = REC709 if kind.colour else None
    write_exr(folder / f"{name}.exr", image, channels, primaries=primaries, units=kind.units)
    files: dict[str, FileRef] = {"exr": context.file(f"{FOLDER}/{name}.exr")}
    if kind.png:
        path = folder / f"{name}.png"
        if kind.space == "srgb_png":
            write_png_from_linear(path, image)
        else:
            write_png(path, 0.5 * image + 0.5 if kind.encoded else image, kind.png)
        files["png"] = context.file(f"{FOLDER}/{name}.png")
    return TextureMap(
        name=name,
        channels=image.shape[2],
        files=files,
        space=kind.space,
        minimum=float(values.min()),
        mean=float(values.mean(dtype=np.float64)),
        maximum=float(values.max()),
    )
