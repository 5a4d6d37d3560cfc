"""Lights of the renderer that move with the camera: the model's closed form, and standard shaders. Each is for the
picture of one camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.camera import PinholeCamera
from pipeline.lighting.moving import MovingLight, Standpoint
from pipeline.lighting.moving_standard import MovingLamps
from stages.usd.render.exported import ExportedAsset
from stages.usd.render.render import Light, Points, Renderer

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]


class Captured:
    """The captured light of an asset whose light moves: on its standard material if that was fitted, else the model."""

    def __init__(self, asset: ExportedAsset) -> None:
        assert asset.moving is not None
        self._light = asset.moving
        self._lamps = None if asset.f0 is None else MovingLamps(asset.moving)

    def of(self, view: PinholeCamera) -> Light:
        """That of one camera."""
        eye = Standpoint.of(view.world_from_cam)
        return Carried(self._light, eye) if self._lamps is None else StandardCarried(self._lamps, eye)


@dataclass(frozen=True, slots=True)
class Carried:
    """The fitted model. [NeuFace eq. 12] + [NeuFace eq. 16]"""

    light: MovingLight
    eye: Standpoint

    def shade(self, renderer: Renderer, points: Points) -> F64:
        """(M, 3) radiance."""
        asset, x, n = renderer.asset, places(renderer, points), points.normal.astype(np.float32)
        albedo = renderer.at(renderer.fitted_albedo, points.uv)
        diffuse = albedo / np.pi * self.light.irradiance(x, n, self.eye).clip(min=0)
        s = renderer.at(asset.inv_kappa, points.uv)[:, 0].clip(min=0)
        incident = self.light.reflected(x, n, s, self.eye, asset.attenuation)
        return np.asarray(diffuse + renderer.strength(points)[:, None] * incident, np.float64)


@dataclass(frozen=True, slots=True)
class StandardCarried:
    """Base colour, F0 and roughness, as other programs show them."""

    lamps: MovingLamps
    eye: Standpoint

    def shade(self, renderer: Renderer, points: Points) -> F64:
        """(M, 3) radiance."""
        asset = renderer.asset
        assert asset.f0 is not None and asset.roughness is not None
        base = renderer.at(asset.albedo, points.uv)
        f0, roughness = (renderer.at(m, points.uv)[:, 0] for m in (asset.f0, asset.roughness))
        x, n = places(renderer, points), points.normal.astype(np.float32)
        return self.lamps.radiance(x, n, self.eye, base, f0, roughness)


def places(renderer: Renderer, points: Points) -> F32:
    """(M, 3) points on the mesh."""
    corners = renderer.asset.mesh.vertices[points.corner]
    return np.asarray(np.einsum("nic,ni->nc", corners, points.weights), np.float32)
