"""Shadows and interreflections of the head, computed at the vertices.

Symbols (all at the mesh's vertices)
    w_k, E_k  lamps: direction towards, irradiance on a facing surface
    V_k       1 where lamp k is visible, 0 where the head blocks it
    D         sum_k V_k E_k max(n . w_k, 0), direct irradiance
    T         transport: mean over the cosine-weighted hemisphere of the radiosity at the points that the rays hit
    I         T (a D) + T (a T (a D)) + ..., indirect irradiance, a = albedo

The photos contain both effects, and NeuFace's closed form contains neither: the fit puts them into the albedo.
`occlusion` is the factor that it put there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from pipeline.lighting.median_cut import Lamps
from pipeline.ray_casting import RayCaster, neighbours_first

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]

LIFT = 1e-3  # of the head's size: rays start this far above the surface, against self-shadowing of facets
BOUNCES, BOUNCE_RAYS = 4, 96
GRAZING = -0.2  # least cosine of lamps at a vertex: others can't light its triangles' interpolated normals
DARKEST = 0.25  # lower limit of occlusion: else nostrils and mouths would become too bright
BRIGHTEST_ALBEDO = 0.95
ROUNDS = 6


class Transport:
    """Ray casting between the vertices of one mesh. vertices, normals (V, 3); faces (F, 3)."""

    def __init__(self, vertices: F32, normals: F32, faces: I32, rays: int = BOUNCE_RAYS) -> None:
        self.faces = faces
        n = normals.astype(np.float64)
        self.normals = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
        self._caster = RayCaster(vertices, faces)
        self._starts = vertices + LIFT * self._caster.span * self.normals
        self._order = neighbours_first(vertices)
        self._rays = rays
        self._reached: I32 | None = None

    def visibility(self, directions: F32, check: Callable[[], None] = lambda: None) -> U8:
        """(V, N) 1 where a vertex sees the lamp in direction (N, 3)."""
        out = np.zeros((len(self._starts), len(directions)), np.uint8)
        for k, w in enumerate(directions):
            if k % 32 == 0:
                check()
            live = self._order[(self.normals @ w > GRAZING)[self._order]]
            out[live, k] = self._caster.first_faces(self._starts[live], np.broadcast_to(w, (len(live), 3))) < 0
        return out

    def direct(self, seen: U8, directions: F32, flux: F32) -> F64:
        """(V, 3) D for seen (V, N), directions (N, 3), flux (N, 3)."""
        return np.asarray((seen * np.maximum(self.normals @ directions.T.astype(np.float64), 0)) @ flux)

    def indirect(self, direct: F64, albedo: F64) -> F64:
        """(V, 3) I for direct (V, 3), albedo (V, 3)."""
        reached = self._bounce_rays()
        hit = reached >= 0
        target = np.where(hit, reached, 0)
        total, now = np.zeros_like(direct), direct
        for _ in range(BOUNCES):
            leaving = (now * albedo)[self.faces].mean(1)  # radiosity of each triangle
            now = np.stack([(leaving[target, i] * hit).mean(1) for i in range(3)], -1)
            total += now
        return total

    def _bounce_rays(self) -> I32:
        """(V, rays) triangle that each cosine-distributed ray hits, -1 for none."""
        if self._reached is None:
            i = np.arange(self._rays) + 0.5
            radius, turn = np.sqrt(i / self._rays), i * np.pi * (3 - np.sqrt(5))
            n = self.normals
            across = np.cross(n, np.eye(3)[np.abs(n).argmin(1)])
            across /= np.linalg.norm(across, axis=1, keepdims=True)
            along = np.cross(n, across)
            out = np.empty((len(n), self._rays), np.int32)
            for j in range(self._rays):
                x, y = radius[j] * np.cos(turn[j]), radius[j] * np.sin(turn[j])
                w = x * across + y * along + np.sqrt(1 - radius[j] ** 2) * n
                out[self._order, j] = self._caster.first_faces(self._starts[self._order], w[self._order])
            self._reached = out
        return self._reached


def occlusion(transport: Transport, lit: Lamps, unblocked: F64, albedo: F64, check: Callable[[], None]) -> F64:
    """(V, 3) irradiance with shadows and interreflections over that of the closed form: (D + I) / E.

    unblocked (V, 3): E(n) of the closed form. albedo (V, 3): as fitted. The true albedo is a = albedo / occlusion, on
    which I depends, so occlusion is a fixed point; it is found in ROUNDS steps.
    """
    direct = transport.direct(transport.visibility(lit.directions, check), lit.directions, lit.flux)
    floor = 0.02 * float(unblocked.mean())  # where there is almost no light, the ratio is meaningless
    share, true = np.ones_like(direct), albedo
    for _ in range(ROUNDS):
        share = ((direct + transport.indirect(direct, true) + floor) / (np.maximum(unblocked, 0) + floor)).clip(
            DARKEST, 1.0 / BRIGHTEST_ALBEDO
        )
        true = np.minimum(albedo / share, BRIGHTEST_ALBEDO)
    return share
