"""The made lights against closed forms and against a quadrature on another grid."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.colour import LUMA
from pipeline.maths import studio_lights
from pipeline.maths.latlong import latlong_directions, latlong_weights
from pipeline.maths.studio_lights import LIGHTS, Lamp, overcast, picture


def even_directions(count: int = 400_000) -> np.ndarray:
    """(count, 3) points of equal solid angle on a spiral [Fibonacci]: shares nothing with the lat-long grid."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1)


def test_the_grid_is_usd_s_and_covers_the_sphere() -> None:
    directions, weights = latlong_directions(64, 32), latlong_weights(64, 32)
    assert weights.sum() * 64 == pytest.approx(4 * np.pi)
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1)
    assert directions[15:17, 31:33].mean((0, 1)) == pytest.approx([0, 0, 1], abs=0.01)  # the centre looks along +Z
    assert directions[0, 0, 1] > 0.99
    assert directions[16, 48] @ [-1, 0, 0] > 0.99  # columns grow towards -X


@pytest.mark.parametrize("name", LIGHTS)
def test_white_that_faces_the_front_is_white(name: str) -> None:
    """Within 2 %: the pictures are as coarse as the viewer's."""
    image, directions = picture(name, 128), latlong_directions(128, 64)
    found = (image @ np.array(LUMA) * latlong_weights(128, 64) * directions[..., 2].clip(0)).sum() / np.pi
    assert found == pytest.approx(1, rel=0.02)
    d = even_directions()
    exact = (LIGHTS[name](d) @ np.array(LUMA) * d[:, 2].clip(0)).mean() * 4
    assert studio_lights.facing_luminance(name) == pytest.approx(exact, rel=2e-3)


@pytest.mark.parametrize("width", [2, 4, 128])
@pytest.mark.parametrize("name", LIGHTS)
def test_pictures_are_finite_and_positive(name: str, width: int) -> None:
    image = picture(name, width)
    assert image.shape == (width // 2, width, 3) and image.dtype == np.float32
    assert np.isfinite(image).all() and (image > 0).all()
    assert image.max() < 65504  # a half float holds it


def test_the_overcast_sky_has_its_irradiance() -> None:
    """[Moon and Spencer 1942]: 7 pi / 9 from above; the ground sends its reflectance of that back."""
    d = even_directions()
    from_above = (overcast(d)[:, 0] * d[:, 1].clip(0)).mean() * 4 * np.pi
    from_below = (overcast(d)[:, 0] * (-d[:, 1]).clip(0)).mean() * 4 * np.pi
    assert from_above == pytest.approx(7 * np.pi / 9, rel=1e-3)
    assert from_below == pytest.approx(studio_lights.GROUND * from_above, rel=1e-3)


@pytest.mark.parametrize("concentration", [0.01, 6, 400])
def test_a_lamp_has_its_flux_and_its_axis(concentration: float) -> None:
    lamp = Lamp(30, 20, concentration, (1, 2, 4))
    d = even_directions()
    value = lamp.radiance(d)
    flux = 2 * np.pi * (1 - np.exp(-2 * concentration)) / concentration
    assert value.mean(0) * 4 * np.pi == pytest.approx(flux * np.array([1, 2, 4]), rel=1e-3)
    x, y, z = d[value[:, 0].argmax()]
    assert concentration < 1 or np.degrees([np.arctan2(x, z), np.arcsin(y)]) == pytest.approx([30, 20], abs=1)
