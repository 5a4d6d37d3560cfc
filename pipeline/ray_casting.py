"""Ray casting against one triangle mesh, by Embree in single precision."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline import threads

F64 = npt.NDArray[np.float64]
EMBREE_SIZE = 100.0  # Embree has absolute tolerances: the mesh is scaled to about this size
SHARE = 8192  # rays that are worth a thread


class RayCaster:
    """First hits of rays with a mesh: vertices (V, 3) in any unit, faces (F, 3). span: longest side of its box."""

    def __init__(self, vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.span = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
        self._scale = EMBREE_SIZE / self.span
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, (vertices * self._scale).astype(np.float32), faces)
        self._cast(np.zeros((1, 3)), np.eye(3)[:1], False)  # builds the tree, which two threads must not do at once

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
        return self._scene.run(starts, np.ascontiguousarray(directions, np.float32), output=output)
