"""Each figure of the fit's judge on made-up results, sound and ruined, and on small fits of a ball."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.artifacts import FileRef, MaskSet, ViewMask
from pipeline.capture_artifacts import Capture, CaptureView
from pipeline.colour import srgb_from_linear
from pipeline.verdict import Finding, worst
from stages.inverse_rendering.config import PRIORS
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.judge import Fitted, findings
from stages.inverse_rendering.outputs import predict_view
from stages.inverse_rendering.ray_sampling import PhotoView
from stages.inverse_rendering.residuals import LabelError, ViewError, view_errors
from stages.inverse_rendering.stereo import photo_noise
from stages.inverse_rendering.training_loop import run_fit
from tests.support.small_ball import SMALL, ball_start, ball_view, fit_of_the_ball, hooks, trainer
from tests.support.spread import made_once

REF = FileRef(path="a.png", sha256="0" * 64, size=1)
FACTS: dict[str, dict[str, Any]] = {
    "specular": {"modelled": True, "why": "cross-validation", "error_without": 0.072, "error_with": 0.054},
    "calibration": {"modelled": False, "why": "cross-validation", "error_without": 0.054, "error_with": 0.0529},
    "relief": {
        "modelled": True,
        "why": "cross-validation",
        "silhouette_error_of_prior": 0.002,
        "silhouette_error": 0.004,
    },
    "geometry": {"prior": PRIORS["hull"]},
}
RISING = (19.3, 25.2, 32.0, 34.3, 33.6, 34.5, 35.2, 36.4, 37.2, 37.5)


def error(index: int, psnr: float = 37.5, **changes: Any) -> ViewError:
    square = 10 ** (-psnr / 10)
    labels = {"face": LabelError(200, square), "eyes": LabelError(30, square)}
    return replace(ViewError(index, 1000, square, 0.05, 0.0, 0.0, 0.002, square, labels), **changes)


def sound(errors: list[ViewError] | None = None, facts: Any = None, faces: int = 12, **changes: Any) -> Fitted:
    """A fit of 20 photos as the scanned head's is."""
    views = tuple(CaptureView(index=i, name=f"p{i}.jpg", image=REF, width=8, height=8) for i in range(20))
    masks = tuple(
        ViewMask(index=i, mask=REF, source="given", coverage=0.5, labelled=("face",) if i < faces else ())
        for i in range(20)
    )
    made = errors if errors is not None else [error(i) for i in range(20)]
    return replace(
        Fitted(made, Capture(kind="photos", views=views), MaskSet(masks=masks), RISING, {**FACTS, **(facts or {})}),
        **changes,
    )


def only(f: Fitted, check: str) -> Finding:
    (found,) = [x for x in findings(f) if x.check == check]
    return found


def test_a_sound_fit_is_good() -> None:
    found = findings(sound())
    names = [f.check for f in found]
    assert worst(found) == "good" and len(set(names)) == len(names)
    assert {"fit_error", "worst_views", "psnr_fell", "start_silhouette", "photos_agree", "specular"} <= set(names)
    assert {"fit_error_face", "fit_error_eyes", "fit_missing", "calibration"} <= set(names)
    assert all(f.said and f.limit and not f.views and not f.remedy for f in found)


@pytest.mark.parametrize(("psnr", "level"), [(27.5, "good"), (20.0, "usable"), (6.9, "unusable")])
def test_error_of_the_median_photo(psnr: float, level: str) -> None:
    f = sound([error(i, psnr) for i in range(20)])
    for check in ("fit_error", "fit_error_face"):
        found = only(f, check)
        assert found.level == level and found.value == pytest.approx(psnr, abs=0.1)
        assert f"{found.value:.1f} dB" in found.said and (level == "good") == (not found.remedy)


def test_noise_is_not_held_against_the_fit() -> None:
    """Photos whose noise alone is 24 dB, explained but for that noise."""
    noise = 10 ** (-24 / 20)
    assert only(sound([error(i, 23.9, noise=noise) for i in range(20)]), "fit_error").level == "good"
    assert only(sound([error(i, 23.9) for i in range(20)]), "fit_error").level == "usable"


def test_a_label_with_few_pixels_is_not_judged() -> None:
    few = [error(i, labels={"eyes": LabelError(4, 0.5), "hair": LabelError(50, 0.5)}) for i in range(20)]
    checks = {f.check: f.level for f in findings(sound(few))}
    assert "fit_error_eyes" not in checks and checks["fit_error_hair"] == "unusable"


