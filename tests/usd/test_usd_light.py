"""The environment picture shows the light in the right places and keeps its energy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from support.synthetic_asset import smooth_light

from pipeline.errors import StageError
from pipeline.lighting.dome import (
    environment,
    environment_figures,
    light_from_environment,
    light_json,
    read_light,
)
from pipeline.maths.latlong import latlong_directions, latlong_weights
from pipeline.maths.sh import sh_basis

AXES = {  # direction: (column, row) of the pixel just right of and below it, as shares of the picture
    (0, 1, 0): (0.5, 0.0),
    (0, -1, 0): (0.5, 1.0),
    (0, 0, 1): (0.5, 0.5),
    (1, 0, 0): (0.25, 0.5),
    (-1, 0, 0): (0.75, 0.5),
    (0, 0, -1): (0.0, 0.5),
}


def radiance(light: np.ndarray, direction: tuple[int, int, int]) -> np.ndarray:
    """The series by scipy's complex harmonics (which have the Condon-Shortley phase)."""
    theta, phi = np.arccos(direction[2]), np.arctan2(direction[1], direction[0])
    total = np.zeros(3)
    for l in range(11):  # noqa: E741
        for m in range(-l, l + 1):
            y = sph_harm_y(l, abs(m), theta, phi) * (-1) ** m
            real = y.real if m == 0 else np.sqrt(2) * (y.real if m > 0 else y.imag)
            total += light[l * (l + 1) + m] * real
    return total


@pytest.mark.parametrize("direction", AXES)
def test_axes_are_where_usd_looks_for_them(direction: tuple[int, int, int]) -> None:
    light = smooth_light()
    image = environment(light, 512)
    column, row = AXES[direction]
    found = image[min(int(row * 256), 255), min(int(column * 512), 511)]
    np.testing.assert_allclose(found, radiance(light, direction), rtol=0.01)


def test_columns_grow_towards_minus_x_and_rows_down() -> None:
    directions = latlong_directions(64, 32)
    assert directions[16, 40, 0] < directions[16, 36, 0] < 0  # right of the centre: -X
    assert directions[0, 0, 1] > 0.99 > -0.99 > directions[-1, 0, 1]
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    assert (latlong_weights(64, 32) * np.ones((32, 64))).sum() == pytest.approx(4 * np.pi)


def test_clamped_picture_keeps_the_energy() -> None:
    light = np.zeros((121, 3), np.float32)
    light[0] = [1, 2, 0.5]
    light[3] = [2, 2, 2]  # along x: negative on the other side
    image = environment(light, 256)
    assert image.min() == 0
    total = (image * latlong_weights(256, 128)[..., None]).sum((0, 1))
    np.testing.assert_allclose(total, light[0] * np.sqrt(4 * np.pi), rtol=1e-4)


def test_dark_light_gives_a_black_picture() -> None:
    assert environment(np.zeros((121, 3), np.float32), 64).max() == 0


def test_a_picture_gives_its_coefficients_back() -> None:
    light = smooth_light()
    np.testing.assert_allclose(light_from_environment(environment(light, 256)), light, atol=2e-3)


def test_light_files_round_trip(tmp_path: Path) -> None:
    light = smooth_light()
    (tmp_path / "light.json").write_text(light_json(light, "exact"))
    np.save(tmp_path / "light.npy", light)
    np.savez(tmp_path / "light.npz", light=light)
    for name in ("light.json", "light.npy", "light.npz"):
        np.testing.assert_allclose(read_light(tmp_path / name), light, rtol=1e-7)


