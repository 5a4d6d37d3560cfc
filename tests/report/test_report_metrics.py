"""Metrics against other implementations and values known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from pipeline.colour import linear_from_srgb
from stages.report.by_label import label_errors, pooled
from stages.report.metrics import Scores, encoded, flip, iou, matched, mean_scores, psnr, score, ssim

RNG = np.random.default_rng(5)


def pair(size: int = 40) -> tuple[np.ndarray, np.ndarray]:
    a = RNG.random((size, size, 3)).astype(np.float32)
    return a, (a + RNG.normal(0, 0.05, a.shape)).clip(0, 1).astype(np.float32)


def view(encoded_value: float, alpha: np.ndarray) -> np.ndarray:
    """A premultiplied render of one encoded grey."""
    return np.concatenate(
        [alpha[..., None] * np.full(3, linear_from_srgb(encoded_value)), alpha[..., None]], -1
    ).astype(np.float32)


def test_psnr_and_ssim_agree_with_skimage() -> None:
    a, b = pair()
    assert psnr(a, b) == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1), abs=1e-4)
    wanted = structural_similarity(
        a.astype(np.float64),
        b.astype(np.float64),
        channel_axis=2,
        data_range=1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ssim(a, b) == pytest.approx(wanted, abs=1e-5)


def test_psnr_of_a_known_difference() -> None:
    """0.1 off everywhere is 20 dB; equal images are 100."""
    grey = np.full((4, 4, 3), 0.5, np.float32)
    assert psnr(grey, grey + np.float32(0.1)) == pytest.approx(20, abs=1e-4)
    assert psnr(grey, grey) == 100


def test_foreground_psnr_ignores_the_background() -> None:
    mask = np.zeros((32, 32), np.float32)
    mask[8:24, 8:24] = 1
    photo = np.full((32, 32, 3), linear_from_srgb(0.5), np.float32)
    photo[mask == 0] = 0.9
    found = score(view(0.6, mask), photo, mask)
    assert found.psnr == pytest.approx(20, abs=0.01)
    assert found.psnr_full == pytest.approx(20 + 10 * np.log10(4), abs=0.01)  # a quarter of the pixels differ
    assert found.mask_iou == 1


def test_values_are_compared_encoded_and_clipped() -> None:
    np.testing.assert_allclose(encoded(np.float32([-1, 0, linear_from_srgb(0.5), 1, 7])), [0, 0, 0.5, 1, 1], atol=1e-6)
    mask = np.ones((16, 16), np.float32)
    bright = np.ones((16, 16, 4), np.float32) * np.float32([5, 5, 5, 1])
    assert score(bright, np.ones((16, 16, 3), np.float32), mask).psnr == 100


def test_colours_of_a_photo_are_matched_and_nothing_else_is() -> None:
    """Another exposure and white balance, then a difference that no matrix makes."""
    rng = np.random.default_rng(3)
    mask = np.zeros((20, 20), np.float32)
    mask[2:18, 3:17] = 1
    rendered = np.concatenate([rng.uniform(0.1, 0.5, (20, 20, 3)), mask[..., None]], -1).astype(np.float32)
    camera = np.float32([[1.4, 0.1, 0], [0, 1.3, 0.1], [0.05, 0, 1.5]])
    photo = rendered[..., :3] @ camera
    photo[mask == 0] = 1  # the background has no say
    found = score(rendered, photo, mask)
    assert found.psnr < 20 and found.psnr_matched > 90
    np.testing.assert_allclose(
        matched(rendered, photo, mask)[mask > 0], np.c_[photo, mask[..., None]][mask > 0], atol=1e-5
    )
    photo[::2] *= 0.8
    assert score(rendered, photo, mask).psnr_matched < 30


@pytest.mark.parametrize("value", [0.0, 1e-8, 0.3, 1e4])
def test_matching_one_colour(value: float) -> None:
    """Grey renders, and black ones, leave a matrix open: the result is finite, and right where there is any light."""
    mask, photo = np.ones((12, 12), np.float32), np.full((12, 12, 3), 0.2, np.float32)
    got = matched(np.concatenate([np.full((12, 12, 3), value), mask[..., None]], -1).astype(np.float32), photo, mask)
    assert np.isfinite(got).all()
    np.testing.assert_allclose(got[..., :3], 0.2 if value else 0, rtol=1e-4)


def test_flip_is_zero_for_equal_images_and_grows() -> None:
    a, b = pair(64)
    assert flip(a, a) == pytest.approx(0, abs=1e-6)
    small, large = flip(a, b), flip(a, 1 - a)
    assert small is not None
    assert large is not None
    assert 0 < small < large <= 1


@pytest.mark.parametrize("place", [(60, 70), (0, 0), (150, 0), (150, 200)])
def test_flip_of_a_part_is_that_of_the_whole_picture(place: tuple[int, int]) -> None:
    """A subject on black, in the middle and at the borders; and one pixel: the filters reach no further than asked."""
    evaluate = pytest.importorskip("flip_evaluator").evaluate
    rng, (row, column) = np.random.default_rng(8), place
    for height, width in ((40, 30), (1, 1)):
        images = np.zeros((2, 200, 240, 3), np.float32)
        images[:, row : row + height, column : column + width] = rng.random((2, height, width, 3))
        whole = evaluate(*images, "LDR", True, False)[0]
        assert whole.max() > 0.05
        assert flip(*images) == pytest.approx(float(whole.mean(dtype=np.float64)), rel=1e-6)
    assert flip(np.zeros((20, 20, 3), np.float32), np.zeros((20, 20, 3), np.float32)) == 0


def test_flip_is_left_out_where_it_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert flip(*pair()) is None
    assert mean_scores([Scores(20, 20, 21, 0.9, None, 1)])["flip"] is None


def test_iou_of_half_overlap() -> None:
    a, b = np.zeros((4, 8), np.float32), np.zeros((4, 8), np.float32)
    a[:, :4], b[:, 2:6] = 1, 1
    assert iou(a, b) == pytest.approx(1 / 3)
    assert iou(a * 0, b * 0) == 0


def test_means_skip_what_is_not_there() -> None:
    found = mean_scores([Scores(20, 21, 22, float("nan"), 0.1, 1), Scores(30, 35, 32, 0.8, 0.3, 0.5)])
    assert found == {"psnr": 25, "psnr_matched": 28, "psnr_full": 27, "ssim": 0.8, "flip": 0.2, "mask_iou": 0.75}
    assert mean_scores([])["psnr"] is None


def test_images_smaller_than_the_window_have_no_ssim() -> None:
    assert np.isnan(ssim(*pair(8)))
    assert Scores(20, 20, 20, float("nan"), None, 1).json() == {
        "psnr": 20, "psnr_matched": 20, "psnr_full": 20, "ssim": None, "flip": None, "mask_iou": 1
    }  # fmt: skip


@pytest.mark.parametrize("shape, mask", [((8, 9, 4), np.ones((8, 8))), ((8, 8, 4), np.zeros((8, 8)))])
def test_bad_input(shape: tuple[int, ...], mask: np.ndarray) -> None:
    with pytest.raises(ValueError, match="sizes differ|empty"):
        score(np.zeros(shape, np.float32), np.zeros((8, 8, 3), np.float32), mask.astype(np.float32))


def test_errors_by_label_are_pooled_over_views() -> None:
    """0.1 off on the face of one view, 0.2 on that of another with as many pixels: the mean square of both."""
    mask, labels = np.ones((8, 8), np.float32), np.ones((8, 8), np.uint8)
    labels[:4] = 2
    mask[0] = 0
    names = ("background", "subject", "face", "eyes")
    photo = np.full((8, 8, 3), linear_from_srgb(0.5), np.float32)
    found = []
    for off in (0.1, 0.2):
        render = view(0.5, np.ones((8, 8), np.float32))
        render[:4, :, :3] = linear_from_srgb(0.5 + off)
        found.append(label_errors(render, photo, mask, labels, names))
    assert {k: n for k, (_, n) in found[0].items()} == {"face": 24, "body": 32}
    got = pooled(found)
    assert got["face"] == pytest.approx(-10 * np.log10((0.01 + 0.04) / 2), abs=1e-3) and got["body"] == 100
    assert pooled([{}]) == {}
