"""Standard shaders under a moving light, against the still renderer and a point lamp's closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.lighting import standard
from pipeline.lighting.moving import FRONT, MovingLight, Standpoint
from pipeline.lighting.moving_standard import MovingLamps
from pipeline.maths import sh
from pipeline.maths.light_frame import CAMERA, FLASH

RNG = np.random.default_rng(6)
DARK = np.zeros((4, 3), np.float32)


def soft_lamp(direction: tuple[float, float, float], blur: float = 0.05) -> np.ndarray:
    """SH of order 10 of a lamp of flux 1, blurred so that it is positive."""
    d = torch.tensor([direction], dtype=torch.float64)
    degree = np.sqrt(np.arange(121)).astype(int)
    c = sh.sh_basis(d / d.norm(), 10).numpy()[0] * np.exp(-degree * (degree + 1) * blur)
    return np.repeat(c[:, None], 3, 1).astype(np.float32)


def points(count: int) -> tuple[np.ndarray, np.ndarray]:
    n = RNG.normal(size=(count, 3)).astype(np.float32)
    n[:, 2] = np.abs(n[:, 2]) + 0.3
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return 0.05 * n, n


EYE = Standpoint(np.array([0.05, 0.1, 0.8]), FRONT)


@pytest.mark.parametrize("ambient", [False, True])
def test_in_a_still_frame_it_is_the_still_renderer(ambient: bool) -> None:
    """Axes of the world: the moving part is an ordinary dome; so is the ambient one."""
    coefficients = soft_lamp((0.3, 0.5, 1.0))
    x, n = points(200)
    world = Standpoint(EYE.centre, np.eye(3))
    light = MovingLight(CAMERA, 1.0, DARK if ambient else coefficients, coefficients if ambient else DARK)
    moving = MovingLamps(light)
    base, f0, rough = np.full((200, 3), 0.4, np.float32), np.full(200, 0.05, np.float32), np.full(200, 0.4, np.float32)
    found = moving.radiance(x, n, world, base, f0, rough)
    from pipeline.lighting.dome import environment
    from pipeline.lighting.median_cut import lamps

    lit = lamps(environment(coefficients, 256), 384)
    at = standard.Arrivals(
        np.repeat(lit.flux[None], 200, 0), standard.table(lit),
        np.zeros((200, 3), np.float32),
    )  # fmt: skip
    corner = np.tile(np.arange(200, dtype=np.int32)[:, None], (1, 3))
    third = np.full((200, 3), 1 / 3, np.float32)
    wo = world.centre - x
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    diffuse, specular = standard.radiance(at, corner, third, n.astype(np.float64), wo, base, f0, rough)
    np.testing.assert_allclose(found, diffuse + specular, atol=0.03 * (diffuse + specular).max())


def test_lobes_are_the_layer_without_its_base() -> None:
    x, n = points(50)
    moving = MovingLamps(MovingLight(FLASH, 0.8, soft_lamp((0, 0, -1)), DARK))
    lobes = moving.lobes(x, n, EYE, np.array([0.16], np.float32))[:, 0]
    black, f0 = np.zeros((50, 3), np.float32), np.full(50, 0.04, np.float32)
    shown = moving.radiance(x, n, EYE, black, f0, np.full(50, 0.4, np.float32))
    np.testing.assert_allclose(0.04 * lobes[:, 0] + lobes[:, 1], shown, rtol=1e-3, atol=1e-5)


def test_a_flash_shines_back_where_the_surface_faces_it() -> None:
    """GGX at l = v = n: F0 D V n.l E = F0 / (4 pi alpha^2) of a narrow lamp, for a lobe much wider than the lamp."""
    x, n = np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32)
    light = MovingLight(FLASH, 0.8, soft_lamp((0, 0, -1), blur=0.012), DARK)
    moving, eye = MovingLamps(light), Standpoint(np.array([0, 0, 1.6]), FRONT)
    f0, rough = np.array([0.05], np.float32), np.array([0.85], np.float32)
    got = moving.radiance(x, n, eye, np.zeros((1, 3), np.float32), f0, rough)[0, 0]
    strength = (0.8 / 1.6) ** 2
    assert got == pytest.approx(strength * 0.05 / (4 * np.pi * 0.85**4), rel=0.12)
    matt = moving.radiance(x, n, eye, np.ones((1, 3), np.float32), 0 * f0, rough)[0, 0]
    assert matt == pytest.approx(strength * 1 / np.pi, rel=0.03)


def test_extremes() -> None:
    """A dark light, a mirror, the roughest layer, F0 of 1, a grazing point."""
    x, n = points(20)
    dark = MovingLamps(MovingLight(FLASH, 0.8, DARK, DARK))
    one = np.ones(20, np.float32)
    assert (dark.radiance(x, n, EYE, np.ones((20, 3), np.float32), 0.5 * one, 0.5 * one) == 0).all()
    lamps = MovingLamps(MovingLight(FLASH, 0.8, soft_lamp((0, 0, -1)), soft_lamp((0, 1, 0), 0.3)[:4]))
    n[0] = [1, 0, 0]
    for f0, rough in ((0.0, 0.001), (1.0, 0.001), (1.0, 1.0)):
        found = lamps.radiance(x, n, EYE, np.ones((20, 3), np.float32), f0 * one, rough * one)
        assert np.isfinite(found).all() and (found >= 0).all()
