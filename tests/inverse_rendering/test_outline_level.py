"""The level at which a ball has the outline of its masks, which are drawn with another radius."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.fields.face import FaceModel, FittedField, load_model
from pipeline.fields.geometry import GridSdf
from pipeline.fields.spec import FaceSpec
from pipeline.meshes import F64
from pipeline.transforms import rays
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.outline_level import MOST, drawn, outline_level, set_outline_level
from stages.inverse_rendering.ray_sampling import PhotoView

RADIUS, CELL, SIDE, AWAY, FOCAL = 0.08, 0.004, 160, 0.6, 440.0
FINE = 4  # rays along each side of a pixel of the masks


def ball(radius: float = RADIUS, cell: float = CELL) -> GridSdf:
    """A spline is larger than its coefficients by cell^2 / 6 times their Laplacian, 2 / distance from the middle."""
    lo = np.full(3, -0.12, np.float32)
    n = round(0.24 / cell) + 1
    at = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1) * cell + lo
    out = np.maximum(np.linalg.norm(at, axis=-1), cell)
    return Start((out - radius - cell**2 / (3 * out)).astype(np.float32), lo, cell).surface("cpu")


@cache
def away_from_middle(azimuth: float, distortion: tuple[float, ...]) -> tuple[F64, F64, F64]:
    """K and pose of a camera on a circle, and how far FINE x FINE rays of each pixel pass from the middle."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[c, 0, -s], [0, -1, 0], [-s, 0, -c]])
    pose[:3, 3] = AWAY * np.array([s, 0, c])
    K = np.array([[FOCAL, 0, SIDE / 2 + 3], [0, 1.01 * FOCAL, SIDE / 2 - 2], [0, 0, 1]])
    at = (np.arange(SIDE * FINE) + 0.5) / FINE
    uv = np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)
    o, d = rays(K, pose, np.array(distortion), uv)
    return K, pose, np.linalg.norm(np.cross(np.broadcast_to(o, d.shape), d), axis=1)


def photo(azimuth: float, radius: float, distortion: tuple[float, ...]) -> PhotoView:
    """The mask of a ball of this radius."""
    K, pose, off = away_from_middle(azimuth, distortion)
    alpha = (off <= radius).astype(np.float32).reshape(SIDE, FINE, SIDE, FINE).mean((1, 3))
    return PhotoView(0, np.zeros((SIDE, SIDE, 3), np.float32), alpha, K, pose, np.array(distortion))


def photos(radii: Sequence[float], distortion: tuple[float, ...] = (0.0,) * 5) -> list[PhotoView]:
    return [photo(2 * np.pi * i / len(radii), r, distortion) for i, r in enumerate(radii)]


PIXEL = AWAY / FOCAL


@pytest.mark.parametrize("off", [-0.4, 0.0, 0.15, 1.0])
def test_the_level_is_that_of_the_masks(off: float) -> None:
    """off: pixels by which the masks are larger than the surface. To 0.02 pixels."""
    found = outline_level(ball(), photos([RADIUS + off * PIXEL] * 6))
    assert found.found == pytest.approx(off * PIXEL, abs=0.02 * PIXEL)
    assert found.views == 6 and found.tiles > 60
    assert found.level == pytest.approx(drawn(found.found, found.deviation), abs=1e-12)


def test_a_lens_with_distortion_changes_nothing() -> None:
    found = outline_level(ball(), photos([RADIUS + 0.3 * PIXEL] * 5, (0.08, -0.02, 0.001, -0.001, 0.0)))
    assert found.found == pytest.approx(0.3 * PIXEL, abs=0.03 * PIXEL)


def test_wrong_masks_move_little() -> None:
    """One mask of seven is two pixels too large; in each, a quarter of the outline is three pixels off."""
    views = photos([RADIUS + 0.2 * PIXEL] * 6 + [RADIUS + 2 * PIXEL])
    for view in views:
        moved = np.roll(view.alpha, (3, -3), (0, 1))
        view.alpha[SIDE // 2 :, : SIDE // 2] = np.maximum(view.alpha, moved)[SIDE // 2 :, : SIDE // 2]
    assert outline_level(ball(), views).found == pytest.approx(0.2 * PIXEL, abs=0.1 * PIXEL)


def test_what_does_not_count_moves_nothing() -> None:
    """Most of each outline is a pixel off: not asked, doubtful, or asked as if it were right."""
    views = photos([RADIUS + 0.2 * PIXEL] * 6)
    wrong = np.zeros((SIDE, SIDE), bool)
    wrong[:, : 2 * SIDE // 3] = True
    for view, larger in zip(views, photos([RADIUS + 1.2 * PIXEL] * 6), strict=True):
        view.alpha[wrong] = larger.alpha[wrong]
    unasked = [replace(v, asked=1 - wrong.astype(np.float32)) for v in views]
    doubtful = [replace(v, doubtful=wrong) for v in views]
    for left in (unasked, doubtful):
        assert outline_level(ball(), left).found == pytest.approx(0.2 * PIXEL, abs=0.04 * PIXEL)
    assert outline_level(ball(), views).found > 0.8 * PIXEL


def test_photos_that_contradict_each_other_move_nothing() -> None:
    contrary = photos([RADIUS + x * PIXEL for x in (-2, 2, -1.5, 1.6, -1, 1.1)])
    assert abs(outline_level(ball(), contrary).level) < 0.03 * PIXEL


def test_without_an_outline_it_is_0_and_it_is_never_large() -> None:
    full = [replace(v, alpha=np.ones_like(v.alpha)) for v in photos([RADIUS] * 4)]
    assert outline_level(ball(), full).level == 0 and outline_level(ball(), []).level == 0
    assert outline_level(ball(), photos([RADIUS + PIXEL] * 2)).level == 0  # two photos
    grown = outline_level(ball(0.078, 0.001), photos([RADIUS] * 4))
    assert grown.level == pytest.approx(MOST * 0.001)


def test_what_may_be_chance_is_drawn_to_0() -> None:
    assert drawn(0.0, 0.0) == 0 and drawn(1e-4, 0.0) == 1e-4
    assert drawn(1e-4, 2e-4) == 0 and drawn(-2.0, 1.0) == pytest.approx(-1.5)


def test_the_stages_after_the_fit_see_the_surface_at_the_level(tmp_path: Path) -> None:
    model = FaceModel(
        FaceSpec(lo=(-0.12,) * 3, hi=(0.12,) * 3, views=1, light_order=2, hash_levels=2, hash_log2_size=8), ball()
    )
    points: NDArray[np.float32] = np.random.default_rng(0).normal(0, 0.03, (50, 3)).astype(np.float32)
    before = FittedField(model).sdf(points)
    model.level.fill_(2e-4)
    assert np.allclose(FittedField(model).sdf(points), before - 2e-4, atol=1e-8)
    model.save(tmp_path / "field.npz")
    assert float(load_model(tmp_path / "field.npz").level) == pytest.approx(2e-4)
    arrays = dict(np.load(tmp_path / "field.npz"))
    del arrays["level"]  # a file from before there was one
    np.savez(tmp_path / "old.npz", **arrays)
    assert float(load_model(tmp_path / "old.npz").level) == 0
    facts = set_outline_level(model, photos([RADIUS] * 3))
    assert set(facts) == {"level_mm", "found_mm", "deviation_mm", "views", "why"}