@pytest.mark.parametrize(("bad", "level"), [(0, "good"), (1, "usable"), (3, "unusable")])
def test_photos_worse_than_the_others_are_named(bad: int, level: str) -> None:
    f = sound([error(i, 26.0 - i / 10 if i < bad else 37.5) for i in range(20)])
    found = only(f, "worst_views")
    assert found.level == level and found.value == pytest.approx(bad / 20)
    assert found.views == tuple(f"p{i}.jpg" for i in reversed(range(bad)))


def test_photos_that_are_alike_or_shown_well_are_no_worst_ones() -> None:
    for median, one, level in ((30.0, 24.5, "good"), (37.5, 28.0, "good"), (30.0, 23.5, "usable")):
        found = only(sound([error(i, one if i == 3 else median) for i in range(20)]), "worst_views")
        assert found.level == level, (median, one)


def test_a_mask_with_a_piece_too_much_makes_no_worst_photo() -> None:
    """One hundredth of the pixels is background, which the model rightly does not show."""
    errors = [error(i, 38.0) for i in range(20)]
    errors[4] = replace(errors[4], square=errors[4].square * 0.99 + 0.25 * 0.01, missing=0.01)
    assert only(sound(errors), "worst_views").level == "good"
    errors[4] = replace(errors[4], covered=errors[4].square)
    assert only(sound(errors), "worst_views").level == "usable"


@pytest.mark.parametrize(("missing", "level"), [(0.0001, "good"), (0.05, "usable"), (0.6, "unusable")])
def test_a_part_of_the_subject_that_the_field_lacks(missing: float, level: str) -> None:
    found = only(sound([error(i, missing=missing + i / 1e6) for i in range(20)]), "fit_missing")
    assert found.level == level
    assert found.views == (tuple(f"p{i}.jpg" for i in range(19, 7, -1)) if level == "unusable" else ())


@pytest.mark.parametrize(("beyond", "level"), [(0.0005, "good"), (0.1, "usable"), (0.3, "unusable")])
def test_a_field_where_the_masks_show_nothing(beyond: float, level: str) -> None:
    found = only(sound([error(i, beyond=beyond) for i in range(20)]), "fit_beyond")
    assert found.level == level and len(found.views) == (12 if level == "unusable" else 0)


@pytest.mark.parametrize(("last", "level"), [(37.4, "good"), (36.0, "usable"), (33.0, "unusable")])
def test_a_fit_that_ends_below_its_best(last: float, level: str) -> None:
    assert only(sound(history=(*RISING, last)), "psnr_fell").level == level


def test_histories_too_short_to_judge() -> None:
    for history in ((), (30.0,), (float("nan"), 30.0)):
        assert "psnr_fell" not in [f.check for f in findings(sound(history=history))]


@pytest.mark.parametrize(("wrong", "level"), [(0.035, "good"), (0.08, "usable"), (0.315, "unusable")])
def test_a_start_that_the_masks_contradict(wrong: float, level: str) -> None:
    facts: Any = {"relief": {**FACTS["relief"], "silhouette_error_of_prior": wrong}}
    assert only(sound(facts=facts), "start_silhouette").level == level
    sphere = sound(facts=facts | {"geometry": {"prior": PRIORS["sphere"]}})  # which is never the subject's shape
    assert "start_silhouette" not in [f.check for f in findings(sphere)]


@pytest.mark.parametrize(("left", "level"), [(0.054, "good"), (0.285, "usable"), (0.51, "unusable")])
def test_photos_that_disagree(left: float, level: str) -> None:
    facts = {"specular": {"modelled": True, "why": "cross-validation", "error_without": 1.4 * left, "error_with": left}}
    assert only(sound(facts=facts), "photos_agree").level == level


def test_matt_people_are_told_and_matt_stones_are_not() -> None:
    dull = {"specular": {"modelled": False, "why": "cross-validation", "error_without": 0.0545, "error_with": 0.054}}
    found = only(sound(facts=dull), "specular")
    assert found.level == "usable" and "F0" in found.said and "specular=on" in found.remedy
    assert only(sound(facts=dull, faces=2), "specular").level == "good"


def test_what_a_user_has_set_is_not_judged() -> None:
    facts = {k: {**v, "why": "setting"} for k, v in FACTS.items()}
    facts["specular"] |= {"modelled": False}
    assert not {"specular", "calibration"} & {f.check for f in findings(sound(facts=facts))}
    facts["specular"] = {"modelled": False, "why": "setting"}  # nothing was measured at all
    assert "photos_agree" not in {f.check for f in findings(sound(facts=facts))}


def test_no_pixels_at_all() -> None:
    assert "fit_error" not in [f.check for f in findings(sound([]))]


