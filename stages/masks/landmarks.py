"""3D landmarks of the face, from all fitted photos that show it, as a file of the masks' artifact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.artifacts import Camera, FileRef
from pipeline.contract import Context
from pipeline.faces.find import Face
from pipeline.faces.landmarks3d import Landmarks, triangulate
from stages.masks.region import F32

FILE = "landmarks.npz"


@dataclass(frozen=True, slots=True)
class SeenFace:
    """indices: (N,) photos with a face. uv: (N, 468, 2) landmarks in pixels. face: their triangulation."""

    indices: tuple[int, ...]
    uv: np.typing.NDArray[np.float64]
    face: Landmarks


def agreed(faces: Sequence[tuple[Camera, Face]]) -> SeenFace | None:
    """The face in 3D, or None if fewer than three photos agree."""
    if not faces:
        return None
    uv = np.stack([f.points for _, f in faces])
    found = triangulate([c for c, _ in faces], uv)
    return None if found is None else SeenFace(tuple(c.index for c, _ in faces), uv, found)


def save_landmarks(seen: SeenFace, context: Context) -> FileRef:
    """Write the landmarks; see pipeline.artifacts.MaskSet.landmarks."""
    single: list[F32] = [a.astype(np.float32) for a in (seen.uv, seen.face.error_px)]
    np.savez(
        context.workdir / FILE,
        views=np.array(seen.indices, np.int32),
        uv=single[0],
        xyz=seen.face.xyz,
        error_px=single[1],
        kept=seen.face.kept,
    )
    return context.file(FILE)
