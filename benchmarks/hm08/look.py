"""Pictures to look at: regions, texture layout, a chequered texture from four sides, landmarks, some persons."""

from __future__ import annotations

import colorsys
from pathlib import Path

import cv2
import numpy as np

from benchmarks.hm08 import pictures
from benchmarks.hm08.cut import Cut
from benchmarks.hm08.identity import Identity
from benchmarks.hm08.landmarks import Found, picture
from benchmarks.hm08.regions import NAMES
from pipeline.meshes import F64, Indices

COLOURS = np.array([colorsys.hsv_to_rgb((k * 0.381) % 1, 0.75, 0.5 + 0.2 * (k % 3)) for k in range(len(NAMES))])
SIZE, CENTRE, RADIUS = 900, np.array([0.0, 7.1, 0.65]), 1.45
SIDES = ((0, 0), (90, 0), (180, 0), (-50, 0))  # azimuth, elevation


def write_pictures(folder: Path, identity: Identity, cut: Cut, label: Indices, uv: F64, found: Found) -> None:
    """All pictures as PNG files."""
    folder.mkdir(parents=True, exist_ok=True)
    mean = identity.mean
    sides = [pictures.orbit(CENTRE, RADIUS, a, e, SIZE) for a, e in SIDES]
    random = np.random.default_rng(1).standard_normal((4, len(identity.basis)))
    persons = [mean + np.tensordot(w * identity.deviation, identity.basis, 1) for w in random]
    view = pictures.orbit(CENTRE, RADIUS, 25, 5, SIZE)
    out = {
        "regions": pictures.side_by_side([_coloured(mean, cut, COLOURS[label], s) for s in sides]),
        "checker": pictures.side_by_side([_chequered(mean, cut, uv, s) for s in sides]),
        "landmarks": pictures.side_by_side([_marked(mean, cut, label, found, s) for s in (sides[0], sides[3])]),
        "persons": pictures.side_by_side([picture(p, cut, label, view) for p in persons]),
        "uv_1001": _flat(uv, label, 0),
        "uv_1002": _flat(uv, label, 1),
    }
    for name, image in out.items():
        cv2.imwrite(str(folder / f"{name}.png"), image[..., ::-1])


def _triangles(cut: Cut) -> pictures.Faces:
    return cut.quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)


def _coloured(mean: F64, cut: Cut, colours: F64, shot: pictures.Shot) -> pictures.U8:
    """Quads in their colours with dark edges."""
    seen = pictures.traced(mean, _triangles(cut), shot)
    own = np.where(seen.triangle[:, None] % 2 == 0, seen.weights[:, [0, 2]], seen.weights[:, [0, 1]])
    edge = np.where(own.min(1) < 0.03, 0.6, 1.0)[:, None]
    return pictures.shaded(seen, colours[seen.triangle // 2] * edge, shot)


def _chequered(mean: F64, cut: Cut, uv: F64, shot: pictures.Shot) -> pictures.U8:
    seen = pictures.traced(mean, _triangles(cut), shot)
    corners = uv[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 2)[seen.triangle]
    return pictures.shaded(seen, pictures.checker((corners * seen.weights[..., None]).sum(1), 48), shot)


def _marked(mean: F64, cut: Cut, label: Indices, found: Found, shot: pictures.Shot) -> pictures.U8:
    image = picture(mean, cut, label, shot).copy()
    points = (mean[found.corners] * found.weights[..., None]).sum(1)
    at = (points - shot.world_from_cam[:3, 3]) @ shot.world_from_cam[:3, :3] @ shot.K.T
    for x, y in (at[:, :2] / at[:, 2:]).round().astype(int).tolist():
        cv2.circle(image, (x, y), 3, (0, 255, 0), -1)
    return image


def _flat(uv: F64, label: Indices, tile: int) -> pictures.U8:
    """A tile of the layout in the regions' colours."""
    image = np.full((SIZE, SIZE, 3), 20, np.uint8)
    for quad, k in zip(uv, label, strict=True):
        if int(quad[:, 0].mean()) == tile:
            at = np.round(np.stack([quad[:, 0] - tile, 1 - quad[:, 1]], 1) * SIZE * 16).astype(np.int32)
            cv2.fillPoly(image, [at], (COLOURS[k] * 255).tolist(), shift=4)
            cv2.polylines(image, [at], True, (30, 30, 30), 1, cv2.LINE_AA, shift=4)
    return image