# ------------------------------------------------------------------ measured on small fits
def measured(t: Trainer, views: list[PhotoView] | None = None, **more: Any) -> tuple[ViewError, ...]:
    return view_errors(t.model, t.pixels, views or t.views, t.settings.image_side, t.settings.samples, **more)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return made_once(tmp_path_factory, "fit_of_the_ball", fit_of_the_ball)


def test_a_fit_keeps_its_history(ball: Trainer) -> None:
    assert len(ball.history) == 10 and ball.history[-1] == pytest.approx(ball.psnr)
    assert ball.history[0] < ball.history[-1] and all(np.isfinite(ball.history))


def test_measuring_changes_nothing(ball: Trainer) -> None:
    before = {k: v.clone() for k, v in ball.model.state_dict().items()}
    torch.manual_seed(5)
    drawn = torch.random.get_rng_state()
    first, second = measured(ball), measured(ball)
    assert first == second and torch.equal(drawn, torch.random.get_rng_state())
    assert all(torch.equal(v, before[k]) for k, v in ball.model.state_dict().items())


def test_errors_of_a_fitted_ball(ball: Trainer) -> None:
    errors = measured(ball)
    assert [e.index for e in errors] == [v.index for v in ball.views]
    for view, e in zip(ball.views[:2], errors, strict=False):  # the whole picture, compared pixel by pixel
        shown = predict_view(ball.model, view, 1, 8, "cpu")[..., :3]
        difference = (srgb_from_linear(shown.clip(0, 1)) - srgb_from_linear(view.rgb))[view.alpha > 0.99]
        assert e.square == pytest.approx(float((difference**2).mean()), rel=0.05)
        relative = np.sqrt(((shown - view.rgb)[view.alpha > 0.99] ** 2).mean()) / view.rgb[view.alpha > 0.99].mean()
        assert e.relative == pytest.approx(float(relative), rel=0.05)
        assert e.covered == pytest.approx(e.square, rel=0.1)
    assert all(e.missing < 0.02 and e.beyond < 0.05 and e.pixels > 300 for e in errors)


def test_the_photo_of_another_thing_is_found(ball: Trainer) -> None:
    """The same fit against photos of which one is upside down in its colours."""
    views = [replace(v, rgb=v.rgb[::-1, ::-1] * 1.5) if v.index == 4 else v for v in ball.views]
    other = new_trainer(views, ball_start(), SMALL, False, "cpu")
    errors = view_errors(ball.model, other.pixels, views, SMALL.image_side, SMALL.samples)
    assert min(errors, key=lambda e: e.psnr).index == 4
    assert only(replace(sound(), errors=errors), "worst_views").views == ("p4.jpg",)


def test_a_field_that_lacks_a_part_is_found(ball: Trainer) -> None:
    t = new_trainer(ball.views, ball_start(0.05), SMALL, False, "cpu")  # a ball of half the radius
    errors = measured(t)
    assert all(0.65 < e.missing < 0.85 for e in errors)
    assert only(replace(sound(), errors=errors), "fit_missing").level == "unusable"
    large = measured(new_trainer(ball.views, ball_start(0.13), SMALL, False, "cpu"))
    assert np.mean([e.beyond for e in large]) > 0.3 and all(e.missing == 0 for e in large)


def test_a_mask_that_lacks_half_of_the_subject_is_told_from_the_others(ball: Trainer) -> None:
    halved = [replace(v, alpha=v.alpha * (np.arange(64) < 32)) if v.index == 4 else v for v in ball.views]
    table = new_trainer(halved, ball_start(), SMALL, False, "cpu").pixels
    errors = view_errors(ball.model, table, halved, SMALL.image_side, SMALL.samples)
    assert all((e.beyond > 0.1) == (e.index == 4) for e in errors)


def test_a_mask_with_a_bright_piece_too_much_is_no_wrong_photo(ball: Trainer) -> None:
    strip = np.arange(64) < 6
    more = [replace(v, alpha=np.maximum(v.alpha, strip), rgb=np.where(strip[:, None], 1, v.rgb)) if v.index == 4 else v
            for v in ball.views]  # fmt: skip
    table = new_trainer(more, ball_start(), SMALL, False, "cpu").pixels
    for e in view_errors(ball.model, table, more, SMALL.image_side, SMALL.samples):
        assert (e.square > 20 * e.covered) == (e.index == 4) and e.psnr > 25


