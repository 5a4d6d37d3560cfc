"""The level of the albedo: what each source says, how they are combined, and that no photo changes by it."""

from __future__ import annotations

import copy
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from stages.inverse_rendering.albedo_level import (
    CORRECTED_SCLERA,
    CORRECTED_STD,
    EYES_STD,
    MIN_PIXELS,
    SCLERA,
    START_STD,
    LabelledAlbedos,
    apply_gain,
    decide,
    labelled_albedos,
    level_std,
    lobe_std,
    sclera,
    set_level,
)
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.model_selection import own_parts
from stages.inverse_rendering.outputs import predict_view
from tests.support.small_ball import SIDE, ball_view, fit_of_the_ball
from tests.support.spread import made_once

NAMES = ("", "face", "hair", "eyes")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return made_once(tmp_path_factory, "fit_of_the_ball", fit_of_the_ball)


def head(tone: float, level: float = 1.0, open_eyes: bool = True) -> LabelledAlbedos:
    """A face of this luminance with eyes of which a third is white, seen by a fit whose albedo is `level` times too
    bright."""
    rng = np.random.default_rng(3)
    skin = np.array([1.5, 0.9, 0.65]) * tone
    face = skin * rng.uniform(0.9, 1.1, (2000, 1))
    white = np.repeat([[0.42, 0.385, 0.36]], 200, 0)
    iris, pupil = np.repeat([[0.1, 0.07, 0.05]], 250, 0), np.repeat([[0.01, 0.01, 0.01]], 150, 0)
    eyes = np.concatenate([white, iris, pupil]) if open_eyes else skin * rng.uniform(0.7, 1.2, (600, 1))
    return LabelledAlbedos(level * face, level * eyes)


@pytest.mark.parametrize("tone", [0.06, 0.12, 0.25, 0.45])
@pytest.mark.parametrize("level", [0.6, 1.0, 2.1])
def test_the_level_does_not_depend_on_the_tone_of_the_skin(tone: float, level: float) -> None:
    """Any tone comes back within 12 % from a fit that is wrong by up to a factor of two."""
    found = decide(head(tone, level), None, None)
    assert found.facts["why"] == "start and eyes"
    assert float(found.facts["face"]) == pytest.approx(tone, rel=0.12)


def test_sources_are_weighted_by_their_variances() -> None:
    """Against the mean of two normal distributions by hand."""
    seen, e = head(0.3, 1.7), 0.3
    white = sclera(seen)
    assert white is not None
    a, b = level_std(e) ** -2, EYES_STD**-2
    expected = math.exp((a * 0.0 + b * math.log(SCLERA / white)) / (a + b))
    found = decide(seen, None, e)
    assert found.gain == pytest.approx(expected) and found.log_std == pytest.approx((a + b) ** -0.5)
    after = decide(seen, None, e, corrected=True)
    b = CORRECTED_STD**-2
    assert after.gain == pytest.approx(math.exp(b * math.log(CORRECTED_SCLERA / white) / (a + b)))
    sure = decide(seen, None, 0.98)
    assert abs(math.log(sure.gain)) < 0.01 and sure.log_std < 0.01


@pytest.mark.parametrize(
    "seen",
    [
        head(0.3, open_eyes=False),
        head(0.08, 2.0, open_eyes=False),
        LabelledAlbedos(head(0.3).face, np.zeros((0, 3))),
        LabelledAlbedos(head(0.3).face, head(0.3).eyes[: MIN_PIXELS - 1]),
        LabelledAlbedos(np.zeros((0, 3)), np.zeros((0, 3))),
        LabelledAlbedos(head(0.3).face, np.zeros((600, 3))),
    ],
    ids=["closed", "closed and dark", "no eyes", "few pixels", "nothing", "black"],
)
def test_without_open_eyes_the_level_stays(seen: LabelledAlbedos) -> None:
    found = decide(seen, None, None)
    assert found.gain == 1.0 and found.log_std == START_STD and found.facts["why"] == "start"


def test_a_measured_level_is_met_exactly() -> None:
    found = decide(head(0.2, 1.4), 0.17, 0.5)
    assert found.gain * float(np.median(head(0.2, 1.4).face @ np.array([0.2126, 0.7152, 0.0722]))) == pytest.approx(
        0.17
    )
    assert decide(LabelledAlbedos(np.zeros((0, 3)), np.zeros((0, 3))), 0.17, None).gain == 1.0


def test_no_albedo_is_raised_above_one() -> None:
    """A dark eye, as of a photo with the eyes in shadow, beside bright skin."""
    seen = head(0.3)
    found = decide(LabelledAlbedos(seen.face * 1.8, seen.eyes * 0.3), None, None)
    assert found.gain * np.quantile(seen.face.max(1) * 1.8, 0.99) <= 0.9801
    assert decide(LabelledAlbedos(seen.face * 4, seen.eyes), None, None).gain <= 1.0


