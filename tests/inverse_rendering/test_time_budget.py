"""Fits by the clock: they end when their time is up, do everything that a fit in steps does, and go on after a stop."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.artifacts import Camera
from pipeline.errors import Cancelled
from stages.inverse_rendering import time_budget, training_loop
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.paper.config import PaperConfig
from stages.inverse_rendering.stage import Config
from stages.inverse_rendering.time_budget import FINER, seconds_to_predict
from stages.inverse_rendering.training_loop import run_fit
from tests.support.small_ball import SMALL, ball_view, hooks, trainer

TICK = 0.25  # seconds between two looks at the clock
STEPS = 60


@pytest.fixture
def ticking(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A step takes one tick, whatever the machine does."""
    ticks = count()
    monkeypatch.setattr(training_loop, "time", SimpleNamespace(monotonic=lambda: TICK * next(ticks)))
    yield


def by_clock() -> Trainer:
    t = trainer(SMALL.changed(steps=7, seconds=99.0))  # neither is what counts: the stage sets the allowance
    t.allowance = STEPS * TICK
    return t


@pytest.mark.slow
def test_the_fit_ends_with_its_time(ticking: None) -> None:
    t = by_clock()
    assert t.share() == 0 and t.total() > 0
    run_fit(t, hooks())
    assert t.step == STEPS and t.share() == 1 and t.total() == STEPS
    assert t.choices is not None and t.shadows_solved == 3 and t.level == 1


@pytest.mark.slow
def test_an_interrupted_fit_has_the_rest_of_its_time(ticking: None, tmp_path: Path) -> None:
    whole = by_clock()
    run_fit(whole, hooks())
    checks = iter(range(10_000))
    with pytest.raises(Cancelled):
        run_fit(by_clock(), hooks(tmp_path / "c.pt", lambda: next(checks) == 22))
    rest = by_clock()
    rest.allowance = 1.0  # what this start of the stage would have left: the fit's own stays
    run_fit(rest, hooks(tmp_path / "c.pt"))
    assert rest.step == STEPS and rest.allowance == STEPS * TICK
    for (name, a), (_, b) in zip(whole.model.state_dict().items(), rest.model.state_dict().items(), strict=True):
        assert (a == b).all(), name


@pytest.mark.slow
def test_the_pace_so_far_tells_the_total(ticking: None) -> None:
    t = by_clock()
    for _ in range(20):
        t.advance()
    assert t.share() == pytest.approx(20 / STEPS) and t.total() == STEPS


def test_rendering_the_held_out_views_is_kept_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten times the rays that are timed take ten times as long, and views of no pixels none."""
    times = iter([0.0, 5.0, 5.0, 7.0])  # the first call loads; the second counts
    monkeypatch.setattr(time_budget, "time", SimpleNamespace(monotonic=lambda: next(times)))
    t = trainer()
    view = ball_view(5)
    camera = Camera(
        index=5,
        name="5",
        width=64,
        height=64,
        K=tuple(map(tuple, view.K)),
        world_from_cam=tuple(map(tuple, view.world_from_cam)),
        distortion=(0.0,) * 5,
    )
    assert seconds_to_predict(t.model, [camera] * 10, SMALL, "cpu") == pytest.approx(FINER * 2.0 * 10)
    assert seconds_to_predict(t.model, [], SMALL, "cpu") == 0.0


def test_the_papers_schedule_has_no_clock() -> None:
    with pytest.raises(ValueError, match="counts epochs"):
        PaperConfig(seconds=60.0)
    assert np.isclose(Config(seconds=60.0).seconds, 60.0)
