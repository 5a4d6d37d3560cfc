"""sRGB against its definition, in numpy and torch, with gradients at the ends."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipeline.colour import ACESCG, LUMA, REC709, acescg_from_linear, linear_from_srgb, rgb_from_rgb, srgb_from_linear


def definition(c: float) -> float:
    """IEC 61966-2-1, decoding, written out."""
    return c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4


@pytest.mark.parametrize("code", [0, 1, 5, 10, 11, 12, 64, 128, 200, 254, 255])
def test_decoding_by_the_definition(code: int) -> None:
    assert linear_from_srgb(np.array(code / 255.0)) == pytest.approx(definition(code / 255), abs=1e-15)


def test_known_values() -> None:
    assert srgb_from_linear(np.array([0.0, 1.0])) == pytest.approx([0, 1], abs=1e-12)
    assert srgb_from_linear(np.array(0.18)) == pytest.approx(0.46135612950044164, abs=1e-12)  # mid grey
    assert linear_from_srgb(np.array(0.5)) == pytest.approx(0.21404114048223255, abs=1e-12)


@pytest.mark.parametrize("make", [lambda a: a, torch.tensor])
def test_round_trip_over_all_reals(make: object) -> None:
    x = make(np.linspace(-2, 3, 5001))  # type: ignore[operator]
    # around the toe's end the standard's own constants leave a step of 1e-8
    assert float(abs(linear_from_srgb(srgb_from_linear(x)) - x).max()) < 3e-8


def test_every_8_and_16_bit_code_survives() -> None:
    for peak in (255, 65535):
        codes = np.arange(peak + 1)
        back = srgb_from_linear(linear_from_srgb(codes / peak)) * peak
        assert np.array_equal(np.round(back), codes)


def test_monotone() -> None:
    y = srgb_from_linear(np.linspace(-0.1, 2, 100_001))
    assert (np.diff(y) > 0).all()


@pytest.mark.parametrize("at", [-1.0, 0.0, 1e-12, 0.0031308, 0.04045, 0.5, 1.0, 10.0])
def test_gradient_is_finite_and_right(at: float) -> None:
    for function in (srgb_from_linear, linear_from_srgb):
        x = torch.tensor(at, dtype=torch.float64, requires_grad=True)
        function(x).backward()  # type: ignore[no-untyped-call]
        step = 1e-6
        left, right = (float(function(np.array(at + s))) for s in (-step, step))
        assert x.grad is not None and torch.isfinite(x.grad)
        if at not in (0.0031308, 0.04045):  # the curve has a corner there
            assert float(x.grad) == pytest.approx((right - left) / (2 * step), rel=1e-5)


def test_numpy_and_torch_agree_in_single_precision() -> None:
    x = np.linspace(0, 1, 1001, dtype=np.float32)
    assert srgb_from_linear(x).dtype == np.float32
    assert np.abs(srgb_from_linear(torch.from_numpy(x)).numpy() - srgb_from_linear(x)).max() < 3e-7


def test_luma_is_of_white() -> None:
    assert sum(LUMA) == pytest.approx(1)


def test_acescg_by_the_published_matrix() -> None:
    """Rec.709 (D65) to AP1 (ACES white) with Bradford, as OpenColorIO's built-in ACES configuration has it."""
    published = [
        [0.61309740, 0.33952315, 0.04737945],
        [0.07019372, 0.91635388, 0.01345240],
        [0.02061559, 0.10956977, 0.86981463],
    ]
    np.testing.assert_allclose(rgb_from_rgb(ACESCG, REC709), published, atol=2e-6)


def test_white_and_grey_stay_and_the_way_back_is_the_inverse() -> None:
    np.testing.assert_allclose(
        acescg_from_linear(np.array([[0.18] * 3, [1.0] * 3, [0.0] * 3])), [[0.18] * 3, [1] * 3, [0] * 3], atol=1e-6
    )
    there, back = rgb_from_rgb(ACESCG, REC709), rgb_from_rgb(REC709, ACESCG)
    np.testing.assert_allclose(there @ back, np.eye(3), atol=1e-12)


def test_luminance_weights_are_those_of_the_primaries() -> None:
    """The middle row of the matrix to XYZ."""
    from pipeline.colour import _xyz_from_rgb

    np.testing.assert_allclose(_xyz_from_rgb(REC709)[1], LUMA, atol=1e-4)
