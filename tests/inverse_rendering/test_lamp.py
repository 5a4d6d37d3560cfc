"""The light in closed form: made-up sightings of a ball under a known light, by sums of their own."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy.special import sph_harm_y

from pipeline.fields.appearance import SKIN_F0, TYPICAL_INV_KAPPA
from pipeline.maths import sh
from pipeline.maths.split_sum import alpha_from_inv_kappa
from stages.inverse_rendering.lamp import LEAST_EXPLAINED, light_from_lobe, reflectance
from stages.inverse_rendering.sightings import LEAST_COSINE, Sightings

F64 = npt.NDArray[np.float64]
ORDER = 3
VIEWS, POINTS = 24, 600


def unit(x: F64) -> F64:
    return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))


def harmonics(d: F64, order: int) -> F64:
    """Real orthonormal harmonics without the Condon-Shortley phase, from scipy's complex ones."""
    theta, phi = np.arccos(d[:, 2].clip(-1, 1)), np.arctan2(d[:, 1], d[:, 0])
    out = []
    for band in range(order + 1):
        for m in range(-band, band + 1):
            y = sph_harm_y(band, abs(m), theta, phi) * (-1) ** abs(m)
            out.append(y.real if m == 0 else np.sqrt(2) * (y.imag if m < 0 else y.real))
    return np.stack(out, -1)


def true_light(seed: int = 0, ratio: float = 1.6) -> F64:
    """Coefficients whose band 0 is `ratio` times band 1."""
    c = np.random.default_rng(seed).normal(size=(ORDER + 1) ** 2) * 0.25
    c[1:4] *= 0.8 / np.linalg.norm(c[1:4])
    c[0] = ratio * 0.8
    return c


def sightings(light: F64, noise: float = 0.0, lobe: float = 1.0, spots: float = 0.0, gain: Any = None) -> Sightings:
    """Points all over a ball, each seen by the cameras in front of it. spots: how uneven the albedo is."""
    rng = np.random.default_rng(1)
    n, eyes = unit(rng.normal(size=(POINTS, 3))), unit(rng.normal(size=(VIEWS, 3)))
    cosine = n @ eyes.T
    point, view = np.nonzero(cosine > LEAST_COSINE)
    normal, wo = n[point], eyes[view]
    c = cosine[point, view]
    falls = np.repeat([np.exp(-b * (b + 1) * TYPICAL_INV_KAPPA / 2) for b in range(ORDER + 1)], [1, 3, 5, 7])
    lambdas = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0], [1, 3, 5, 7])
    albedo = 0.4 * np.exp(spots * rng.normal(size=POINTS))
    diffuse = albedo / np.pi * (harmonics(n, ORDER) @ (lambdas * light))
    mirror = 2 * c[:, None] * normal - wo
    shine = lobe * reflectance(c) * (harmonics(mirror, ORDER) @ (falls * light))
    colour = (diffuse[point] + shine)[:, None] * np.ones(3) + noise * rng.normal(size=(len(point), 3))
    if gain is not None:
        colour = colour * gain[view]
    x = torch.from_numpy(0.1 * n)
    return Sightings(x, torch.from_numpy(n), point.astype(np.int64), view.astype(np.int64), colour, wo)


def solved(seen: Sightings, **changes: Any) -> Any:
    return light_from_lobe(
        seen, changes.get("order", ORDER), changes.get("gain", np.ones((VIEWS, 3))), changes.get("kind", "exponential")
    )


def test_a_known_light_is_found_with_its_level() -> None:
    light = true_light()
    lamp = solved(sightings(light))
    assert lamp.explained > 0.99 and lamp.ratio == pytest.approx(1.6, rel=0.04)  # as fine as RATIOS are
    assert np.allclose(lamp.coefficients, light, atol=0.04)


def test_spots_noise_and_gains_do_not_move_it() -> None:
    """Spots drop out exactly; noise as large as half the lobe averages out."""
    light = true_light(3)
    gain = np.random.default_rng(2).uniform(0.8, 1.2, (VIEWS, 3))
    lamp = solved(sightings(light, noise=0.01, spots=0.3, gain=gain), gain=gain)
    shape = np.corrcoef(lamp.coefficients[1:], light[1:])[0, 1]
    assert shape > 0.98 and abs(lamp.coefficients[0] / light[0] - 1) < 0.05


def test_the_band_ratio_comes_from_even_skin() -> None:
    """A lobe half as strong says half the light for bands 1 to 3 and band 0 alike; their ratio is the skin's."""
    light = true_light(ratio=2.4)
    lamp = solved(sightings(light, lobe=0.5))
    assert lamp.ratio == pytest.approx(2.4, rel=0.15) and lamp.coefficients[0] == pytest.approx(
        0.5 * light[0], rel=0.03
    )


def test_nothing_is_made_of_noise() -> None:
    assert solved(sightings(true_light(), noise=0.05, lobe=0.0)) is None
    assert solved(sightings(true_light()), order=0) is None
    few = sightings(true_light())
    keep = few.point < 100
    few = Sightings(few.x, few.n, few.point[keep], few.view[keep], few.colour[keep], few.wo[keep])
    assert solved(few) is None
    assert LEAST_EXPLAINED > 0


def test_black_and_constant_photos_have_no_light() -> None:
    seen = sightings(true_light())
    for value in (0.0, 0.5):
        flat = Sightings(seen.x, seen.n, seen.point, seen.view, np.full_like(seen.colour, value), seen.wo)
        assert solved(flat) is None


def test_reflectance_is_the_hemisphere_integral_of_a_rough_dielectric() -> None:
    """GGX with height-correlated Smith shadowing and Schlick's Fresnel, integrated over the light's direction by the
    midpoint rule on a fine grid."""
    alpha = float(alpha_from_inv_kappa(torch.tensor([TYPICAL_INV_KAPPA], dtype=torch.float64))[0])
    count = 400
    z = (np.arange(count) + 0.5) / count
    phi = (np.arange(count) + 0.5) / count * 2 * np.pi
    z, phi = (a.ravel() for a in np.meshgrid(z, phi))
    toward = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], -1)

    def lam(c: F64) -> F64:
        return np.asarray((np.sqrt(1 + alpha**2 * (1 - c * c) / (c * c)) - 1) / 2)

    for c in (0.4, 0.7, 0.95):
        eye = np.array([np.sqrt(1 - c * c), 0, c])
        h = unit(toward + eye)
        d = alpha**2 / (np.pi * (h[:, 2] ** 2 * (alpha**2 - 1) + 1) ** 2)
        f = SKIN_F0 + (1 - SKIN_F0) * (1 - (h @ eye)) ** 5
        whole = d * f / (1 + lam(z) + lam(np.full_like(z, c))) / (4 * z * c) * z
        assert reflectance(np.array([c]))[0] == pytest.approx(whole.sum() * 2 * np.pi / len(z), rel=0.02)


def test_harmonics_agree_with_the_projects() -> None:
    d = unit(np.random.default_rng(0).normal(size=(50, 3)))
    assert np.allclose(harmonics(d, ORDER), sh.sh_basis(torch.from_numpy(d), ORDER).numpy(), atol=1e-10)
