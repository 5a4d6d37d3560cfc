"""A captured light that moves with the camera, as plain numbers: its file, its irradiance, and a still stand-in.

    E(x, n) = s(x) E_c(R^T n) + E_a(n),    L(x, d) = s(x) L_c(R^T d) + L_a(d)

Symbols: L_c radiance in the light's frame R, s its strength at x (pipeline.maths.light_frame); L_a the still ambient
light; E the irradiances. Coefficients are of real orthonormal spherical harmonics, index l (l + 1) + m.

Programs that know no such light get the still stand-in: the light while the camera is in front of the face.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pipeline.maths import brdf, sh
from pipeline.maths.light_frame import MOVING, Stations, Turn, turn_of

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

FRONT = np.diag([1.0, -1.0, -1.0])  # axes of an upright camera on +Z that looks at the face


@dataclass(frozen=True, slots=True)
class Standpoint:
    """A camera: centre (3,), axes (3, 3) with the columns right, down and forward, in asset coordinates."""

    centre: F64
    axes: F64

    @classmethod
    def of(cls, world_from_cam: F64) -> Standpoint:
        """Of a pose (4, 4), OpenCV axes."""
        return cls(world_from_cam[:3, 3], world_from_cam[:3, :3])

    def stations(self, count: int) -> Stations:
        """For `count` points."""
        centre, axes = (torch.from_numpy(np.asarray(a, np.float32)) for a in (self.centre, self.axes))
        return Stations(centre.expand(count, 3), axes.expand(count, 3, 3))


@dataclass(frozen=True, slots=True)
class MovingLight:
    """frame: one of light_frame.MOVING; distance: d_0, of a flash; coefficients ((L + 1)^2, 3) of L_c, ambient of
    L_a."""

    frame: str
    distance: float
    coefficients: F32
    ambient: F32

    def still(self) -> F32:
        """((L + 1)^2, 3) the light while the camera is in front of the face, at the distance d_0."""
        out = sh.rotated(self.coefficients.astype(np.float64), FRONT)
        out[: len(self.ambient)] += self.ambient[: len(out)]
        return out.astype(np.float32)

    def irradiance(self, x: F32, n: F32, eye: Standpoint) -> F32:
        """E (N, 3) at points x with unit normals n (N, 3) in a photo."""
        normal, _, turn = self.turned(x, n, eye)
        moving = turn.strength * sh.irradiance(_tensor(self.coefficients), turn(normal))
        return np.asarray((moving + sh.irradiance(_tensor(self.ambient), normal)).numpy(), np.float32)

    def reflected(self, x: F32, n: F32, width: F32, eye: Standpoint, attenuation: str) -> F32:
        """(N, 3) radiance averaged over lobes of 1 / kappa = width (N,) around the mirror directions at x, n (N, 3).
        [NeuFace eq. 11]"""
        normal, toward, turn = self.turned(x, n, eye)
        mirror, s = brdf.reflect(toward, normal), _tensor(width)
        moving = turn.strength * brdf.light_integral(turn(mirror), s, _tensor(self.coefficients), attenuation)
        still = brdf.light_integral(mirror, s, _tensor(self.ambient), attenuation)
        return np.asarray((moving + still).numpy(), np.float32)

    def stored(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "frame": self.frame,
            "distance": float(self.distance),
            "coefficients": _rows(self.coefficients),
            "ambient": _rows(self.ambient),
        }

    def turned(self, x: F32, n: F32, eye: Standpoint) -> tuple[Tensor, Tensor, Turn]:
        """n and the unit directions to the eye, (N, 3) each, and the turn into the light's frame at x (N, 3)."""
        at, normal = _tensor(x), _tensor(n)
        away = torch.from_numpy(np.asarray(eye.centre, np.float32)) - at
        toward = away / away.norm(dim=-1, keepdim=True).clamp(min=1e-12)
        return normal, toward, turn_of(self.frame, eye.stations(len(at)), at, toward, self.distance)


def from_stored(stored: Mapping[str, Any] | None) -> MovingLight | None:
    """Inverse of `stored`; None for None. Raises ValueError or KeyError for anything else."""
    if stored is None:
        return None
    coefficients, ambient = (np.asarray(stored[k], np.float32) for k in ("coefficients", "ambient"))
    for c in (coefficients, ambient):
        if c.ndim != 2 or c.shape[1] != 3 or int(np.sqrt(len(c))) ** 2 != len(c) or not np.isfinite(c).all():
            raise ValueError(f"coefficients of shape {c.shape}")
    distance = float(stored["distance"])
    if stored["frame"] not in MOVING or not (np.isfinite(distance) and distance > 0):
        raise ValueError(f"frame {stored['frame']!r}, distance {distance}")
    return MovingLight(str(stored["frame"]), distance, coefficients, ambient)


def _rows(values: F32) -> list[list[float]]:
    return [[float(f"{x:.9g}") for x in row] for row in np.asarray(values, np.float64)]


def _tensor(values: npt.NDArray[np.floating]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
