"""A picture of a running fit shows photo and model side by side, and changes nothing of the fit."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from stages.inverse_rendering import training_loop
from stages.inverse_rendering.preview import SHOWN, Preview, frontal
from stages.inverse_rendering.time_budget import Clock
from stages.inverse_rendering.training_loop import Hooks, run_fit
from tests.support.small_ball import SMALL, ball_view, hooks, trainer


def digest(model: Any) -> str:
    """Of all parameters and buffers."""
    h = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        h.update(name.encode() + value.detach().cpu().numpy().tobytes())
    return h.hexdigest()


def show(name: str, make: Any) -> float:
    make()
    return 0.5


def test_the_view_from_the_front_is_shown() -> None:
    views = [ball_view(i) for i in (3, 6, 11, 9)]
    assert frontal(views).index == 11  # 30 degrees beside +Z; the others 90 and more
    assert frontal(list(reversed(views))).index == 11


def test_it_shows_the_photo_and_beside_it_the_model() -> None:
    t = trainer()
    picture = Preview(t.views, show, "cpu").picture(t.model)
    assert picture.shape == (SHOWN, 2 * SHOWN, 3) and picture.dtype == np.uint8
    photo, model = picture[:, :SHOWN].astype(int), picture[:, SHOWN:].astype(int)
    middle = SHOWN // 2
    left, right = photo[middle, middle - 60], photo[middle, middle + 60]
    assert right[0] > right[2] and left[2] > left[0]  # +X is red and to the right of a view from the front
    corner = model[4, 4]
    assert np.ptp(corner) <= 1 and 80 < corner[0] < 120  # the grey behind the ball
    assert np.abs(model[middle, middle] - corner).max() > 20  # a ball there


def test_nothing_of_the_fit_changes(monkeypatch: Any) -> None:
    """With a picture after every step: the same bytes. 0.5 s are said to be taken, which only a time limit counts."""
    settings, stepped = SMALL.changed(steps=40), []
    plain = trainer(settings)
    run_fit(plain, hooks())
    clock = iter(float(i) for i in range(10**6))
    monkeypatch.setattr(training_loop.time, "monotonic", lambda: next(clock))  # a second a call: a picture a step
    watched = trainer(settings)
    preview = Preview(watched.views, lambda name, make: stepped.append(name) or show(name, make), "cpu")
    before = torch.random.get_rng_state()
    run_fit(watched, replace(hooks(), preview=preview))
    assert len(stepped) == settings.steps
    assert digest(watched.model) == digest(plain.model)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert watched.spent > 0.5 * settings.steps


def test_a_limit_counts_the_pictures() -> None:
    t = trainer(SMALL)
    t.allowance = 3.0
    run_fit(t, Hooks(lambda *a, **k: None, lambda: False, None, lambda model: 2.5))
    alone = trainer(SMALL)
    alone.allowance = 3.0
    run_fit(alone, hooks())
    assert t.step < alone.step


def test_a_stopwatch_stands_still_while_the_run_is_paused() -> None:
    waited = [0.0]
    clock = Clock(lambda: waited[0])
    waited[0] = 100.0
    assert clock.elapsed() < -99
