"""The learning rate of the light: where nothing tells the light, it moves no farther in a long fit than in a draft."""

from __future__ import annotations

import pytest

from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.model_selection import Choices
from stages.inverse_rendering.schedule import DRIFT_STEPS, KNOWN_LIGHT_RATE, UNIFORM_LIGHT_RATE
from tests.support.small_ball import SMALL, trainer


def light_rate(monkeypatch: pytest.MonkeyPatch, share: float, steps: int, *, known: bool = False) -> float:
    """Of a fit of so many steps at a share of them, over what the schedule of all parameters gives."""
    t = trainer(SMALL.changed(steps=steps, uniform_albedo_until=0.36))
    t.choices = Choices(True, 3, (0,), False, True, {}, known)
    t.enter_level()
    t.step = 100  # the rates have risen
    monkeypatch.setattr(Trainer, "share", lambda _: share)
    t.set_rates()
    light = next(t.model.light.parameters())
    (group,) = (g for g in t.optimiser.param_groups if g["params"][0] is light)
    return float(group["lr"] / group["start"] * 0.1 ** -max((share - 0.3) / 0.7, 0.0))


def test_a_light_that_nothing_tells_moves_as_far_as_in_a_draft(monkeypatch: pytest.MonkeyPatch) -> None:
    for share, draft in ((0.2, 1.0), (0.33, UNIFORM_LIGHT_RATE), (0.5, 1.0), (0.9, 1.0)):
        for steps in (200, DRIFT_STEPS):
            assert light_rate(monkeypatch, share, steps) == pytest.approx(draft)
        long = light_rate(monkeypatch, share, 4 * DRIFT_STEPS)
        assert long == pytest.approx(draft if share < 0.3 else draft / 4)


def test_a_light_that_moves_with_the_camera_is_told_by_the_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trainer, "light_moves", property(lambda _: True))
    assert light_rate(monkeypatch, 0.5, 4 * DRIFT_STEPS) == pytest.approx(1.0)


def test_a_known_light_has_its_own_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    for steps in (DRIFT_STEPS, 4 * DRIFT_STEPS):
        assert light_rate(monkeypatch, 0.33, steps, known=True) == 0
        assert light_rate(monkeypatch, 0.5, steps, known=True) == pytest.approx(KNOWN_LIGHT_RATE)
