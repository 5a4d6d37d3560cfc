"""A cornea as a convex mirror, and what a lamp's reflection in it sends to a camera.

A lamp at p is seen from e in a sphere of radius R around c at

    x = c + R n,    n = unit(unit(e - x) + unit(p - x))

Lamp and camera are far away, so that the sphere spreads what falls on dA = R^2 dw of it over 4 dw of directions. So the
reflection has the radiant intensity

    J = F E R^2 / 4

whatever the roughness of the wet surface, as long as it is narrow. E is the irradiance of the lamp on a surface that
faces it, F the reflectance at normal incidence. It is far smaller than a pixel: its radiance, summed over pixels, is
J r f_x f_y / z^3, with r the distance and z the depth from the camera.

s(n) is the share that lids and lashes let through where the normal is n: measured on the stage's lamps
(find_corneas.py), between them by a kernel of NEAR degrees.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.camera import PinholeCamera
from pipeline.maths.smoothstep import smoothstep
from pipeline.meshes import unit
from pipeline.transforms import F64

NEAR = 5.0  # degrees
UNKNOWN = 0.1  # weight of "no glint": far from what was seen there is none
BESIDE = 0.004  # metres beside a cornea to which a surface belongs to it: between lids it is not fitted better
FACING = 0.5  # least cosine between the normals of such a surface and of the cornea
DRY, WET = 0.3, 0.7  # shares between which the surface becomes a cornea
RIM, INNER = 40.0, 25.0  # degrees from the middle between which it does: the rim mirrors what is beside the head
ROUNDS = 8  # of the reflected point; each brings it nearer by the radius over the distance


@dataclass(frozen=True, slots=True)
class Cornea:
    """centre (3,), radius and f0 as above, asset coordinates, metres; normals (M, 3) unit, of the stage's lamps, and
    seen (M,) 1 where the pictures show the glint, else 0."""

    centre: F64
    radius: float
    f0: float
    normals: F64
    seen: F64

    def share(self, normals: F64) -> F64:
        """(N,) s at unit normals (N, 3)."""
        near = np.exp((normals @ self.normals.T - 1) / (1 - np.cos(np.radians(NEAR))))
        return np.asarray(near @ self.seen / (near.sum(1) + UNKNOWN), np.float64)

    def covers(self, position: F64, normal: F64) -> tuple[F64, F64]:
        """(N,) how far a surface at (N, 3) with unit normals (N, 3) is cornea, 0 to 1, and (N, 3) the cornea's unit
        normals there."""
        away = position - self.centre
        n, apart = unit(away), np.abs(np.linalg.norm(away, axis=1) - self.radius)
        middle = unit((self.seen @ self.normals)[None])[0]
        rim, inner = np.cos(np.radians([RIM, INNER]))
        s = smoothstep(self.share(n), DRY, WET) * smoothstep(n @ middle, rim, inner)
        return np.where((apart < BESIDE) & ((n * normal).sum(1) > FACING), s, 0.0), n


def reflected(centre: F64, radius: float, eye: F64, lamp: F64) -> tuple[F64, F64]:
    """x and n (N, 3) of lamps at (N, 3) that an eye at (3,) or (N, 3) sees in a sphere; all outside of it."""
    eye, lamp = np.atleast_2d(eye), np.atleast_2d(lamp)
    n = unit(unit(eye - centre) + unit(lamp - centre))
    for _ in range(ROUNDS):
        x = centre + radius * n
        n = unit(unit(eye - x) + unit(lamp - x))
    return centre + radius * n, n


def intensity(radius: float, f0: float, x: F64, lamp: F64, strength: F64) -> F64:
    """J (N, 3) of lamps at (N, 3) that shine with a radiant intensity (N, 3) towards x (N, 3)."""
    squared = ((lamp - x) ** 2).sum(1, keepdims=True)
    return np.asarray(f0 * radius**2 / 4 * strength / np.maximum(squared, 1e-12), np.float64)


def summed(camera: PinholeCamera, x: F64) -> F64:
    """(N,) r f_x f_y / z^3 of points (N, 3): the radiance of a radiant intensity of 1, summed over pixels; 0 behind the
    camera."""
    away = x - camera.eye
    z = away @ camera.world_from_cam[:3, 2]
    found = np.linalg.norm(away, axis=1) * camera.K[0, 0] * camera.K[1, 1] / np.maximum(z, 1e-9) ** 3
    return np.where(z > 1e-9, found, 0.0)


def stored(corneas: Sequence[Cornea]) -> list[dict[str, Any]]:
    """For basis.json."""
    return [
        {"centre": c.centre.round(6).tolist(), "radius": round(c.radius, 6), "f0": round(c.f0, 5),
         "normals": c.normals.round(4).tolist(), "seen": c.seen.astype(int).tolist()}
        for c in corneas
    ]  # fmt: skip


def from_stored(rows: Iterable[dict[str, Any]]) -> tuple[Cornea, ...]:
    """Of `stored`. Raises KeyError, TypeError or ValueError if an entry is damaged."""
    return tuple(
        Cornea(np.array(c["centre"], np.float64).reshape(3), float(c["radius"]), float(c["f0"]),
               np.array(c["normals"], np.float64).reshape(-1, 3), np.array(c["seen"], np.float64).reshape(-1))
        for c in rows
    )  # fmt: skip
