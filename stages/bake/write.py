"""Writes the maps one after the other, so that only one full picture is in memory.

Every map is float32 EXR; those for preview shaders and for viewing are PNG too. Each UDIM tile has its own files, and
all tiles have the same maps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pipeline import tiles
from pipeline.artifacts import FileRef, TextureMap
from pipeline.colour import REC709
from pipeline.contract import Context
from pipeline.images import write_exr, write_png, write_png_from_linear
from pipeline.meshes import F32
from stages.bake.build import Baked, bands
from stages.bake.memmap_buffer import blank
from stages.bake.regions import Votes
from stages.bake.texels import Samples

FOLDER = "textures"
MM = 1000.0
CURVATURE = 0.001  # metres: curvatures of -500 to 500 1/m fill the PNG, flat is .5
THICK = 100.0  # mm: white in the PNG; relief.FAR
MIN_INV_KAPPA = 1e-6
UNSEEN = 0.5  # value in the map `coverage` of a covered texel that no photo shows
OPTIONAL = ("clamped", "region")  # maps that are removed if they are empty
HEIGHT_STEP = 2.0**-13  # of a displacement in mm: a tenth of a micrometre
NORMAL_STEP = 2.0**-11  # of a normal: 0.03 degrees
IN_MEMORY = 1 << 27  # values of a picture; a larger one is assembled in a file

Function = Callable[..., npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class MapKind:
    """How a map is computed from arrays (N, ...) of the samples, and how it is stored. png: bits, 0 for none; encoded:
    the png contains v/2 + 1/2; codes: values are integers, also in the png; colour: the three channels are a colour;
    units: of the values, for the EXR's header. step: the EXR has multiples of it; wide: in 32 bits, not 16. shown:
    values of the png from those of the EXR, if they are not the same."""

    sources: tuple[str, ...]
    function: Function = lambda values: values
    png: int = 0
    encoded: bool = False
    codes: bool = False
    numbered: bool = False
    space: Literal["srgb_png", "raw"] = "raw"
    colour: bool = False
    units: str = ""
    step: float = 0.0
    wide: bool = False
    shown: Function | None = None

    def values(self, samples: Samples, rows: Any = slice(None)) -> F32:
        """(N, channels) values of all samples, or of some rows."""
        found = np.asarray(self.function(*(getattr(samples, s)[rows] for s in self.sources)), np.float32)
        return found[..., None] if found.ndim == np.ndim(samples.rho[rows]) else found


KINDS: dict[str, MapKind] = {
    "albedo": MapKind(("base_color",), png=8, space="srgb_png", colour=True),
    "neuface_albedo": MapKind(("albedo",), png=8, space="srgb_png", colour=True),
    "specular_coefficients": MapKind(
        ("rho", "coefficients"), lambda rho, c: rho[..., None] * c, numbered=True
    ),  # fmt: skip
    "specular_intensity": MapKind(("rho",), png=8),
    "shininess": MapKind(("inv_kappa",), lambda s: 1 / np.maximum(s, MIN_INV_KAPPA)),
    "inv_kappa": MapKind(("inv_kappa",)),
    "roughness": MapKind(("roughness",), png=8),
    "f0": MapKind(("f0",), png=16),  # about 0.03: 8 bits would leave 8 steps
    "normal": MapKind(("normal",), png=8, encoded=True, step=NORMAL_STEP),
    "irradiance_ratio": MapKind(("irradiance_ratio",), png=8, colour=True),
    "ambient_occlusion": MapKind(("ambient",), png=8),
    "curvature": MapKind(("curvature",), png=8, units="1/m", shown=lambda h: 0.5 + CURVATURE * h),
    "cavity": MapKind(("cavity",), png=8),
    "thickness": MapKind(
        ("thickness",), lambda d: d * np.float32(MM), png=8, units="mm", shown=lambda d: d / np.float32(THICK)
    ),
    "measured": MapKind(("measured",), png=8),
    "displacement": MapKind(("displacement",), lambda d: d * np.float32(MM), units="mm", step=HEIGHT_STEP, wide=True),
    "clamped": MapKind(("clamped",), lambda c: (c > 0).astype(np.float32), png=8),
}


@dataclass(frozen=True, slots=True)
class _Place:
    """Folder of a tile's files, index of the tile, and number of tiles."""

    context: Context
    tile: int
    count: int


def write_maps(baked: Baked, context: Context, tile: int = 0, count: int = 1) -> dict[str, TextureMap]:
    """Write every map of one of `count` tiles into `textures/` and describe it. Figures are over covered texels."""
    maps, place = {}, _Place(context, tile, count)
    for name, kind in KINDS.items():
        context.check()
        if name == "clamped" and count == 1 and not baked.statistics.clamped:
            continue
        maps[name] = _from_samples(name, kind, baked, place)
    covered = baked.covered()
    plain = MapKind((), png=8)
    seen = resized(baked.confidence, baked.size)[..., None]
    maps["confidence"] = _store("confidence", seen, _range(seen[covered]), plain, place)
    flags = np.zeros((baked.size * baked.size, 1), np.float32)
    flags[baked.texel, 0] = np.where(baked.samples.unseen > 0.5, UNSEEN, 1)
    maps["coverage"] = _store("coverage", flags.reshape(*covered.shape, 1), _range(flags), plain, place)
    if baked.votes is not None or count > 1:
        maps["region"] = _region(baked, baked.votes, place)
    if tile == 0:
        lut = MapKind((), numbered=True, wide=True)
        maps["basis_lut"] = _store("basis_lut", baked.lut, _range(baked.lut), lut, _Place(context, 0, 1))
    return maps