@pytest.mark.slow
def test_own_colours_are_taken_off() -> None:
    """A fit that has learnt the photos' gains of .7 to 1.3, measured with them and without."""
    t = trainer(calibrated=True, gains=lambda i: 0.7 + 0.055 * i)
    run_fit(t, hooks())
    knows = measured(t)
    t.model.spec = replace(t.model.spec, calibrated=False)
    without = measured(t)
    assert np.mean([e.psnr for e in knows]) > np.mean([e.psnr for e in without]) + 3


def test_noise_of_a_photo() -> None:
    view = ball_view(0)
    rng = np.random.default_rng(0)
    noisy = replace(view, rgb=(view.rgb * 0 + 0.5 + 0.03 * rng.normal(size=view.rgb.shape)).astype(np.float32))
    # sRGB's slope at 0.5: 1.055 / 2.4 x 0.5^(1 / 2.4 - 1) = 0.6587
    assert photo_noise(noisy, 64) == pytest.approx(0.03 * 0.6587, rel=0.15)
    wide = replace(noisy, alpha=np.ones_like(noisy.alpha))
    assert photo_noise(wide, 32) == pytest.approx(0.015 * 0.6587, rel=0.2)  # blocks of four pixels have half


def test_errors_by_label(ball: Trainer) -> None:
    """Left half one label, right half another, at twice the photo's size; only the right half's colours are wrong."""
    codes = np.zeros((128, 128), np.uint8)
    codes[:, :64], codes[:, 64:] = 2, 1
    wrong = []
    for v in ball.views:
        rgb = v.rgb.copy()
        rgb[:, 32:] = 0.9
        wrong.append(replace(v, rgb=rgb))
    table = new_trainer(wrong, ball_start(), SMALL, False, "cpu").pixels
    labels = [codes, *[None] * (len(wrong) - 1)]
    names = ("background", "subject", "face")
    first, second, *_ = view_errors(ball.model, table, wrong, 64, 8, labels, names)
    assert set(first.labels) == {"subject", "face"} and second.labels == {}
    assert first.labels["face"].square < 0.1 * first.labels["subject"].square
    pixels = first.labels["face"].pixels, first.labels["subject"].pixels
    assert sum(pixels) == first.pixels and min(pixels) > 0.4 * first.pixels


def test_nothing_in_the_photos(ball: Trainer) -> None:
    empty = [replace(v, alpha=np.zeros_like(v.alpha)) for v in ball.views]
    table = SimpleNamespace(**vars(new_trainer(ball.views, ball_start(), SMALL, False, "cpu").pixels))
    table.inside = table.inside[:0]
    assert view_errors(ball.model, table, empty, 64, 8) == ()  # type: ignore[arg-type]


@pytest.mark.parametrize("frame, words", [("flash", "flash"), ("turntable", "turns"), ("camera", "lamps")])
def test_a_light_that_moves_is_told(frame: str, words: str) -> None:
    facts = {"light_frame": {"frame": frame, "why": "cross-validation", "error_world": 0.4, f"error_{frame}": 0.2}}
    found = only(sound(facts=facts), "light_moves")
    assert found.level == "usable" and found.value == pytest.approx(0.5) and words in found.said
    still = {"light_frame": {"frame": "world", "why": "cross-validation", "error_world": 0.1, "error_flash": 0.2}}
    given = {"light_frame": facts["light_frame"] | {"why": "setting"}}
    for other in (still, given, {}):
        assert "light_moves" not in {f.check for f in findings(sound(facts=other))}


def flashed(fired: list[bool | None], frame: str = "flash") -> Fitted:
    """A fit of a flash on the camera, whose first photos say whether it fired."""
    fit = sound(facts={"light_frame": {"frame": frame, "why": "cross-validation"}})
    views = [v.model_copy(update={"flash": f}) for v, f in zip(fit.capture.views, fired, strict=False)]
    return replace(fit, capture=fit.capture.model_copy(update={"views": (*views, *fit.capture.views[len(fired) :])}))


@pytest.mark.parametrize(("dark", "level"), [(0, "good"), (2, "usable"), (6, "unusable")])
def test_photos_without_the_flash_that_is_modelled_are_named(dark: int, level: str) -> None:
    found = only(flashed([False] * dark + [True] * (12 - dark)), "flash_fired")
    assert found.level == level and found.value == pytest.approx(dark / 12, abs=1e-5)
    assert found.views == tuple(f"p{i}.jpg" for i in range(dark))


def test_exif_that_says_nothing_of_a_flash_or_of_none_is_no_contradiction() -> None:
    for fit in (flashed([None] * 12), flashed([False] * 12), flashed([False, True] * 6, "world")):
        assert "flash_fired" not in {f.check for f in findings(fit)}
