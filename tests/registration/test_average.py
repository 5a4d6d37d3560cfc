"""The average of heads and textures whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.colour import srgb_from_linear
from pipeline.registration import average
from pipeline.registration.average import (
    GROUPS,
    MeanTexture,
    average_shape,
    edge_energy,
    landmark_discs,
    region_scatter,
)
from pipeline.registration.head import Head
from pipeline.registration.procrustes import weighted
from pipeline.transforms import apply, similarity
from tests.support.persons import head, names, person, template

REGIONS, _ = names()
SIZE = 256


def posed(vertices: np.ndarray, degrees: float, scale: float = 1.0, seen: np.ndarray | float = 1.0) -> Head:
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.0, 0.6, 0.8])).as_matrix()
    return head(scale * vertices, seen, turn, np.array([0.1, -0.2, 0.05]))


def world(degrees: float, scale: float = 1.0) -> np.ndarray:
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.0, 0.6, 0.8])).as_matrix()
    return similarity(scale, turn, np.array([0.1, -0.2, 0.05]))


def shape_of(*heads: Head, first: float = 0.0):  # type: ignore[no-untyped-def]
    return average_shape([partial(replace, h) for h in heads], REGIONS, world(first))


def surface(vertices: np.ndarray) -> np.ndarray:
    return head(vertices).displaced()


def off_mm(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    m = weighted(a, b, np.ones(len(a)), scaled=True)
    return np.asarray(1000 * np.linalg.norm(apply(m, a) - b, axis=1))


# ------------------------------------------------------------------ the shape
@pytest.mark.parametrize("degrees", [0.0, 40.0, 170.0])
def test_identical_heads_in_any_pose_and_size_are_their_own_mean(degrees: float) -> None:
    a = person(3)
    found = shape_of(posed(a, 10.0), posed(a, degrees, 1.3), posed(a, -degrees, 0.8), first=10.0)
    assert off_mm(found.points, surface(a)).max() < 1e-3
    assert found.deviation.max() < 1e-6
    ratio = found.scales / found.scales[0]
    np.testing.assert_allclose(ratio, [1, 1 / 1.3, 1 / 0.8], rtol=1e-6)
    assert np.prod(found.scales) == pytest.approx(1.0)


def test_it_stands_upright_as_the_template() -> None:
    a = person(3)
    found = shape_of(posed(a, 170.0), posed(a, 25.0), first=170.0)
    moved = weighted(surface(a), found.points, np.ones(len(found.points)), scaled=True)
    np.testing.assert_allclose(moved, np.eye(4), atol=2e-6)


def test_the_mean_of_two_is_their_middle_and_the_deviation_their_distance() -> None:
    a, step = person(3), np.zeros((5040, 3))
    nose = np.unique(template().quads[template().regions["nose"]])
    step[nose] = [0.0, 0.0, 0.002]
    found = shape_of(posed(a, 0.0), posed(a + step, 60.0))
    middle = surface(a + step / 2)
    assert off_mm(found.points, middle).max() < 0.05
    d = 1000 * found.deviation
    np.testing.assert_allclose(np.median(d[nose]), 2.0 / np.sqrt(2), rtol=0.15)  # of two: their distance over sqrt 2
    scatter = region_scatter(found, head(a), REGIONS)
    assert scatter["nose"]["median_mm"] > 1.0 and scatter["scalp"]["p95_mm"] < 0.1
    assert set(scatter) == set(REGIONS)


def test_the_mean_of_persons_is_the_identity_basis_mean() -> None:
    """Persons of opposite weights: the middle of each pair is the template."""
    t = template()
    w = np.random.default_rng(0).normal(0, 0.5, (3, 40))
    people = [t.identity(s * x) for x in w for s in (1, -1)]
    found = shape_of(*(posed(p, 30.0 * i, 1 + 0.05 * i) for i, p in enumerate(people)))
    truth = surface(t.vertices)
    own = np.unique(t.quads[t.regions["face"]])
    assert np.median(off_mm(found.points, truth)[own]) < 1.0
    assert np.median(1000 * found.deviation[own]) > 1.0


def test_a_single_head_and_unseen_heads_have_a_mean() -> None:
    a = person(3)
    alone = shape_of(posed(a, 0.0))
    assert off_mm(alone.points, surface(a)).max() < 1e-6 and alone.deviation.max() == 0
    blind = shape_of(posed(a, 0.0, seen=0.0), posed(a, 50.0, seen=0.0))
    assert off_mm(blind.points, surface(a)).max() < 1e-3


def test_heads_of_other_topologies_have_none() -> None:
    a = posed(person(3), 0.0)
    for other in (replace(a, quads=a.quads[:, [1, 2, 3, 0]]), replace(a, levels=1)):
        with pytest.raises(ValueError, match="topologies"):
            shape_of(a, other)


# ------------------------------------------------------------------ the texture
def picture(shift: float = 0.0, contrast: float = 1.0, size: int = SIZE) -> np.ndarray:
    """Stripes of 16 texels of a map of 256."""
    x = (np.arange(size) + 0.5) * SIZE / size
    row = 0.4 + 0.2 * contrast * np.sin(2 * np.pi * (x - shift) / 16)
    return np.repeat(np.repeat(row[None, :, None], size, 0), 3, 2).astype(np.float32)


def mean_of(*maps: np.ndarray, weights: list[np.ndarray] | None = None) -> MeanTexture:
    out = MeanTexture(SIZE, landmark_discs(template(), SIZE))
    for i, m in enumerate(maps):
        out.add(m, np.ones(m.shape[:2], np.float32) if weights is None else weights[i])
    return out


def test_maps_that_agree_have_sharpness_one() -> None:
    found = mean_of(picture(), picture(), picture())
    np.testing.assert_allclose(found.mean, picture(), atol=1e-6)
    assert found.sharpness() == pytest.approx({n: 1.0 for n in (*GROUPS, "all")}, rel=1e-6)


def test_maps_half_a_period_apart_cancel_and_a_quarter_halves() -> None:
    assert mean_of(picture(), picture(8)).sharpness()["all"] < 0.01
    assert mean_of(picture(), picture(4)).sharpness()["all"] == pytest.approx(0.5, rel=0.1)  # cos(45 degrees)^2


def test_unrelated_maps_have_the_sharpness_of_one_over_their_number() -> None:
    rng = np.random.default_rng(0)
    maps = [np.repeat(rng.uniform(0.2, 0.6, (SIZE, SIZE, 1)), 3, 2).astype(np.float32) for _ in range(4)]
    assert mean_of(*maps).sharpness()["all"] == pytest.approx(0.25, rel=0.05)


def test_the_energy_is_that_of_finite_differences() -> None:
    """A ramp of lightness has the same gradient everywhere, in closed form."""
    light = np.linspace(0.2, 0.8, SIZE)
    linear = np.where(light <= 0.04045, light / 12.92, ((light + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    ramp = np.repeat(np.repeat(linear[None, :, None], SIZE, 0), 3, 2).astype(np.float32)
    found = edge_energy(ramp)[20:-20, 20:-20]
    np.testing.assert_allclose(found, (0.6 / (SIZE - 1)) ** 2, rtol=1e-4)
    assert edge_energy(np.full((SIZE, SIZE, 3), 0.3, np.float32)).max() < 1e-20


def test_texels_count_as_they_were_seen() -> None:
    dark, bright = np.full((SIZE, SIZE, 3), 0.2, np.float32), np.full((SIZE, SIZE, 3), 0.8, np.float32)
    left = np.zeros((SIZE, SIZE), np.float32)
    left[:, : SIZE // 2] = 1
    found = mean_of(dark, bright, weights=[left, np.ones_like(left)]).mean
    np.testing.assert_allclose(found[:, : SIZE // 2], 0.5, atol=1e-6)
    np.testing.assert_allclose(found[:, SIZE // 2 :], 0.8, atol=1e-3)
    none = mean_of(dark, bright, weights=[0 * left, 0 * left]).mean  # all unseen: the plain mean
    np.testing.assert_allclose(none, 0.5, atol=1e-6)


def test_a_map_of_another_size_is_resampled() -> None:
    found = mean_of(picture(), picture(size=2 * SIZE))
    assert found.mean.shape == (SIZE, SIZE, 3) and found.sharpness()["all"] > 0.95


def test_flat_maps_and_a_template_without_landmark_regions_have_no_sharpness() -> None:
    flat = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    assert set(mean_of(flat, flat).sharpness()) <= {*GROUPS, "all"}
    bare = MeanTexture(SIZE, {})
    bare.add(picture(), np.ones((SIZE, SIZE), np.float32))
    assert bare.sharpness() == {}


def test_discs_lie_on_eyes_lips_and_brows_of_the_layout() -> None:
    """In rows from the top: brows above the eyes, eyes above the lips; all on both sides of the middle."""
    discs = landmark_discs(template(), SIZE)
    assert set(discs) == set(GROUPS)
    rows = {n: np.nonzero(m)[0].mean() for n, m in discs.items()}
    assert rows["brows"] < rows["eyes"] < rows["lips"]
    for mask in discs.values():
        assert mask[:, : SIZE // 2].any() and mask[:, SIZE // 2 :].any() and mask.mean() < 0.1
        assert abs(np.nonzero(mask)[1].mean() - SIZE / 2) < 0.02 * SIZE


def test_discs_leave_the_holes_of_the_layout_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Discs so wide that they reach into the openings, against OpenCV's polygons of the skin, a texel wider."""
    monkeypatch.setattr(average, "DISC", 0.06)
    t = template()
    corners = t.uvs[t.uv_quads[t.parts["skin"]]]
    corners = corners[(corners[..., 0] <= 1).all(1)]
    texels = np.stack([corners[..., 0] * SIZE, (1 - corners[..., 1]) * SIZE], -1) - 0.5
    skin = np.zeros((SIZE, SIZE), np.uint8)
    for quad in np.round(16 * texels).astype(np.int32):
        cv2.fillPoly(skin, [quad], 1, shift=4)
    wide = cv2.dilate(skin, np.ones((3, 3), np.uint8)) > 0
    assert not wide[:, SIZE // 2].all() and not wide.all()
    for name, mask in landmark_discs(t, SIZE).items():
        assert not (mask & ~wide).any(), name


def test_lightness_is_srgb() -> None:
    assert srgb_from_linear(np.array([0.2140411]))[0] == pytest.approx(0.5, abs=1e-5)
