"""Pictures of a reflectance field: lamps, several of them, and environments.

Texels are shaded once for a camera; pixels are means of texels. `look_up` finds which, by rays through each pixel.
Glints of corneas are narrower than texels and are added to the picture (glints.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.camera import PinholeCamera
from pipeline.images import F32
from pipeline.transforms import F64, pixel_centres
from stages.reflectance.field import Field, Lamp, distant_lamp
from stages.reflectance.glints import glints

SAMPLES = 2  # rays along each side of a pixel
BAND = 1_000_000  # rays that are traced at a time
QUICK, FULL = 64, 384  # lamps of an environment


@dataclass(frozen=True, slots=True)
class Lit:
    """What a camera sees of a field: radiance (T, 3) of its texels, glints (H, W, 3) of its corneas in the picture."""

    radiance: F32
    glints: F32


def lit_by(field: Field, camera: PinholeCamera, lamp: Lamp, arrives: F32) -> Lit:
    """Under one lamp. arrives (T,): of `field.arrives`."""
    return Lit(field.radiance(lamp, camera.eye, arrives), glints(field, camera, lamp))


def look_up(field: Field, camera: PinholeCamera, samples: int = SAMPLES) -> Any:
    """Sparse (H W, T) matrix from texels to pixels. Its rows sum to the share of a pixel that the mesh covers. Made in
    bands of rows, because the rays of a large picture would take gigabytes."""
    from scipy.sparse import vstack

    rows = max(1, BAND // (camera.width * samples**2))
    bands = [_band(field, camera, samples, first, min(first + rows, camera.height))
             for first in range(0, camera.height, rows)]  # fmt: skip
    return bands[0] if len(bands) == 1 else vstack(bands, format="csr")


def _band(field: Field, camera: PinholeCamera, samples: int, first: int, last: int) -> Any:
    """The rows of `look_up` of the pixels in rows first ... last - 1 of the picture."""
    from scipy.sparse import csr_array

    fine = camera.scaled(camera.width * samples)
    centres = pixel_centres(fine.width, (last - first) * samples) + (0, first * samples)
    origin, rays = fine.rays(centres)
    far, face = field.whole.hits(np.broadcast_to(origin, rays.shape), rays)
    hit = np.flatnonzero(face >= 0)
    at, face = origin + far[hit, None] * rays[hit], face[hit]
    corners = field.charts.uvs.astype(np.float64)[field.charts.faces[face]]
    triangles = field.mesh.vertices.astype(np.float64)[field.mesh.faces[face]]
    uv = (corners * barycentric(triangles, at)[..., None]).sum(1)
    size = field.points.size
    x, y = uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    pixel = (hit // fine.width // samples) * camera.width + (hit % fine.width) // samples
    rows, columns, weights = [], [], []
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = (np.clip(v, 0, size - 1) for v in (left + dx, top + dy))
            share = np.abs(1 - dx - (x - left)) * np.abs(1 - dy - (y - top))
            rows.append(pixel)
            columns.append(field.nearest[row * size + column])
            weights.append(share / samples**2)
    shape = (camera.width * (last - first), len(field.known))
    return csr_array((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=shape)


def barycentric(corners: F64, at: F64) -> F64:
    """(N, 3) weights of points (N, 3) on triangles (N, 3, 3)."""
    a, b, c = corners.transpose(1, 0, 2)
    u, v, w = b - a, c - a, at - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    below = np.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (vv * wu - uv * wv) / below, (uu * wv - uv * wu) / below
    return np.stack([1 - s - t, s, t], 1)


def picture(camera: PinholeCamera, table: Any, lit: Lit) -> F32:
    """(H, W, 4) linear RGBA, premultiplied. table: of `look_up`."""
    rgb = np.asarray(table @ lit.radiance, np.float32).reshape(camera.height, camera.width, 3) + lit.glints
    alpha = np.asarray(table.sum(axis=1), np.float32).reshape(camera.height, camera.width, 1)
    return np.concatenate([rgb, alpha], 2)


def under_lamps(
    field: Field,
    cameras: Sequence[PinholeCamera],
    lamps: Sequence[Lamp],
    tick: Callable[[int, int], None],
    rays: int = 3,
) -> list[Lit]:
    """Of each camera, under all lamps together. tick: lamps done, of all."""
    total = [Lit(np.zeros((len(field.known), 3), np.float32), np.zeros((c.height, c.width, 3), np.float32))
             for c in cameras]  # fmt: skip
    for done, lamp in enumerate(lamps):
        tick(done, len(lamps))
        arrives = field.arrives(lamp, rays)
        for whole, camera in zip(total, cameras, strict=True):
            one = lit_by(field, camera, lamp, arrives)
            np.add(whole.radiance, one.radiance, out=whole.radiance)
            np.add(whole.glints, one.glints, out=whole.glints)
    return total


def lamps_of(environment: F32, name: str, *, quick: bool) -> list[Lamp]:
    """Distant lamps of a lat-long picture (H, 2 H, 3) in asset coordinates. quick: fewer of them."""
    from pipeline.lighting.median_cut import checked_environment
    from pipeline.lighting.median_cut import lamps as cut

    found = cut(checked_environment(environment, name), QUICK if quick else FULL)
    return [distant_lamp(d.astype(np.float64), f.astype(np.float64), float(np.sqrt(s)))
            for d, f, s in zip(found.directions, found.flux, found.spread, strict=True)]  # fmt: skip
