"""Keying, matting, the person network and the region of interest, on pictures whose truth is known."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from pipeline.artifacts import Camera
from pipeline.colour import srgb_from_linear
from pipeline.transforms import rigid, rows
from stages.masks import segment_person
from stages.masks.grabcut import cut, cut_by_region
from stages.masks.keying import Background, border_colours, find_background, key_out
from stages.masks.matting import largest_parts, soft_edge
from stages.masks.region import Disc, dilated, eight_bit, eroded, region, resized, working_size
from stages.masks.segment_person import MODEL, of_subject, person_mask, person_probability, probability, refined

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]


def blob(size: int = 160, radius: float = 50.0, softness: float = 1.0) -> F32:
    """Alpha of a disc in the middle whose edge is `softness` pixels wide."""
    y, x = np.mgrid[:size, :size] + 0.5
    return np.asarray(((radius - np.hypot(x - size / 2, y - size / 2)) / softness + 0.5).clip(0, 1), np.float32)


def photo(alpha: F32, subject: tuple[float, ...], background: tuple[float, ...], noise: float = 0.0) -> U8:
    """8-bit sRGB of a mixture in linear light, noise in 8-bit levels."""
    linear = alpha[..., None] * np.array(subject) + (1 - alpha[..., None]) * np.array(background)
    levels = srgb_from_linear(linear) * 255 + np.random.default_rng(3).normal(0, 1, linear.shape) * noise
    return np.asarray(levels.round().clip(0, 255), np.uint8)


def iou(a: F32, b: F32) -> float:
    return float(((a >= 0.5) & (b >= 0.5)).sum() / ((a >= 0.5) | (b >= 0.5)).sum())


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (0.02, 0.5, 0.03), (0.75, 0.75, 0.75)])
@pytest.mark.parametrize("noise", [0.0, 1.5])
def test_key_recovers_a_soft_edge(background: tuple[float, ...], noise: float) -> None:
    truth = blob(softness=3.0)
    image = photo(truth, (0.5, 0.3, 0.22), background, noise)
    found = find_background([border_colours(image)] * 3)
    assert found is not None
    assert np.allclose(found.colour, srgb_from_linear(np.array(background)) * 255, atol=2)
    alpha = key_out(image, found)
    assert iou(alpha, truth) > 0.99
    edge = (truth > 0) & (truth < 1)
    hard = np.abs((truth >= 0.5) - truth)[edge].mean()
    assert np.abs(alpha - truth)[edge].mean() < (0.2 if noise == 0 else 0.6) * hard
    assert (alpha[truth == 0] == 0).mean() > 0.999 and (alpha[truth == 1] == 1).mean() > 0.995


def test_key_keeps_black_inside_the_subject() -> None:
    truth = blob()
    image = photo(truth, (0.5, 0.3, 0.22), (0, 0, 0))
    image[60:66, 60:80] = 0  # a brow as black as the background
    assert key_out(image, Background((0, 0, 0), 5.0))[60:66, 60:80].min() == 1


def test_key_leaves_a_large_flat_hole_open() -> None:
    truth = blob() * (1 - blob(radius=15.0))
    found = key_out(photo(truth, (0.5, 0.3, 0.22), (0, 0, 0)), Background((0, 0, 0), 5.0))
    assert iou(found, truth.astype(np.float32)) > 0.98
    assert found[80, 80] == 0


def test_key_of_a_subject_cut_by_the_frame() -> None:
    alpha = blob(200, 70.0)[:150]  # its lower part is out of the picture
    image = photo(alpha, (0.5, 0.3, 0.22), (0, 0, 0))
    image[-2:, 94:106] = 0  # a dark collar at the frame
    found = key_out(image, Background((0, 0, 0), 5.0))
    assert iou(found, alpha) > 0.99 and found[-1, 100] == 1


def test_no_uniform_background() -> None:
    rng = np.random.default_rng(0)
    ramp = np.repeat(np.linspace(20, 220, 160)[:, None, None], 160, 1).repeat(3, 2).astype(np.uint8)
    assert find_background([border_colours(ramp)]) is None
    speckled = rng.integers(0, 255, (160, 160, 3)).astype(np.uint8)
    assert find_background([border_colours(speckled)]) is None
    black, white = np.zeros((160, 160, 3), np.uint8), np.full((160, 160, 3), 255, np.uint8)
    assert find_background([border_colours(black)] * 3 + [border_colours(white)]) is None  # not one over all views
    assert find_background([]) is None


@pytest.mark.parametrize("softness", [1.0, 3.0])
def test_soft_edge_is_the_share_of_the_subject_in_each_pixel(softness: float) -> None:
    alpha = blob(120, 40.0, softness)
    found = soft_edge(photo(alpha, (0.6, 0.3, 0.2), (0.05, 0.1, 0.3)), alpha >= 0.5, 4)
    assert np.abs(found - alpha).max() < 0.06
    mixed = (alpha > 0.1) & (alpha < 0.9)
    assert np.corrcoef(found[mixed], alpha[mixed])[0, 1] > 0.99


def test_soft_edge_without_contrast_is_a_blurred_edge() -> None:
    grey = np.full((80, 80, 3), 128, np.uint8)
    inside = blob(80, 20.0) >= 0.5
    alpha = soft_edge(grey, inside, 3)
    assert iou(alpha, inside.astype(np.float32)) > 0.97 and np.isfinite(alpha).all()
    assert (soft_edge(grey, np.ones((80, 80), bool), 3) == 1).all()
    assert (soft_edge(grey, np.zeros((80, 80), bool), 3) == 0).all()


def test_largest_parts_and_morphology() -> None:
    mask = np.zeros((40, 40), bool)
    mask[:10, :10], mask[20:22, 20:22], mask[30:39, 30:39] = True, True, True
    assert largest_parts(mask, 0.5).sum() == 100 + 81
    assert eroded(np.ones((20, 20), bool), 4).all()  # beyond the frame the subject may go on
    assert not dilated(np.zeros((20, 20), bool), 4).any()
    assert dilated(mask, 2)[11, 5] and not dilated(mask, 2)[12, 5]


def test_eight_bit_of_every_kind() -> None:
    levels = np.array([0, 64, 255], np.uint8).reshape(1, 3, 1)
    assert (eight_bit(levels)[0, :, 0] == [0, 64, 255]).all() and eight_bit(levels).shape == (1, 3, 3)
    deep = (levels.astype(np.uint16) * 257).repeat(4, 2)
    assert (eight_bit(deep)[0, :, 1] == [0, 64, 255]).all()
    linear = np.array([0, 0.21404114, np.nan], np.float32).reshape(1, 3, 1)
    assert (eight_bit(linear)[0, :, 2] == [0, 128, 0]).all()


def test_working_size_and_resize() -> None:
    assert working_size(4000, 3000, 640) == (640, 480) and working_size(300, 200, 640) == (300, 200)
    ramp = np.linspace(0, 1, 64, dtype=np.float32)[None].repeat(64, 0)
    small = resized(ramp, 16, 16)
    assert small.shape == (16, 16) and np.allclose(small[0], ramp[0].reshape(16, 4).mean(1), atol=1e-5)
    assert resized(ramp, 64, 64) is ramp


def camera(rotation: npt.NDArray[np.float64]) -> Camera:
    """Two metres away on +Z, looking back at the origin, turned about its axis by `rotation`."""
    facing = np.diag([1.0, -1.0, -1.0]) @ rotation
    return Camera(index=0, name="0.jpg", width=400, height=300,
                  K=rows(np.array([[800, 0, 210.0], [0, 800, 140], [0, 0, 1]])),
                  world_from_cam=rows(rigid(facing, np.array([0, 0, 2.0]))), distortion=(0, 0, 0, 0, 0))  # fmt: skip


@pytest.mark.parametrize("degrees", [0.0, 30.0, -90.0, 180.0])
def test_region_and_roll(degrees: float) -> None:
    t = np.deg2rad(degrees)
    turn = np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])
    disc = region(camera(turn), 0.2)
    assert disc is not None
    assert (disc.x, disc.y, disc.radius) == pytest.approx((210, 140, 80))
    assert np.cos(disc.roll + t) == pytest.approx(1)  # a camera turned clockwise shows the world turned the other way
    inside = disc.covers(300, 400)
    assert inside[140, 210] and not inside[140, 295] and inside.sum() == pytest.approx(np.pi * 80**2, rel=0.01)


def test_region_behind_the_camera() -> None:
    assert region(camera(np.diag([-1.0, 1.0, -1.0])), 0.2) is None


# ------------------------------------------------------------------ the network
def test_model_is_the_file_that_the_notice_names() -> None:
    notice = (MODEL.parent / "NOTICE").read_text()
    named = re.search(r"sha256 ([0-9a-f]{64})", notice)
    assert named is not None and hashlib.sha256(MODEL.read_bytes()).hexdigest() == named.group(1)
    assert "Apache License" in notice and "http" not in notice
    assert "Version 2.0, January 2004" in (MODEL.parent / "LICENSE-APACHE-2.0").read_text()


def test_network_gives_probabilities() -> None:
    found = probability(np.full((256, 256, 3), 90, np.uint8))
    assert found.shape == (256, 256) and found.min() >= 0 and found.max() <= 1
    assert (found > 0.5).mean() < 0.2  # nobody there


HEAD = Path(__file__).resolve().parents[3] / "shared" / "captures" / "head_b"
needs_head = pytest.mark.skipif(not HEAD.is_dir(), reason="the capture head_b is not beside the repository")


def head(index: int) -> tuple[U8, F32]:
    image = cv2.imread(str(HEAD / f"{index}.jpg"))
    truth = cv2.imread(str(HEAD / "truth" / "mask" / f"{index}.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None and truth is not None
    return np.ascontiguousarray(image[..., ::-1]), (np.asarray(truth) / 255).astype(np.float32)


@needs_head
def test_person_in_a_real_photo() -> None:
    image, truth = head(20)
    disc = Disc(320, 320, 340, 0.0)
    assert iou(person_mask(image, disc, 0.5, 640, 0).astype(np.float32), truth) > 0.985


@needs_head
@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_person_in_a_turned_photo(quarter: int) -> None:
    """A photo taken with the camera on its side is turned upright for the network, and its mask turned back."""
    image, truth = head(20)
    roll = {1: -np.pi / 2, 2: np.pi, 3: np.pi / 2}[quarter]  # rot90 turns anticlockwise
    turned = np.ascontiguousarray(np.rot90(image, quarter))
    found, scale = person_probability(turned, Disc(320, 320, 340, float(roll)))
    assert scale == pytest.approx(640 / 256)
    assert iou(found, np.rot90(truth, quarter).astype(np.float32)) > 0.97


@needs_head
def test_person_in_a_corner_of_a_large_photo() -> None:
    """Where the subject is small, a crop shows it to the network larger; nothing shifts."""
    image, truth = head(20)
    small, alpha = cv2.resize(image, (320, 320), interpolation=cv2.INTER_AREA), cv2.resize(truth, (320, 320))
    large, expected = np.full((900, 1200, 3), 110, np.uint8), np.zeros((900, 1200), np.float32)
    large[580:, 700:1020], expected[580:, 700:1020] = small, alpha
    found, scale = person_probability(large, Disc(860, 740, 160, 0.0))
    assert scale < 2.5
    assert iou(found, expected) > 0.93
    assert cv2.phaseCorrelate(found.astype(np.float64), expected.astype(np.float64))[0] == pytest.approx((0, 0), abs=1)


def test_the_looks_at_a_photo_fit_onto_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a network that returns the brightness, the mean of all looks is the brightness; one that errs on its left
    side is right on the mean where one look in two is."""
    y, x = np.mgrid[:240, :320]
    grey = np.exp(-((x - 200) ** 2 + (y - 100) ** 2) / 1800)
    image = np.repeat((255 * grey).astype(np.uint8)[..., None], 3, 2)
    monkeypatch.setattr(segment_person, "probability", lambda square: square[..., 0].astype(np.float32) / 255)
    for disc in (Disc(160, 120, 200, 0.0), Disc(200, 100, 60, 0.3)):
        found = person_probability(image, disc)[0]
        inner = np.s_[60:140, 160:240]
        np.testing.assert_allclose(found[inner], grey[inner], atol=0.03)
    left = np.where(np.arange(256) < 128, 1, 0).astype(np.float32) * np.ones((256, 1), np.float32)
    monkeypatch.setattr(segment_person, "probability", lambda square: left)
    found = person_probability(image, Disc(160, 120, 200, 0.0))[0]
    assert found[120, 40] == found[120, 280] == pytest.approx(0.5, abs=0.01)


