"""A fit goes on from any of its steps as if nothing had happened: at the end of every phase, and in between."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.transforms import F64
from stages.inverse_rendering import fit
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initialise import new_trainer
from tests.support.balls import Ball, gloss, start

pytestmark = pytest.mark.slow

STEPS, BAND_EVERY, TOGETHER = 60, 25, 2
SMALL = Config(  # what a draft leaves to the evidence is left to it here; steps are few, so that all can be tried
    refine_geometry="on",
    refine_poses="on",
    follow_flow="on",
    weigh_photos=True,
    image_side=96,
    steps=STEPS,
    batch=256,
    samples=6,
    grid_cells=48,
    hash_log2_size=10,
    hash_levels=5,
    hash_fine=0.004,
    width=16,
)
# Before, at and after: warm steps, level, choices and the first shadows; light; settling; flow; other shadows; the end.
SAVED = (1, 17, 18, 19, 21, 22, 24, 25, 26, 29, 30, 31, 32, 33, 36, 37, 41, 42, 43, 45, 46, 49, 58)


def gains(view: int) -> F64:
    """Cameras that differ, so that colour matrices stay."""
    return np.full(3, 1 + 0.3 * (view % 3))


BALL = Ball(lobe=gloss(1), gain=gains, views=12)


def trainer() -> Trainer:
    """A ball with a lobe under a light, from a start that is too large."""
    return new_trainer(BALL.photos(), start(0.103), SMALL, True, "cpu", start(0.104))


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """All that a nested value holds, by a path."""
    if isinstance(value, dict | list | tuple):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(item, f"{name}/{key}")
    else:
        yield name, value.detach().numpy().tobytes() if isinstance(value, torch.Tensor) else repr(value)


def everything(t: Trainer) -> dict[str, Any]:
    """All that the rest of a fit depends on, what a checkpoint leaves out among it, and what is reported of it."""
    grid = t.grid
    counted = {name: getattr(t, name) for name in t.counted if name != "spent"}
    band = {"m": grid.m, "v": grid.v, "sink": grid.sink.view(-1)[grid.active], "moves": grid.values.requires_grad}
    rates = [group["lr"] for group in t.optimiser.param_groups]
    found = {"parts": t.parts(), "counted": counted, "band": band, "rates": rates, "history": t.history}
    return dict(leaves({**found, "uniform_albedo": t.model.uniform_albedo, "spec": repr(t.model.spec)}))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, dict[str, Any]]]:
    """A fit with a checkpoint after each step, and all of its state after those that others end at."""
    folder, states = tmp_path_factory.mktemp("steps"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "BAND_EVERY", BAND_EVERY)
        t = trainer()
        while t.step < STEPS:
            t.advance()
            t.save(folder / f"{t.step}.pt")
            states[t.step] = everything(t)
    choices = t.choices
    assert (
        choices is not None
        and choices.light_known
        and choices.specular
        and choices.calibrated
        and choices.refine_geometry
    )
    assert t.shadows_solved == 3 and t.level == 1 and not t.guard.dropped
    return folder, states


@pytest.mark.parametrize("saved", SAVED)
def test_it_goes_on_from_here(undisturbed: Any, saved: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each comes as far as another of them begins, so that together they show the rest of every one."""
    folder, states = undisturbed
    monkeypatch.setattr(fit, "BAND_EVERY", BAND_EVERY)
    end = min([s for s in SAVED if s >= saved + TOGETHER], default=STEPS)
    t = trainer()
    assert t.load(folder / f"{saved}.pt")
    while t.step < end:
        t.advance()
        got, want = everything(t), states[t.step]
        assert [k for k in want if got.get(k) != want[k]] == [] and got.keys() == want.keys(), f"after step {t.step}"
