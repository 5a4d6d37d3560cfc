"""Two lights from one albedo: irradiances by quadrature, wrong lights to begin with, and what tells nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.maths import sh
from pipeline.transforms import F64
from stages.inverse_rendering.two_lights import MIN_POINTS, Shown, agree

KNOTS = sh.spiral(20_000)  # directions of equal solid angle


def light(seed: int) -> F64:
    """(9, 3) positive coefficients with clear bands 1 and 2."""
    c = np.random.default_rng(seed).normal(0, 0.5, (9, 3))
    c[0] = 4 + np.arange(3)
    return np.asarray(c, np.float64)


def irradiance(n: F64, c: F64) -> F64:
    """(P, 3) by quadrature over the hemisphere."""
    radiance = sh.sh_basis(torch.from_numpy(KNOTS), 2).numpy() @ c
    return np.asarray(np.maximum(n @ KNOTS.T, 0) @ radiance * (4 * np.pi / len(KNOTS)), np.float64)


def scene(first: F64, second: F64, start: tuple[F64, F64], noise: float = 0.0) -> tuple[F64, Shown, Shown]:
    """A Lambertian surface with shadows; start: the lights that are believed."""
    rng = np.random.default_rng(1)
    n = sh.spiral(2000)
    albedo = rng.uniform(0.1, 0.8, (2000, 3)) * (1 + 0.3 * n[:, :1])  # it changes with the normal
    out = []
    for true, believed in zip((first, second), start, strict=True):
        shadow = rng.uniform(0.6, 1.0, (2000, 3))
        total = albedo / np.pi * shadow * irradiance(n, true) * np.exp(noise * rng.normal(size=(2000, 3)))
        out.append(Shown(total, np.zeros((2000, 9)), shadow, believed))
    return n, out[0], out[1]


def shape(c: F64) -> F64:
    """The coefficients over the first: the level is not told."""
    return np.asarray(c[1:] / c[0], np.float64)


def wrong(true: F64, seed: int) -> F64:
    out = np.array(true)
    out[1:] += np.random.default_rng(seed).normal(0, 0.2, (8, 3))
    return out


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_both_lights_are_found_although_the_albedo_changes_with_the_normal(noise: float) -> None:
    first, second = light(0), light(5)
    begun = wrong(first, 2), wrong(second, 3)
    found = agree(*scene(first, second, begun, noise))
    assert found is not None and found.after < 0.5 * found.before
    for got, true, before in ((found.first, first, begun[0]), (found.second, second, begun[1])):
        was, now = (float(np.sqrt(((shape(c) - shape(true)) ** 2).mean())) for c in (before, got))
        assert now < (0.1 if noise == 0 else 0.75) * was
    level = found.second[0] / found.first[0]
    assert np.allclose(level, second[0] / first[0], rtol=0.02)  # the lights' ratio is told, in each colour


@pytest.mark.parametrize("level", [1.0, 3.0])
def test_the_level_and_the_colour_of_the_albedo_stay(level: float) -> None:
    """Places that face one way, where lights from the side change the mean: the mean of ln albedo is that before, in
    each colour, whatever the level of the lights that are believed."""
    first, second = light(0), light(5)
    begun = level * wrong(first, 2), wrong(second, 3)
    n, a, b = scene(first, second, begun)
    front = n[:, 2] > 0.2
    a, b = (replace(s, total=s.total[front], glow=s.glow[front], shadow=s.shadow[front]) for s in (a, b))
    found = agree(n[front], a, b)
    assert found is not None
    before, after = (np.log(a.total / (a.shadow * irradiance(n[front], c))).mean(0) for c in (begun[0], found.first))
    assert np.allclose(before, after, atol=2e-3)
    other = np.log(a.total / (a.shadow * irradiance(n[front], found.first * begun[0][0] / found.first[0]))).mean(0)
    assert np.abs(other - before).max() > 0.02
    assert np.allclose(found.second[0] / found.first[0], second[0] / first[0], rtol=0.05)


def test_lights_that_are_right_stay() -> None:
    first, second = light(0), light(5)
    found = agree(*scene(first, second, (first, second), 0.01))
    if found is not None:
        assert np.abs(shape(found.first) - shape(first)).max() < 0.02


def test_one_light_twice_tells_nothing_and_keeps_the_first_near_its_prior() -> None:
    true = light(0)
    begun = wrong(true, 2)
    found = agree(*scene(true, true, (begun, begun)))
    if found is not None:
        assert np.abs(shape(found.first) - shape(begun)).max() < 0.05


def test_dark_and_unseen_places_are_left_out() -> None:
    first, second = light(0), light(5)
    n, a, b = scene(first, second, (wrong(first, 2), wrong(second, 3)))
    a.total[::3] = np.nan
    b.total[1::7] = 0.0
    found = agree(n, a, b)
    assert found is not None and np.abs(shape(found.first) - shape(first)).max() < 0.02
    a.total[MIN_POINTS - 1 :] = np.nan
    assert agree(n, a, b) is None