def test_the_deviation_of_the_lobe() -> None:
    """Falls with the explained share, and is finite at both ends."""
    stds = [lobe_std(e) for e in (0.0, 0.15, 0.23, 0.47, 0.9, 1.0)]
    assert all(a >= b for a, b in zip(stds, stds[1:], strict=False))
    assert stds[0] == START_STD and 0 < stds[-1] < 1e-3 and 0.05 < stds[3] < 0.1


def test_the_deviation_of_the_level_has_the_size_of_its_errors() -> None:
    """Of three heads with a known albedo, by the share that their light explains: within two standard deviations, and
    the whites of the eyes outweigh a lobe that explains a third."""
    for e, error in ((0.47, 0.03), (0.65, 0.14), (0.31, 0.51), (0.39, 0.52)):
        assert error < 2 * level_std(e) < 1.0
    assert level_std(0.0) == START_STD and 0 < level_std(1.0) < 0.01
    assert 0.5 * level_std(0.39) > CORRECTED_STD


@pytest.mark.parametrize("gain", [0.3, 1.3])
def test_no_photo_changes(fitted: Trainer, gain: float) -> None:
    model = copy.deepcopy(fitted.model)
    before = predict_view(model, ball_view(5), 1, 8, "cpu")
    spatial, _, light = own_parts(model)
    x = torch.tensor([[0.0, 0.0, 0.1]])
    albedo, bright = spatial(x)[0].clone(), light().clone()
    apply_gain(spatial, light, gain)
    assert torch.allclose(spatial(x)[0], gain * albedo) and torch.allclose(light(), bright / gain)
    assert np.abs(predict_view(model, ball_view(5), 1, 8, "cpu") - before).max() < 1e-5


def test_labels_are_read_where_the_photos_show_them(fitted: Trainer) -> None:
    """The red half of the ball is labelled face, the blue half eyes, in labels of half the size."""
    model = copy.deepcopy(fitted.model)
    labels = [_halves(v.index) for v in fitted.views]
    seen = labelled_albedos(model, fitted.pixels, fitted.views, labels, NAMES)
    assert len(seen.face) > MIN_PIXELS and len(seen.eyes) > MIN_PIXELS
    red, blue = np.median(seen.face, 0), np.median(seen.eyes, 0)
    assert red[0] > 1.5 * red[2] and blue[2] > 1.5 * blue[0]
    fact = set_level(model, fitted.pixels, fitted.views, labels, NAMES, 0.2, {})
    again = labelled_albedos(model, fitted.pixels, fitted.views, labels, NAMES)
    assert fact["why"] == "setting"
    assert float(np.median(again.face @ np.array([0.2126, 0.7152, 0.0722]))) == pytest.approx(0.2, rel=1e-3)
    assert set_level(model, fitted.pixels, fitted.views, labels, NAMES, "fitted", {})["gain"] == 1.0


def _halves(index: int) -> np.ndarray:
    """(H / 2, W / 2) codes: 1 where the photo is red, 3 where it is blue, 0 outside and at the border."""
    view = ball_view(index)
    rgb, side = view.rgb.reshape(SIDE // 2, 2, SIDE // 2, 2, 3).mean((1, 3)), SIDE // 2
    codes = np.zeros((side, side), np.uint8)
    codes[rgb[..., 0] > 1.5 * rgb[..., 2]] = 1
    codes[rgb[..., 2] > 1.5 * rgb[..., 0]] = 3
    return codes


def test_bright_skin_alone_is_no_reason_to_darken_it() -> None:
    found = decide(LabelledAlbedos(np.full((2000, 3), 1.5), np.zeros((0, 3))), None, None)
    assert found.gain == 1.0


def test_eyes_whose_iris_is_as_red_as_skin_are_open() -> None:
    """The white is what is compared with the skin, not the whole eye."""
    seen = head(0.3)
    eyes = seen.eyes.copy()
    eyes[200:450] = np.array([1.5, 0.9, 0.65]) * 0.07
    assert sclera(LabelledAlbedos(seen.face, eyes)) == pytest.approx(0.39, abs=0.01)


def test_eyes_are_read_without_what_they_reflect(fitted: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """a = (I - L_s) a_0 / L_d: with a_0 / L_d = 2, a reflection of .02 takes .04."""
    model = copy.deepcopy(fitted.model)
    labels, found = [_halves(v.index) for v in fitted.views], []
    for reflected in (0.0, 0.02):

        def shade(self: Any, x: torch.Tensor, *a: Any, reflected: float = reflected) -> Any:
            one = torch.ones(len(x), 3)
            return SimpleNamespace(specular=reflected * one, albedo=0.5 * one, diffuse=0.25 * one)

        monkeypatch.setattr(type(model), "shade", shade)
        found.append(labelled_albedos(model, fitted.pixels, fitted.views, labels, NAMES).eyes)
    np.testing.assert_allclose(found[0] - found[1], 0.04, atol=1e-5)