@pytest.mark.parametrize(
    "name, content", [("light.json", b"{"), ("light.json", b"{}"), ("light.npz", b"PK"), ("light.npz", None)]
)
def test_unreadable_lights(tmp_path: Path, name: str, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(StageError, match="light can't be used"):
        read_light(tmp_path / name)


def test_the_dome_is_positive_and_lights_surfaces_as_the_raw_light_does() -> None:
    """A bright lamp at order 10 rings to below zero; irradiance by summing over the picture's pixels."""
    lamp = np.zeros((64, 128, 3), np.float32)
    lamp[18:24, 40:50] = [40, 36, 30]
    light = light_from_environment(lamp + 0.2)
    image = environment(light, 256)
    assert image.min() >= 0
    directions, weights = latlong_directions(256, 128), latlong_weights(256, 128)
    raw = (sh_basis(torch.from_numpy(directions.reshape(-1, 3)), 10).numpy() @ light).reshape(128, 256, 3)
    assert raw.min() < -0.3
    np.testing.assert_allclose(
        (image * weights[..., None]).sum((0, 1)), (raw * weights[..., None]).sum((0, 1)), rtol=1e-4
    )
    n = latlong_directions(12, 6).reshape(-1, 3)
    cosine = np.maximum(np.einsum("ni,hwi->nhw", n, directions), 0)
    found, wanted = (np.einsum("nhw,hwc,h->nc", cosine, x, weights[:, 0]) for x in (image, raw))
    assert np.abs(found - wanted).max() < 0.02 * wanted.mean()
    cut = raw.clip(min=0)
    cut *= (raw * weights[..., None]).sum((0, 1)) / (cut * weights[..., None]).sum((0, 1))
    scaled = np.einsum("nhw,hwc,h->nc", cosine, cut, weights[:, 0])
    assert np.abs(scaled - wanted).max() > 5 * np.abs(found - wanted).max()  # what cutting alone would do
    assert image.max() < 1.3 * raw.max()


def test_a_light_that_no_picture_can_have_keeps_its_irradiance() -> None:
    """A window fitted with bands 3 and 4 that no positive picture has: those go, and surfaces are lit as they were."""
    light = np.zeros((121, 3), np.float32)
    light[[0, 3, 8]] = np.array([1.0, 0.9, 0.4])[:, None]  # from +x
    light[[15, 24]] = np.array([-0.6, 0.9])[:, None]
    image = environment(light, 128)
    figures = environment_figures(light, image)
    assert figures["light_negative_share"] > 0.15 and image.min() >= 0
    assert figures["light_irradiance_error"] < 0.1  # .47 if all bands count alike
    kept = light_from_environment(image)
    np.testing.assert_allclose(kept[:9], light[:9], atol=0.06)


def test_the_figures_of_a_light_by_hand() -> None:
    """L = 1 + 1.2 z: the energies above and below 0 are as 2.2^2 to 0.2^2, the peak is 2.2, and E(n) > 0 everywhere."""
    z = latlong_directions(256, 128)[..., 1:2]
    light = light_from_environment(np.repeat(1 + 1.2 * z, 3, -1).astype(np.float32))
    image = environment(light, 128)
    figures = environment_figures(light, image)
    assert figures["light_negative_share"] == pytest.approx((0.2 / 2.2) ** 2, rel=0.02)
    assert figures["light_peak_ratio"] == pytest.approx(image.max() / 2.2, rel=0.01)
    assert figures["light_irradiance_error"] < 0.02


@pytest.mark.parametrize(("level", "share"), [(-1.0, 1.0), (-1e-6, 1.0), (0.0, 0.0), (1.0, 0.0)])
def test_the_figures_stay_figures_at_the_extremes(level: float, share: float) -> None:
    """A light that is nowhere positive, or dark: a broken fit must not fill the report with powers of ten."""
    light = light_from_environment(np.full((16, 32, 3), level, np.float32))
    figures = environment_figures(light, environment(light, 64))
    assert figures["light_negative_share"] == pytest.approx(share, abs=1e-4)
    assert figures["light_peak_ratio"] == pytest.approx(1.0 if level > 0 else 0.0, abs=0.02)
    assert figures["light_irradiance_error"] == pytest.approx(share, abs=0.02)
