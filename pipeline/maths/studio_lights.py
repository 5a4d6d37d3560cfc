"""Three made lights for looking at an asset: a studio with a key lamp, an overcast sky, a sunset.

Lamps are lobes L(d) = c exp(k (d . w - 1)) with axis w and concentration k; each has the flux 2 pi c (1 - e^(-2k)) / k.
The overcast sky is L = L_z (1 + 2 sin g) / 3 at elevation g over a ground of reflectance 0.2
[CIE standard overcast sky; Moon and Spencer 1942]. Every light is scaled so that a white diffuse surface that faces +Z
(the front of an asset) has a luminance of 1: E(+Z) = pi.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.colour import LUMA
from pipeline.maths.latlong import latlong_directions, latlong_weights

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

GROUND = 0.2  # reflectance of the ground under the overcast sky
FINE = 256  # columns of the picture that scales a light


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lobe of light. azimuth, elevation: degrees, azimuth 0 is +Z and grows towards +X; concentration: about
    1 / width^2 in radians; colour (3,): radiance on its axis."""

    azimuth: float
    elevation: float
    concentration: float
    colour: tuple[float, float, float]

    def radiance(self, directions: F64) -> F64:
        """(..., 3) for unit directions (..., 3)."""
        a, e = np.radians([self.azimuth, self.elevation])
        axis = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        lobe = np.exp(self.concentration * (directions @ axis - 1))
        return np.asarray(lobe[..., None] * np.array(self.colour), np.float64)


KEY = (
    Lamp(40, 35, 40, (10.0, 9.6, 9.0)),  # the key lamp
    Lamp(-60, 10, 8, (0.7, 0.8, 1.0)),  # a wide, cool fill from the other side
    Lamp(165, 35, 60, (7.0, 7.0, 7.5)),  # the rim lamp behind
)
KEY_ROOM = 0.08  # radiance of the room
SUN = Lamp(55, 8, 400, (260.0, 120.0, 42.0))
GLOW = Lamp(55, 2, 6, (2.4, 1.1, 0.45))
ZENITH, HORIZON, EARTH = (0.10, 0.18, 0.38), (0.50, 0.38, 0.33), (0.09, 0.07, 0.06)


def key_light(directions: F64) -> F64:
    """(..., 3) radiance of the studio, unscaled."""
    return np.asarray(KEY_ROOM + sum(lamp.radiance(directions) for lamp in KEY), np.float64)


def overcast(directions: F64) -> F64:
    """(..., 3) radiance of the overcast sky with zenith radiance 1; the horizontal irradiance is 7 pi / 9."""
    up = directions[..., 1]
    sky = (1 + 2 * up.clip(0)) / 3
    return np.repeat(np.where(up >= 0, sky, GROUND * 7 / 9)[..., None], 3, -1)


def sunset(directions: F64) -> F64:
    """(..., 3) radiance of a sky with a low sun, unscaled."""
    up = directions[..., 1:2]
    height = np.sqrt(up.clip(0))
    sky = (1 - height) * np.array(HORIZON) + height * np.array(ZENITH)
    warm = GLOW.radiance(directions) + SUN.radiance(directions)
    return np.asarray(np.where(up >= 0, sky + warm, np.array(EARTH) * np.ones_like(sky)), np.float64)


LIGHTS = {"key": key_light, "overcast": overcast, "sunset": sunset}


def picture(name: str, width: int) -> F32:
    """(width / 2, width, 3) lat-long picture of one of LIGHTS, scaled as above. width: even, at least 2."""
    image = LIGHTS[name](latlong_directions(width, width // 2))
    return np.asarray(image / facing_luminance(name), np.float32)


def facing_luminance(name: str) -> float:
    """Luminance of a white diffuse surface that faces +Z in the unscaled light: integral of L max(d_z, 0) / pi."""
    directions = latlong_directions(FINE, FINE // 2)
    image = LIGHTS[name](directions) @ np.array(LUMA)
    weights = latlong_weights(FINE, FINE // 2) * directions[..., 2].clip(0)
    return float((image * weights).sum() / np.pi)
