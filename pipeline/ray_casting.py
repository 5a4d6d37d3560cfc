"""Ray casting against one triangle mesh, by Embree in single precision."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
EMBREE_SIZE = 100.0  # Embree has absolute tolerances: the mesh is scaled to about this size


class RayCaster:
    """First hits of rays with a mesh: vertices (V, 3) in any unit, faces (F, 3). span: longest side of its box."""

    def __init__(self, vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.span = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
        self._scale = EMBREE_SIZE / self.span
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, (vertices * self._scale).astype(np.float32), faces)

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
        starts = np.ascontiguousarray(origins * self._scale, np.float32)
        return self._scene.run(starts, np.ascontiguousarray(directions, np.float32), output=output)
