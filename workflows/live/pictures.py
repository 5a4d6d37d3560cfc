"""Pictures of what a finished stage made, for the page of a run at work: small, made once, of what is on the disk.

A picture is a file: its name in OUT/live, its bytes, and a caption. A stage without one here shows none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Located

U8 = npt.NDArray[np.uint8]
F64 = npt.NDArray[np.float64]
SIDE = 220  # pixels of one picture on a sheet
COLUMNS = 4
SHEET = 8  # photos with the outline of their mask
QUALITY = 85  # of JPEG
MAPS = ("albedo", "normal", "roughness", "ambient_occlusion", "coverage", "confidence")
TURNS = (("from the front", 0.0), ("from the left", 90.0), ("from the right", -90.0), ("from behind", 180.0))
GREY = 90  # behind the subject
Finished = Mapping[str, Located[Any]]


@dataclass(frozen=True, slots=True)
class Drawn:
    """A file for OUT/live."""

    name: str
    data: bytes
    caption: str


def drawn(stage: str, finished: Finished) -> Drawn | None:
    """The picture of a stage that was just finished; None if it has none."""
    maker = MAKERS.get(stage)
    return maker(finished) if maker is not None else None


def jpeg(image: U8) -> bytes:
    """An 8-bit sRGB picture (H, W, 3) as JPEG."""
    import cv2

    done, buffer = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise RuntimeError(f"a picture of {image.shape} can't be encoded")
    return bytes(buffer.tobytes())


# ------------------------------------------------------------------ of the stages
def _cameras(finished: Finished) -> Drawn:
    from stages.report.capture_figures import KINDS, drawing

    capture, poses = finished["capture"].artifact, finished["poses"]
    held = {v.index for v in capture.views if v.holdout}
    kinds = {c.index: "held out" if c.index in held else "fitted" for c in poses.artifact.cameras}
    svg = str(drawing(poses, kinds)).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    lost = len(poses.artifact.unregistered)
    colours = {"#2a9d6f": "green", "#3f7fd1": "blue"}
    said = ", ".join(f"{colours.get(KINDS[k], KINDS[k])}: {k}" for k in ("fitted", "held out"))
    caption = f"{len(kinds)} cameras ({said}), sparse points" + (f"; {lost} photos without a camera" if lost else "")
    return Drawn("cameras.svg", svg.encode(), caption)


def _masks(finished: Finished) -> Drawn:
    from pipeline.images import read_alpha, read_encoded
    from stages.report.capture_figures import outlined

    capture, masks = finished["capture"], finished["masks"]
    views, known = {v.index: v for v in capture.artifact.views}, masks.artifact.masks
    worst = sorted(known, key=lambda m: (m.hull_iou if m.hull_iou is not None else 2.0, m.index))
    spread = known[:: max(1, len(known) // SHEET)]
    chosen = list({m.index: m for m in (*worst[: SHEET // 2], *spread, *worst)}.values())[:SHEET]
    pictures = [
        outlined(read_encoded(capture.path(views[m.index].image)), read_alpha(masks.path(m.mask)), SIDE) for m in chosen
    ]
    dropped = len(masks.artifact.dropped)
    more = f"; {dropped} are dropped" if dropped else ""
    text = f"outlines of {len(chosen)} of {len(known)} masks, the worst first{more}"
    return Drawn("masks.jpg", jpeg(sheet(pictures)), text)


def _mesh(finished: Finished) -> Drawn:
    from pipeline import meshes

    surface = finished["surface"]
    mesh = meshes.load(surface.path(surface.artifact.mesh))
    pictures = [shaded(mesh.vertices, mesh.faces, mesh.normals, degrees, SIDE) for _, degrees in TURNS]
    return Drawn("mesh.jpg", jpeg(sheet(pictures)), f"{surface.artifact.faces:,} triangles")


def _maps(finished: Finished) -> Drawn | None:
    from pipeline import tiles
    from pipeline.images import read_encoded
    from stages.report.pictures import to_bytes

    bake, pictures, names = finished["bake"], [], []
    kind = tiles.form("png", 0, bake.artifact.tiles)
    for name in (n for n in MAPS if n in bake.artifact.maps and kind in bake.artifact.maps[n].files):
        image = read_encoded(bake.path(bake.artifact.maps[name].files[kind]))
        step = max(1, image.shape[0] // SIDE)
        thin = np.asarray(image[::step, ::step][..., :3], np.float64) / np.iinfo(image.dtype.name).max
        pictures.append(to_bytes(thin))
        names.append(name.replace("_", " "))
    return Drawn("maps.jpg", jpeg(sheet(pictures)), ", ".join(names)) if pictures else None


def _asset(finished: Finished) -> Drawn | None:
    from pipeline.images import read_encoded

    usd, pictures = finished["usd"], []
    for side in ("left", "front", "right"):
        file = next((f for f in usd.artifact.files if f.path == f"previews/{side}.png"), None)
        if file is not None:
            pictures.append(_over_grey(np.asarray(read_encoded(usd.path(file)), np.uint8)))
    return Drawn("asset.jpg", jpeg(sheet(pictures, 3)), "the asset in the captured light") if pictures else None


MAKERS: dict[str, Callable[[Finished], Drawn | None]] = {
    "poses": _cameras, "masks": _masks, "surface": _mesh, "bake": _maps, "usd": _asset,
}  # fmt: skip


# ------------------------------------------------------------------ helpers
def sheet(pictures: list[U8], columns: int = COLUMNS) -> U8:
    """Pictures (h, w, 3) of any sizes in rows, each in a square of SIDE pixels."""
    import cv2

    cells = []
    for picture in pictures:
        shrink = min(1.0, SIDE / max(picture.shape[:2]))
        size = (max(1, round(picture.shape[1] * shrink)), max(1, round(picture.shape[0] * shrink)))
        small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        cell = np.full((SIDE, SIDE, 3), GREY, np.uint8)
        y, x = (SIDE - small.shape[0]) // 2, (SIDE - small.shape[1]) // 2
        cell[y : y + small.shape[0], x : x + small.shape[1]] = small
        cells.append(cell)
    columns = min(columns, len(cells))
    cells += [np.full((SIDE, SIDE, 3), GREY, np.uint8)] * (-len(cells) % columns)
    return np.concatenate([np.concatenate(cells[i : i + columns], 1) for i in range(0, len(cells), columns)])


def shaded(
    vertices: npt.NDArray[np.floating],
    faces: npt.NDArray[np.integer],
    normals: npt.NDArray[np.floating],
    degrees: float,
    side: int,
) -> U8:
    """(side, side, 3) a mesh by parallel projection, lit from the viewer. normals: of the
    vertices; degrees: of the viewer around +Y from +Z."""
    from pipeline.ray_casting import RayCaster

    a = np.radians(degrees)
    right, toward = np.array([np.cos(a), 0.0, -np.sin(a)]), np.array([np.sin(a), 0.0, np.cos(a)])
    middle = (vertices.max(0) + vertices.min(0)) / 2
    reach = float(np.linalg.norm(vertices - middle, axis=1).max()) * 1.02 + 1e-9
    steps = ((np.arange(side) + 0.5) / side * 2 - 1) * reach
    x, y = np.meshgrid(steps, -steps)
    origins = middle + x[..., None] * right + y[..., None] * np.array([0.0, 1.0, 0.0]) + 2 * reach * toward
    found = RayCaster(vertices, faces).first_faces(origins.reshape(-1, 3), np.tile(-toward, (side * side, 1)))
    normal = normals[faces[np.maximum(found, 0)]].astype(np.float64).mean(1)
    light = np.abs(normal @ toward) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    grey = np.where(found >= 0, 40 + 200 * light, GREY)
    return np.repeat(grey.round().astype(np.uint8).reshape(side, side, 1), 3, 2)


def _over_grey(image: U8) -> U8:
    """(H, W, 3) of RGB or RGBA."""
    if image.shape[2] < 4:
        return image
    alpha = image[..., 3:].astype(np.float32) / 255
    return np.asarray(image[..., :3] * alpha + GREY * (1 - alpha), np.uint8)
