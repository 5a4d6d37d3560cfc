"""Ray casting against one triangle mesh, by Embree in single precision."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from hashlib import blake2b
from threading import Lock
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt

from pipeline import threads

F64 = npt.NDArray[np.float64]
EMBREE_SIZE = 100.0  # Embree has absolute tolerances: the mesh is scaled to about this size
SHARE = 8192  # rays that are worth a thread
CURVE_BITS = 10  # of each coordinate: cells of a thousandth of the points' box


def neighbours_first(points: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
    """(N,) order of points (N, 3) along a Z-order curve (Morton's) through their box. Rays that begin beside each other
    visit the same parts of Embree's tree: in this order those of a mesh's vertices take a quarter less time, with the
    same results."""
    span = max(float(np.ptp(points, axis=0).max()), 1e-30) if len(points) else 1.0
    cell = ((points - points.min(0, initial=np.inf)) / span * (2**CURVE_BITS - 1)).astype(np.uint32)
    code = np.zeros(len(points), np.uint32)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


class RayCaster:
    """First hits of rays with a mesh: vertices (V, 3) in any unit, faces (F, 3). span: longest side of its box."""

    def __init__(self, vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> None:
        self.span = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
        self._scale = EMBREE_SIZE / self.span
        self._scene = _scene_of((vertices * self._scale).astype(np.float32), np.asarray(faces))

    def first_faces(
        self, origins: npt.NDArray[np.floating], directions: npt.NDArray[np.floating]
    ) -> npt.NDArray[np.int64]:
        """(N,) first face on the ray from each origin (N, 3) along its direction (N, 3), -1 for none."""
        return np.asarray(self._run(origins, directions), np.int64)

    def hits(self, origins: F64, directions: F64) -> tuple[F64, npt.NDArray[np.int64]]:
        """(N,) distance and (N,) face of the first hit from each origin (N, 3) along its unit direction (N, 3);
        infinite and -1 for none."""
        found = self._run(origins, directions, output=True)
        far = np.where(found["primID"] >= 0, found["tfar"].astype(np.float64) / self._scale, np.inf)
        return far, np.where(np.isfinite(far), found["primID"].astype(np.int64), -1)

    def distances(self, origins: F64, directions: F64) -> F64:
        """(N,) distance to the mesh from each origin (N, 3) along its unit direction (N, 3), infinite for no hit."""
        return self.hits(origins, directions)[0]

    def _run(
        self, origins: npt.NDArray[np.floating], directions: npt.NDArray[np.floating], output: bool = False
    ) -> Any:
        """In as many threads as compiled loops have. A ray's result does not depend on the rays beside it."""
        parts = min(threads.of_compiled_loops(), len(origins) // SHARE)
        if parts < 2:
            return self._cast(origins, directions, output)
        with ThreadPoolExecutor(parts) as pool:
            pairs = (np.array_split(x, parts) for x in (origins, directions))
            found = list(pool.map(lambda o, d: self._cast(o, d, output), *pairs))
        if not output:
            return np.concatenate(found)
        return {key: np.concatenate([f[key] for f in found]) for key in ("primID", "tfar")}

    def _cast(self, origins: npt.NDArray[np.floating], directions: npt.NDArray[np.floating], output: bool) -> Any:
        starts = np.ascontiguousarray(origins * self._scale, np.float32)
        return self._scene.tree.run(starts, np.ascontiguousarray(directions, np.float32), output=output)


class _Scene:
    """Embree's tree over triangles: vertices (V, 3) and faces (F, 3) in its own unit."""

    def __init__(self, vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.integer]) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.tree = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self.tree, vertices, faces)
        self.tree.run(np.zeros((1, 3), np.float32), np.eye(3, dtype=np.float32)[:1])  # builds it: not in two threads


_SCENES: WeakValueDictionary[bytes, _Scene] = WeakValueDictionary()
_BUILDING = Lock()


def _scene_of(vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.integer]) -> _Scene:
    """The scene of a mesh; the one that another caster of an equal mesh still holds, because filling one takes Embree's
    wrapper three microseconds a triangle."""
    digest = blake2b(np.ascontiguousarray(vertices).data, digest_size=16)
    digest.update(str((vertices.shape, faces.shape, faces.dtype)).encode())
    digest.update(np.ascontiguousarray(faces).data)
    with _BUILDING:
        found = _SCENES.get(digest.digest())
        if found is None:
            found = _SCENES[digest.digest()] = _Scene(vertices, faces)
    return found
