"""Light that is blocked by the head itself, and light that the head throws back onto itself.

Symbols (all at the mesh's vertices)
    w_k, E_k  lamps: direction towards, irradiance on a facing surface
    V_k       1 where lamp k is seen, 0 where the head is in the way
    D         sum_k V_k E_k max(n . w_k, 0), direct irradiance
    T         share of the cosine-weighted hemisphere that ends on a place of the head
    I         T (a D) + T (a T (a D)) + ..., what arrives by way of other places, a = albedo there

The photos have both effects and NeuFace's closed form has neither: it puts them into the albedo. `occlusion` is what
it put there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from stages.usd.render.median_cut import Lamps

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
I32 = npt.NDArray[np.int32]

EMBREE_SIZE = 100.0  # embree has absolute tolerances: the mesh is scaled to about this size
LIFT = 1e-3  # of the head's size: rays start this far above the surface, so that facets do not shade themselves
BOUNCES, BOUNCE_RAYS = 4, 96
GRAZING = -0.2  # lamps further behind a vertex than this can't reach its triangles' interpolated normals
DARKEST = 0.25  # occlusion below this is not divided out: nostrils and mouths would glow
BRIGHTEST_ALBEDO = 0.95
ROUNDS = 6


class Transport:
    """Ray casting between the vertices of one mesh. vertices, normals (V, 3); faces (F, 3)."""

    def __init__(self, vertices: F32, normals: F32, faces: I32, rays: int = BOUNCE_RAYS) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.faces = faces
        n = normals.astype(np.float64)
        self.normals = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
        span = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
        scale = EMBREE_SIZE / span
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, (vertices * scale).astype(np.float32), faces)
        self._starts = np.ascontiguousarray((vertices + LIFT * span * self.normals) * scale, np.float32)
        self._rays = rays
        self._reached: I32 | None = None

    def visibility(self, directions: F32, check: Callable[[], None] = lambda: None) -> U8:
        """(V, N) 1 where a vertex sees the lamp in each direction (N, 3)."""
        out = np.zeros((len(self._starts), len(directions)), np.uint8)
        for k, w in enumerate(directions):
            if k % 32 == 0:
                check()
            live = np.flatnonzero(self.normals @ w > GRAZING)
            out[live, k] = self._first(self._starts[live], np.broadcast_to(w, (len(live), 3))) < 0
        return out

    def direct(self, seen: U8, directions: F32, flux: F32) -> F64:
        """(V, 3) D."""
        return np.asarray((seen * np.maximum(self.normals @ directions.T.astype(np.float64), 0)) @ flux)

    def indirect(self, direct: F64, albedo: F64) -> F64:
        """(V, 3) I for albedo (V, 3)."""
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
        """(V, rays) the triangle that each cosine-distributed ray ends on, -1 for none."""
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
                out[:, j] = self._first(self._starts, w)
            self._reached = out
        return self._reached

    def _first(self, starts: F32, directions: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
        return np.asarray(self._scene.run(starts, np.ascontiguousarray(directions, np.float32)), np.int64)


def occlusion(transport: Transport, lit: Lamps, unblocked: F64, albedo: F64, check: Callable[[], None]) -> F64:
    """(V, 3) what share of the light that the closed form assumes does arrive: (D + I) / E.

    unblocked (V, 3): E(n) of the closed form. albedo (V, 3): as fitted, so that a = albedo / occlusion is what the
    light is thrown back by. That makes it a fixed point, found in ROUNDS steps.
    """
    direct = transport.direct(transport.visibility(lit.directions, check), lit.directions, lit.flux)
    floor = 0.02 * float(unblocked.mean())  # where there is no light to speak of, the share means nothing
    share, true = np.ones_like(direct), albedo
    for _ in range(ROUNDS):
        share = ((direct + transport.indirect(direct, true) + floor) / (np.maximum(unblocked, 0) + floor)).clip(
            DARKEST, 1.0 / BRIGHTEST_ALBEDO
        )
        true = np.minimum(albedo / share, BRIGHTEST_ALBEDO)
    return share
