"""Errors of the light in the base colour of skin, on a bent sheet whose two sides are known."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.colour import LUMA
from pipeline.meshes import F64, Mask, Mesh
from pipeline.registration.other_side import OtherSide
from stages.bake.even_skin import MIN_SHARE, USUAL, evening, shares

SIDE, STEP = 61, 0.0025  # vertices along an edge, metres between them
TONE = np.array([0.45, 0.28, 0.2])


def sheet() -> tuple[Mesh, F64, F64]:
    """A cylinder's half about the y axis, 15 cm wide; and of its vertices the place across and along, in [-1, 1]."""
    s = np.linspace(-1, 1, SIDE)
    along, across = (z.ravel() for z in np.meshgrid(s, s, indexing="ij"))
    angle, radius = across * 1.2, SIDE * STEP / 2.4
    x = np.stack([radius * np.sin(angle), along * SIDE * STEP / 2, radius * np.cos(angle)], 1)
    i = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    normals = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], 1)
    return Mesh(x.astype(np.float32), normals.astype(np.float32), faces), across, along


MESH, ACROSS, ALONG = sheet()
EVERYWHERE = np.ones(len(ACROSS), np.bool_)


def sides(plain: Mask = EVERYWHERE, on_head: Mask = EVERYWHERE) -> OtherSide:
    return OtherSide(MESH.vertices.astype(np.float64) * [-1, 1, 1], on_head, plain)


def of(log_luminance: F64) -> F64:
    """(V, 3) base colours."""
    return np.asarray(TONE * np.exp(log_luminance)[:, None])


def rms(values: F64, where: Mask = EVERYWHERE) -> float:
    return float(np.sqrt(np.mean((values[where] - values[where].mean()) ** 2)))


LAMP = 0.3 * np.tanh(2 * ACROSS)  # a light from one side that the fit has wrong
STUBBLE = -0.4 * np.exp(-(((ALONG + 0.5) / 0.25) ** 2))  # the same on both sides
INNER = np.abs(ALONG) < 0.95


def evened(log_luminance: F64, part: float = 1.0, other: OtherSide | None = None) -> F64:
    albedo = of(log_luminance)
    found = evening(MESH, EVERYWHERE, albedo, other=other or sides(), part=part)
    return np.asarray(np.log(albedo * found.factor @ np.array(LUMA)))


def test_what_both_sides_share_stays() -> None:
    """Stubble alone is the skin's: both sides have it."""
    albedo = of(STUBBLE)
    found = evening(MESH, EVERYWHERE, albedo, other=sides(), part=1.0)
    assert np.allclose(found.factor, 1, atol=1e-6)
    assert found.figures["skin_luminance_sides"] < 1e-3 and found.figures["skin_luminance_error"] == 0


@pytest.mark.parametrize("part", [0.25, 0.5, 1.0])
def test_a_light_from_one_side_goes_by_its_part(part: float) -> None:
    truth = rms(LAMP)
    share = 1 - (USUAL[0] / truth) ** 2
    assert rms(evened(LAMP, part)) == pytest.approx((1 - part * share) * truth, abs=0.02)


def test_the_sides_tell_how_much_of_what_they_share_is_wrong() -> None:
    """The same dark band: kept where the sides agree, weakened where they differ as much as it varies."""
    alone, lit = evened(STUBBLE), evened(STUBBLE + LAMP)
    depth = [float(z[INNER & (np.abs(ACROSS) < 0.1)].max() - z[INNER & (np.abs(ACROSS) < 0.1)].min())
             for z in (alone, lit)]  # fmt: skip
    assert depth[0] > 0.35 and depth[1] < 0.5 * depth[0]


def test_skin_without_another_side_has_the_share_of_both() -> None:
    """A strip whose other side is not seen: the lamp there may be the skin's own, as a dark band is elsewhere."""
    lamp, bands = 0.4 * LAMP, 0.4 * np.sin(9 * ALONG)
    skin, alone = ACROSS > -0.7, ACROSS > 0.85
    albedo = of(lamp + bands)
    found = evening(MESH, skin, albedo, other=sides(), part=1.0)
    share = shares(found.figures["skin_luminance_sides"] ** 2, rms(bands) ** 2, USUAL[0])
    assert share[0] > 0.55 and share[1] < 0.2
    took = -np.log(found.factor[:, 1])
    assert rms(took, alone & INNER) < 0.35 * rms(bands, alone & INNER)