def test_of_subject_drops_strays_and_fills_small_holes() -> None:
    mask = blob(160, 40.0) >= 0.5
    mask[80, 80] = False
    mask[:30, :30] = True
    found = of_subject(mask, Disc(80, 80, 60, 0))
    assert found[80, 80] and not found[:30, :30].any()
    assert not of_subject(np.zeros((50, 50), bool), Disc(25, 25, 10, 0)).any()


@pytest.mark.parametrize(("sure", "width", "stays"), [(0.99, 100, True), (0.7, 100, False), (0.7, 30, True)])
def test_colours_decide_where_the_network_is_unsure_of_something_broad(sure: float, width: int, stays: bool) -> None:
    """A part of a bench beside a person. What is narrow is at the contour, where GrabCut decides anyway up
    to its own width."""
    y, x = np.mgrid[:320, :320]
    body, wood = np.hypot(x - 110, y - 160) < 70, (np.abs(y - 160) < width / 2) & (x >= 110)
    bench, floor = wood & (x < 240), y > 260
    image = np.full((320, 320, 3), (200, 200, 190), np.uint8)
    image[floor | wood], image[body] = (90, 60, 30), (60, 110, 160)
    image = (image + np.random.default_rng(0).normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8)
    network = np.where(body, 1.0, np.where(bench, sure, 0.0)).astype(np.float32)
    found = refined(image, network, 2.0, Disc(110, 160, 80, 0), 0.5, 0)
    assert iou(found.astype(np.float32), (body | (bench if stays else body)).astype(np.float32)) > 0.95


# ------------------------------------------------------------------ grabCut
def test_cut_by_region_is_repeatable_and_right() -> None:
    truth = blob(200, 60.0)
    image = photo(truth, (0.4, 0.25, 0.2), (0.1, 0.2, 0.4), noise=6)
    found = [cut_by_region(image, Disc(100, 100, 75, 0), 200, seed=4) for _ in range(2)]
    assert (found[0] == found[1]).all()
    assert iou(found[0].astype(np.float32), truth) > 0.97


def test_cut_without_samples_keeps_the_first_guess() -> None:
    image = np.zeros((60, 60, 3), np.uint8)
    unsure = np.full((60, 60), cv2.GC_PR_FGD, np.uint8)
    assert cut(image, unsure, 0).all()
    decided = np.full((60, 60), cv2.GC_BGD, np.uint8)
    assert not cut(image, decided, 0).any()
