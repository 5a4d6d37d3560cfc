"""Polarised pairs as the bake reads them: the mirror reflection at every vertex that both photos of a pair show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.images import write_exr, write_png
from pipeline.meshes import F64, Mesh
from pipeline.visibility import FittedPhoto
from stages.bake import detail_kernels as kernels
from stages.bake import detail_views
from stages.bake.standard_observe import _mirrors
from tests.bake.test_bake_moving_light import PIXELS, RADIUS, camera, photograph

SHINE = np.float32([0.06, 0.05, 0.04])


@pytest.fixture(scope="module")
def ball() -> Mesh:
    made = trimesh.creation.icosphere(4, RADIUS)
    return Mesh(*(np.asarray(a, np.float32) for a in (made.vertices, made.vertex_normals)), made.faces.astype(np.int32))


def views(folder: Path, exposure: float) -> list[FittedPhoto]:
    """Four pairs: X, and P = X + 2 SHINE (in the unit of X the mirror reflection is SHINE). The last has no pair, the
    third's parallel photo is clipped in its left half."""
    out = []
    for i in range(4):
        cross = photograph(camera(i))
        write_exr(folder / f"x{i}.exr", cross)
        write_exr(folder / f"p{i}.exr", (cross + 2 * SHINE * (cross > 0)) * np.float32(exposure))
        ends = np.zeros((PIXELS, PIXELS), np.float32)
        ends[:, : PIXELS // 2] = 1
        write_png(folder / "ends.png", ends)
        pair = {"parallel": folder / f"p{i}.exr", "parallel_exposure": exposure} if i < 3 else {}
        clipped = {"parallel_clipped": folder / "ends.png"} if i == 2 else {}
        out.append(FittedPhoto(camera(i), None, folder / f"x{i}.exr", **pair, **clipped))
    return out


@pytest.mark.parametrize("exposure", [1.0, 0.5])
def test_the_mirror_reflection_at_the_vertices(ball: Mesh, tmp_path: Path, exposure: float) -> None:
    """Under colour responses that differ from photo to photo, which are taken out of both photos of a pair."""
    gains = np.array([1.0, 1.3, 0.8, 1.0])
    responses = gains[:, None, None] * np.eye(3)
    photos = detail_views.read_photos(views(tmp_path, exposure), responses, ball, 1e-4, lambda *_: None)
    assert photos.parallel is not None and photos.parallel.peaks[3] == 0
    x, n = ball.vertices.astype(np.float64), ball.normals.astype(np.float64)
    cross: F64 = np.zeros((4, len(x), 3))
    cosines = np.zeros((4, len(x)))
    kernels.observed(photos.cameras, photos.pixels, photos.depth, photos.clipped, x, n, cross, cosines)
    found = _mirrors(photos, x, n, cross)
    assert found is not None
    for i in range(3):
        seen = (cosines[i] > 0.5) & np.isfinite(found[i]).all(1)
        np.testing.assert_allclose(np.median(found[i][seen], 0), SHINE / gains[i], rtol=0.01)
        assert np.abs(found[i][seen] - SHINE / gains[i]).max() < 0.01
    assert np.isnan(found[3]).all()
    whole, half = (np.isfinite(found[i]).all(1).sum() / (cosines[i] > 0).sum() for i in (0, 2))
    assert whole == 1 and 0.3 < half < 0.7


def test_photos_without_pairs(ball: Mesh, tmp_path: Path) -> None:
    made = [FittedPhoto(v.camera, None, v.photo) for v in views(tmp_path, 1.0)]
    photos = detail_views.read_photos(made, np.tile(np.eye(3), (4, 1, 1)), ball, 1e-4, lambda *_: None)
    x, n = ball.vertices.astype(np.float64), ball.normals.astype(np.float64)
    assert photos.parallel is None and _mirrors(photos, x, n, np.zeros((4, len(x), 3))) is None
