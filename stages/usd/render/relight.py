"""Renders the exported asset under any environment map: as lamps, with shadows and interreflections.

    L(wo) = a / pi (D + I) + (sum_j rho c_j B_j(n.wo)) sum_k V_k E_k vMF(w_k; w_r, kappa)

The lobe is the model's own; the light is the picture itself, not its spherical harmonics. Symbols:
pipeline/lighting/transport.py.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from pipeline.lighting.median_cut import Lamps, checked_environment, lamps
from pipeline.lighting.transport import Transport
from pipeline.maths.ggx_width import KAPPA_RANGE
from stages.usd.render import kernels
from stages.usd.render.render import Points, Renderer, vertex_values

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

COUNT = 256


class Environment:
    """A lat-long picture as the light of one asset. Shadows are traced once for all views."""

    def __init__(
        self, renderer: Renderer, image: F32, name: str, count: int = COUNT, check: Callable[[], None] = lambda: None
    ) -> None:
        mesh = renderer.asset.mesh
        lit = lamps(checked_environment(image, name), count)
        transport = Transport(mesh.vertices, mesh.normals, mesh.faces)
        seen = transport.visibility(lit.directions, check)
        direct = transport.direct(seen, lit.directions, lit.flux)
        self._seen, self._lamp = seen, table_of(lit)
        self._indirect = transport.indirect(direct, vertex_values(renderer.asset.albedo, renderer)).astype(np.float32)

    def shade(self, renderer: Renderer, points: Points) -> F64:
        """(M, 3) radiance towards wo. kappa is limited to the range of the exported roughness."""
        n = points.normal.astype(np.float32)
        facing = (points.normal * points.wo).sum(1, keepdims=True)
        mirror = (2 * facing * points.normal - points.wo).astype(np.float32)
        s = renderer.at(renderer.asset.inv_kappa, points.uv)[:, 0].clip(1 / KAPPA_RANGE[1], 1 / KAPPA_RANGE[0])
        direct, glossy = np.empty((len(n), 3), np.float32), np.empty((len(n), 3), np.float32)
        kernels.under_lamps(n, mirror, s, points.corner, points.weights, self._seen, self._lamp, direct, glossy)
        bounced = np.einsum("nic,ni->nc", self._indirect[points.corner], points.weights)
        albedo = renderer.at(renderer.asset.albedo, points.uv)
        return np.asarray(albedo / np.pi * (direct + bounced) + renderer.strength(points)[:, None] * glossy, np.float64)


def table_of(lit: Lamps) -> F32:
    """(7, N) direction, flux and spread of the lamps, as input of the kernel."""
    return np.concatenate([lit.directions.T, lit.flux.T, lit.spread[None]]).astype(np.float32)