def test_a_tint_from_one_side_goes_without_a_change_of_luminance() -> None:
    tint = np.exp(np.tanh(2 * ACROSS)[:, None] * np.array([0.15, 0.0, -0.2]))
    albedo = TONE * tint
    albedo *= (TONE @ np.array(LUMA) / (albedo @ np.array(LUMA)))[:, None]
    found = evening(MESH, EVERYWHERE, albedo, other=sides(), part=1.0)
    after = np.log(albedo * found.factor)
    before = np.log(albedo)
    assert rms(after[:, 0] - after[:, 2]) < 0.25 * rms(before[:, 0] - before[:, 2])
    assert found.figures["skin_luminance_error"] == 0 and found.figures["skin_chromaticity_error"] > 0.1


def test_the_mean_luminance_of_skin_stays() -> None:
    albedo = of(LAMP + STUBBLE)
    found = evening(MESH, EVERYWHERE, albedo, other=sides(), part=1.0)
    before, after = (float((z @ np.array(LUMA))[INNER].mean()) for z in (albedo, albedo * found.factor))
    assert after == pytest.approx(before, rel=0.01)


def test_only_skin_changes_and_not_the_lips() -> None:
    """The upper quarter is cloth, the lower one lips: what is more than two widths away from skin stays."""
    cloth, lips = ALONG > 0.5, ALONG < -0.5
    albedo = of(LAMP + np.where(cloth, 1.0, 0.0))
    found = evening(MESH, ~cloth, albedo, other=sides(plain=~lips), part=1.0)
    assert np.allclose(found.factor[(ALONG > 0.75) | (ALONG < -0.75)], 1, atol=0.01)
    assert found.factor[np.abs(ALONG) < 0.3].std() > 0.1
    steps = np.abs(np.diff(found.factor[:, 0].reshape(SIDE, SIDE), axis=0))
    assert steps.max() < 0.6 * np.abs(found.factor - 1).max()  # no edge where it ends


@pytest.mark.parametrize("seen", [MIN_SHARE - 0.05, MIN_SHARE + 0.05])
def test_one_side_alone_tells_nothing(seen: float) -> None:
    """Skin is seen on both sides on a part of the head only, as where a photo of a profile is all there is."""
    skin = np.abs(ACROSS) < 1.0
    skin &= (ACROSS > 0) | (-1 + 2 * seen / (2 - seen) > ALONG)
    albedo = of(LAMP)
    found = evening(MESH, skin, albedo, other=sides(), part=1.0)
    assert (found.figures == {}) == (seen < MIN_SHARE) and np.allclose(found.factor, 1) == (seen < MIN_SHARE)


@pytest.mark.parametrize("case", ["no skin", "black", "far from the head", "part 0", "one vertex"])
def test_extremes(case: str) -> None:
    skin, albedo, on_head = EVERYWHERE, of(LAMP), EVERYWHERE
    if case in ("no skin", "one vertex"):
        skin = np.zeros_like(EVERYWHERE)
        skin[5] = case == "one vertex"
    if case == "black":
        albedo = np.zeros_like(albedo)
    if case == "far from the head":
        on_head = ~EVERYWHERE
    found = evening(MESH, skin, albedo, other=sides(on_head=on_head), part=0.0 if case == "part 0" else 1.0)
    assert np.allclose(found.factor, 1, atol=1e-9) and np.isfinite(found.factor).all()


@pytest.mark.parametrize(("error", "own"), [(0.2, 0.1), (0.05, 0.2), (1.0, 1e-3)])
def test_shares_are_those_of_a_regression(error: float, own: float) -> None:
    """Drawn signals: the slope of the error over what is observed, by least squares."""
    rng = np.random.default_rng(1)
    usual = 0.03
    e_a, e_s = rng.normal(0, error, (2, 400_000))
    across, along = e_a + rng.normal(0, usual, e_a.shape), e_s + rng.normal(0, own, e_s.shape)
    found = shares(float(np.mean(across**2)), float(np.mean(along**2)), usual)
    for share, wrong, observed in ((found[0], e_a, across), (found[1], e_s, along)):
        assert share == pytest.approx(float(wrong @ observed / (observed @ observed)), abs=0.01)


@pytest.mark.parametrize(
    ("across", "along", "wanted"),
    [(0.0, 0.0, (0, 0)), (1.0, 0.0, (1, 0)), (1e-4, 1.0, (0, 0)), (1e6, 1e-6, (1, 1)), (1.0, 1e12, (1, 0))],
)
def test_shares_at_the_extremes(across: float, along: float, wanted: tuple[float, float]) -> None:
    assert shares(across, along, 0.03) == pytest.approx(wanted, abs=2e-3)
