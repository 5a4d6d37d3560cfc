"""How far the features of a face lie from where the photo shows them, on a real photo and on made-up pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from skimage import data

from pipeline.colour import linear_from_srgb
from stages.report.features import FEATURES, REACH, UNIT, _windows, feature_figures, feature_shifts, shift

PHOTO = linear_from_srgb(data.astronaut().astype(np.float32) / 255).astype(np.float32)
MASK = np.ones(PHOTO.shape[:2], np.float32)


def moved(x: float, y: float, scale: float = 1.0) -> np.ndarray:
    """The photo as a render (H, W, 4) whose surface lies x, y pixels beside, darker and redder than it."""
    at = np.float32([[1, 0, x], [0, 1, y]])
    size = PHOTO.shape[1::-1]
    picture = cv2.warpAffine(PHOTO, at, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    tinted = picture.clip(0, 1) * np.float32([0.8, 0.6, 0.5])
    out = np.concatenate([tinted, np.ones((*picture.shape[:2], 1), np.float32)], -1)
    return cv2.resize(out, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (3, -4), (0.5, 0.25), (-6.4, 2.7)])
def test_a_shift_of_the_whole_face_is_that_of_each_feature(x: float, y: float) -> None:
    found = feature_shifts(PHOTO, MASK, moved(x, y))
    assert FEATURES.keys() <= found.keys()
    np.testing.assert_allclose([found[n] for n in FEATURES], np.hypot(x, y), atol=0.12)
    np.testing.assert_allclose(list(found.values()), np.hypot(x, y), atol=0.6)  # hair covers one ear


def test_it_is_measured_at_512_pixels_whatever_the_photo_has() -> None:
    small = cv2.resize(PHOTO, None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    found = feature_shifts(small, np.ones(small.shape[:2], np.float32), moved(4, 3, 0.75))
    np.testing.assert_allclose([found[n] for n in FEATURES], 5.0, atol=0.4)


def test_one_feature_that_lies_elsewhere_is_told() -> None:
    """The mouth moved by five pixels, the rest where it was."""
    y, x = np.mgrid[: PHOTO.shape[0], : PHOTO.shape[1]].astype(np.float32)
    share = np.exp(-0.5 * (((x - 226) / 26) ** 2 + ((y - 148) / 13) ** 2)) ** 0.5
    render = moved(0, 0)
    found = feature_shifts(PHOTO, MASK, cv2.remap(render, x - 5 * share, y, cv2.INTER_LINEAR))
    assert 3 < found["mouth"] < 5.5 and found["brows"] < 0.5 and found["eyes"] < 0.5


def test_the_shift_against_a_function_that_is_known_between_pixels() -> None:
    """Oracle: waves sampled at the shifted places; gain, offset and a little noise change nothing."""
    rng = np.random.default_rng(0)
    waves = rng.normal(0, 0.15, (40, 2)), rng.uniform(0, 7, 40), rng.normal(size=40)

    def sampled(dx: float, dy: float) -> np.ndarray:
        y, x = np.mgrid[:120, :160].astype(np.float64)
        phase = (x - dx)[..., None] * waves[0][:, 0] + (y - dy)[..., None] * waves[0][:, 1] + waves[1]
        return np.asarray(128 + 10 * (np.sin(phase) * waves[2]).sum(-1), np.float32)

    low, high = np.array([50.0, 40]), np.array([110.0, 90])
    for dx, dy in ((0.0, 0.0), (0.3, -0.6), (7.25, -11.0), (-11.0, 10.5)):
        found = shift(
            sampled(dx, dy), 3 * sampled(0, 0) + 40 + rng.normal(0, 1, (120, 160)).astype(np.float32), low, high
        )
        assert found is not None
        np.testing.assert_allclose(found, (dx, dy), atol=0.1)
    assert shift(sampled(3 * REACH, 2 * REACH), sampled(0, 0), low, high) is None  # like nothing within reach


@pytest.mark.parametrize("what", ["flat render", "flat photo", "noise", "beyond the picture", "thin"])
def test_where_nothing_can_be_compared_there_is_no_shift(what: str) -> None:
    rng = np.random.default_rng(1)
    picture, other = (rng.uniform(0, 255, (100, 100)).astype(np.float32) for _ in range(2))
    flat = np.full((100, 100), 77.0, np.float32)
    low, high = np.array([40.0, 40]), np.array([60.0, 60])
    given = {
        "flat render": (picture, flat, low, high),
        "flat photo": (flat, picture, low, high),
        "noise": (picture, other, low, high),
        "beyond the picture": (picture, picture, low + 200, high + 200),
        "thin": (picture, picture, low, low + 5),
    }[what]
    assert shift(*given) is None


def test_no_face_and_no_surface() -> None:
    coffee = linear_from_srgb(data.coffee().astype(np.float32) / 255).astype(np.float32)
    whole = np.ones(coffee.shape[:2], np.float32)
    assert feature_shifts(coffee, whole, np.concatenate([coffee, whole[..., None]], -1)) == {}
    assert feature_shifts(PHOTO, MASK, np.zeros((*PHOTO.shape[:2], 4), np.float32)) == {}
    assert feature_shifts(PHOTO, np.zeros_like(MASK), moved(0, 0)) == {}


def test_an_ear_is_sought_on_the_side_that_can_be_seen() -> None:
    points = np.random.default_rng(0).uniform(200, 300, (468, 2))
    points[234], points[454] = (200, 250), (300, 250)
    for nose, ears in ((250, {"right ear", "left ear"}), (290, {"right ear"}), (205, {"left ear"})):
        points[1] = nose, 250
        found = _windows(points)
        assert found.keys() - FEATURES.keys() == ears
        for ear in ears:
            low, high = found[ear]
            outside = low[0] < 200 if ear == "right ear" else high[0] > 300
            assert outside and low[1] < 250 < high[1]
    points[454] = points[234]  # a face without width
    assert _windows(points).keys() == FEATURES.keys()


def test_figures_are_of_all_features_but_ears() -> None:
    found = feature_figures({3: {"nose": 1.0, "chin": 2.004, "left ear": 9.0}, 5: {}, 7: {"eyes": 0.5}})
    assert found == {
        "features_px": 1.0,
        "features_px_most": 2.0,
        "features": {"3": {"nose": 1.0, "chin": 2.0, "left ear": 9.0}, "7": {"eyes": 0.5}},
    }
    assert feature_figures({1: {}, 2: {"left ear": 1.0}}) == {} and UNIT == 512
