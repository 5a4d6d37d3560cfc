"""Shows the exported standard material, as other programs do: base colour, F0 and roughness under a picture of the
light, with shadows and interreflections (pipeline/lighting/standard.py)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from pipeline.lighting import standard
from pipeline.lighting.median_cut import checked_environment, lamps
from stages.usd.render.render import Points, Renderer, vertex_values

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]


class StandardLight:
    """A lat-long picture as the light of one asset that has a fitted standard material. Shadows are traced once for
    all views."""

    def __init__(
        self,
        renderer: Renderer,
        image: F32,
        name: str,
        count: int = standard.COUNT,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        mesh = renderer.asset.mesh
        lit = lamps(checked_environment(image, name), count)
        albedo = vertex_values(renderer.asset.albedo, renderer)
        self._at = standard.arrivals(mesh.vertices, mesh.normals, mesh.faces, lit, albedo, check)

    def shade(self, renderer: Renderer, points: Points) -> F64:
        """(M, 3) radiance towards wo."""
        asset = renderer.asset
        assert asset.f0 is not None and asset.roughness is not None
        base = renderer.at(asset.albedo, points.uv)
        f0, roughness = (renderer.at(x, points.uv)[:, 0] for x in (asset.f0, asset.roughness))
        diffuse, specular = standard.radiance(
            self._at, points.corner, points.weights, points.normal, points.wo, base, f0, roughness
        )
        return diffuse + specular
