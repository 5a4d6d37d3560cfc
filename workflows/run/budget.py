"""`--budget 10m`: how large a fit the time pays for on this machine.

Before the fit begins the machine is timed for some seconds on a ball (workflows.run.calibration_scene). What is left
of the budget by then, less what the stages after the fit will take, is the fit's; the finest rung of `RUNGS` that this
time fills with rays is chosen. The fit then ends by the clock, so that an estimate that was wrong costs accuracy and
not the deadline.

A plan is kept in the store beside what it is for: an interrupted run uses it again.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipeline.store import Store, write_synced
from stages.inverse_rendering.config import Config, Preset
from stages.presets import PRESETS
from stages.registry import FIT

PLANS = ".budgets"  # in the store
DRAFT_RATE = 45_000.0  # rays/s of the ball at the draft's settings on the machine on which `after` was measured
START_UP = 4.0  # seconds of loading before the session's clock starts, on that machine
MIN_FIT = 20.0  # seconds that a fit gets on that machine whatever the budget: less leaves nothing to use
TEMPLATE = 75.0  # seconds more for the stages after the fit, on that machine, of a person made from the head template
CALIBRATION = 6.0  # seconds of timed steps; about ten with what is built for them


@dataclass(frozen=True, slots=True)
class Rung:
    """A size of fit and of all that follows it.

    rays: below so many the rung under this one is more accurate. rate: of the draft's rays/s. before: seconds of the
    fit's stage that are not training; after: seconds of the stages behind it without the head template; both on the
    machine of DRAFT_RATE.
    """

    name: str
    settings: dict[str, dict[str, Any]]
    rays: float
    rate: float
    before: float
    after: float


SIZES = ("image_side", "grid_cells", "levels", "batch", "samples", "hash_fine", "hash_log2_size")  # of a fit


def _of(preset: Preset, **changes: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The sizes of a preset by stage, some of them changed."""
    fit = Config(preset=preset)
    sizes = {**PRESETS[preset], FIT: {name: getattr(fit, name) for name in SIZES}}
    return {stage: {**own, **changes.get(stage, {})} for stage, own in sizes.items()}


COARSE = {
    FIT: {"image_side": 256, "grid_cells": 192},
    "surface": {"resolution": 192},
    "uv": {"target_faces": 20_000},
    "bake": {"size": 512},
}
FINE = {FIT: {"image_side": 768}, "uv": {"target_faces": 50_000}}
RUNGS = (
    Rung("coarse", _of("draft", **COARSE), 0, 1.1, 25, 55),
    Rung("draft", _of("draft"), 4e6, 1.0, 35, 85),
    Rung("fine", _of("studio", **FINE), 2e7, 1.0, 45, 130),
    Rung("studio", _of("studio"), 3e7, 1.0, 60, 155),
    Rung("film", _of("film"), 1e8, 0.6, 200, 600),
)


@dataclass(frozen=True, slots=True)
class BudgetPlan:
    """What was decided: a rung, the fit's seconds, the pace that was measured (rays/s), and whether it all fits."""

    rung: str
    seconds: float
    pace: float
    fits: bool

    def settings(self) -> dict[str, dict[str, Any]]:
        """For the stages from the fit on."""
        chosen = next(r for r in RUNGS if r.name == self.rung)
        return {**chosen.settings, FIT: {**chosen.settings[FIT], "seconds": self.seconds}}

    def describe(self, budget: float) -> str:
        """A line for the user."""
        size = self.settings()
        text = (
            f"budget {budget:.0f} s at {self.pace:,.0f} rays/s: photos of {size[FIT]['image_side']} px, "
            f"{size[FIT]['grid_cells']} cells, maps of {size['bake']['size']} px; the fit gets {self.seconds:.0f} s"
        )
        return text if self.fits else text + "; the least that leaves an asset takes longer than the budget"


def choose(left: float, pace: float, more: float = 0.0) -> BudgetPlan:
    """Rung and seconds of the fit's stage where the run has `left` seconds, on a machine of `pace` rays/s. more:
    seconds that the stages behind the fit take beside a rung's own, on the machine of DRAFT_RATE."""
    slower = DRAFT_RATE / pace
    for rung in reversed(RUNGS):
        stage = left - slower * (rung.after + more)
        if (stage - slower * rung.before) * pace * rung.rate >= rung.rays:
            break
    least = slower * (MIN_FIT + rung.before)
    return BudgetPlan(rung.name, round(max(stage, least), 1), round(pace), stage >= least)


def calibrate(device: str) -> float:
    """Rays/s of this machine at the draft's settings, on the ball."""
    from workflows.run.calibration_scene import WHOLE, ball_trainer

    settings = Config(**WHOLE)
    trainer = ball_trainer(8, 256, settings.grid_cells, settings, device)
    trainer.advance()  # loads what the first step needs
    begun, steps = time.perf_counter(), 0
    while time.perf_counter() - begun < CALIBRATION:
        trainer.advance()
        steps += 1
    return settings.batch * steps / (time.perf_counter() - begun)


def planned(
    store: Store, purpose: Mapping[str, Any], left: float, device: str, *, from_template: bool = False
) -> BudgetPlan:
    """The stored plan of the same request and the same earlier stages, else a new one. from_template: the asset is
    probably made from the head template."""
    path = _path(store, purpose)
    try:
        return BudgetPlan(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        begun = time.monotonic()
        pace = calibrate(device)
        found = choose(left - (time.monotonic() - begun), pace, TEMPLATE if from_template else 0.0)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    write_synced(partial, json.dumps(asdict(found)))
    partial.replace(path)
    return found


def _path(store: Store, purpose: Mapping[str, Any]) -> Path:
    describe = json.dumps(dict(purpose), sort_keys=True, default=str).encode()
    return store.root / PLANS / f"{hashlib.sha256(describe).hexdigest()}.json"