def joined(parts: Sequence[dict[str, TextureMap]], texels: Sequence[int], context: Context) -> dict[str, TextureMap]:
    """The maps of all tiles as one set; figures are weighted by the texels of each tile. Optional maps that are empty
    in all tiles are removed."""
    if len(parts) == 1:
        return parts[0]
    out = {}
    for name in parts[0]:
        found = [p[name] for p in parts if name in p]
        if name in OPTIONAL and max(m.maximum for m in found) == 0:
            for ref in (r for m in found for r in m.files.values()):
                (context.workdir / ref.path).unlink()
            continue
        share = [1.0] * len(found) if name == "coverage" else [float(n) for n in texels[: len(found)]]
        out[name] = found[0].model_copy(
            update={
                "files": {k: ref for m in found for k, ref in m.files.items()},
                "minimum": min(m.minimum for m in found),
                "mean": sum(n * m.mean for n, m in zip(share, found, strict=True)) / sum(share),
                "maximum": max(m.maximum for m in found),
            }
        )
    return out


def resized(image: F32, size: int) -> F32:
    """(size, size) picture, interpolated linearly between texel centres of a square image (S, S)."""
    import cv2

    if len(image) == size:
        return image
    return np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR), np.float32)


def numbered_channels(count: int) -> tuple[str, ...]:
    """Names of the channels of a map of numbers. Three are red, green and blue, as the usd stage has them: its picture
    of them is then the same file."""
    return ("R", "G", "B") if count == 3 else tuple(f"c{i}" for i in range(count))


def _from_samples(name: str, kind: MapKind, baked: Baked, place: _Place) -> TextureMap:
    low, high, total = np.inf, -np.inf, 0.0
    first = kind.values(baked.samples, slice(0, 1))
    shape = (baked.size, baked.size, first.shape[-1])
    image = _picture(shape, place.context.scratch)
    for start, stop in bands(baked.size):
        image[start:stop] = kind.values(baked.samples, baked.nearest[start:stop])
    rows = len(baked.texel)
    for start in range(0, rows, 1 << 20):
        part = kind.values(baked.samples, slice(start, start + (1 << 20)))
        low, high = min(low, float(part.min())), max(high, float(part.max()))
        total += float(part.sum(dtype=np.float64))
    return _store(name, image, (low, total / (rows * shape[2]), high), kind, place)


def _region(baked: Baked, votes: Votes | None, place: _Place) -> TextureMap:
    rows = len(baked.texel)
    code = np.zeros(rows, np.uint8)
    if votes is not None:
        for start in range(0, rows, 1 << 20):
            part = slice(start, start + (1 << 20))
            code[part] = votes.winners(baked.texel[part], baked.size)
    image = _picture((baked.size, baked.size, 1), place.context.scratch)
    for start, stop in bands(baked.size):
        image[start:stop, :, 0] = code[baked.nearest[start:stop]]
    return _store("region", image, _range(code), MapKind((), png=8, codes=True), place)


def _picture(shape: tuple[int, int, int], folder: Path) -> F32:
    """An (H, W, C) array whose channels are contiguous in memory, as the EXR writer needs them."""
    planes = (shape[2], *shape[:2])
    made = np.empty(planes, np.float32) if np.prod(shape) < IN_MEMORY else blank(folder, planes, np.float32)
    return np.moveaxis(made, 0, -1)


def _range(values: npt.NDArray[Any]) -> tuple[float, float, float]:
    return float(values.min()), float(values.mean(dtype=np.float64)), float(values.max())


def _store(name: str, image: F32, figures: tuple[float, float, float], kind: MapKind, place: _Place) -> TextureMap:
    folder = place.context.workdir / FOLDER
    exr, png = (tiles.form(k, place.tile, place.count) for k in ("exr", "png"))
    channels = numbered_channels(image.shape[2]) if kind.numbered else None
    primaries = REC709 if kind.colour else None  # none for numbers
    write_exr(folder / f"{name}.{exr}", image, channels, half=not kind.wide, step=kind.step, primaries=primaries,
              units=kind.units)  # fmt: skip
    files: dict[str, FileRef] = {exr: place.context.file(f"{FOLDER}/{name}.{exr}")}
    if kind.png:
        path = folder / f"{name}.{png}"
        if kind.space == "srgb_png":
            write_png_from_linear(path, image)
        else:
            if kind.codes:
                image /= 255
            stored = image if kind.shown is None else kind.shown(image)
            write_png(path, stored, kind.png, signed=kind.encoded)
        files[png] = place.context.file(f"{FOLDER}/{name}.{png}")
    minimum, mean, maximum = figures
    return TextureMap(
        name=name,
        channels=image.shape[2],
        files=files,
        space=kind.space,
        minimum=minimum,
        mean=mean,
        maximum=maximum,
    )
