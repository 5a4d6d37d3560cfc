"""A small picture of a capture's head that turns, for the batch's page: its albedo in an even light, as animated WebP.

It is made from the mesh and the albedo in the store, once for each result: OUT/NAME/report/turn.webp. The next run
that publishes the capture removes it, and so does `neuface store purge`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.errors import NeufaceError
from pipeline.film import animated_webp
from pipeline.store import MANIFEST, read_object
from workflows.run.owned import write_owned

FILE = "report/turn.webp"
SIDE, FRAMES, SECONDS = 96, 16, 4.0  # pixels, pictures of a turn, time of a turn
START = 25.0  # degrees of the first picture, as the thumbnail's
ALBEDO_SIDE = 1024  # texels that are enough for so small a picture
QUALITY = 75


def write_turn(out: Path) -> bool:
    """Write the picture of the run in the folder `out`. False if the run has no asset, or its store no mesh."""
    try:
        sources = _sources(out)
        data = animated_webp(list(frames(*sources)), SECONDS, QUALITY) if sources else b""
    except (NeufaceError, OSError, ValueError, KeyError, TypeError, AttributeError):  # a damaged or older result
        return False
    if data:
        write_owned(out, FILE, data)
    return bool(data)


def _sources(out: Path) -> tuple[Path, list[Path]] | None:
    """The textured mesh, and the albedo of its tiles."""
    from pipeline import tiles

    record = read_object(out / "run.json")
    if "usd" not in record.get("stages", {}):
        return None
    folders = {s: Path(record["store"]) / s / record["stages"][s]["key"] for s in ("uv", "bake")}
    uv, bake = (read_object(f / MANIFEST) for f in folders.values())
    if not uv or not bake:
        return None
    count, files = int(bake["tiles"]), bake["maps"]["albedo"]["files"]
    albedo = [folders["bake"] / files[tiles.form("png", t, count)]["path"] for t in range(count)]
    return folders["uv"] / uv["mesh"]["path"], albedo


def frames(mesh_file: Path, albedo_files: list[Path]) -> Iterator[npt.NDArray[np.uint8]]:
    """(SIDE, SIDE, 3) sRGB pictures of one turn."""
    from pipeline.colour import srgb_from_linear
    from pipeline.images import read_linear
    from pipeline.ray_casting import RayCaster
    from stages.usd.write.mesh import read_mesh
    from workflows.batch.average_picture import view

    mesh = read_mesh(mesh_file)
    caster = RayCaster(mesh.vertices, mesh.faces)
    albedo = {t: _reduced(read_linear(f)) for t, f in enumerate(albedo_files)}
    for angle in np.radians(START) + 2 * np.pi * np.arange(FRAMES) / FRAMES:
        linear = view(mesh, albedo, caster, float(angle), SIDE)
        yield np.round(255 * srgb_from_linear(linear)).astype(np.uint8)


def _reduced(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    step = max(1, image.shape[0] // ALBEDO_SIDE)
    return image[::step, ::step]
