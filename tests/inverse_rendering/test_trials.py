"""Trials of decisions: their test, their states, and fits in which a decision is made up."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from pipeline.fields.face import FaceModel
from pipeline.transforms import F64
from stages.inverse_rendering.fit import Trainer
from stages.inverse_rendering.initialise import new_trainer
from stages.inverse_rendering.trials import DECISIONS, LENGTH, OVER_AT, SHADOWS, SKIN, Loss, Trials, loss_between
from tests.inverse_rendering.test_resume import BALL, SMALL, everything
from tests.support.balls import start

VIEWS, SEEDS = (2, 3, 6, 20, 42), 20
COST = DECISIONS[SHADOWS]


# ------------------------------------------------------------------ the test of a loss
@pytest.mark.parametrize("views", VIEWS)
def test_it_is_the_paired_t_test(views: int) -> None:
    """Against scipy's: taken back where its one-sided p value is below .05, on both sides of the limit."""
    generator, agreed = np.random.default_rng(views), set()
    for _ in range(50):
        without = generator.normal(25, 3, views)
        with_it = without - generator.normal(COST + 0.3, 0.4, views)
        p = stats.ttest_1samp(without - with_it, COST, alternative="greater").pvalue
        better = stats.ttest_1samp(without - with_it, 0, alternative="less").pvalue
        loss = loss_between(without, with_it)
        assert loss.exceeds(COST) == (p < 0.05) and loss.gains() == (better < 0.05)
        assert loss_between(with_it, without).gains() == (
            stats.ttest_1samp(with_it - without, 0, alternative="less").pvalue < 0.05
        )
        agreed.add(loss.exceeds(COST))
    assert agreed == {True, False} or views == 42


def simulated(loss: float, views: int, seed: int) -> Loss:
    """PSNR of views that differ by 3 dB from each other, and by .5 dB in what a decision costs them."""
    generator = np.random.default_rng([seed, views])
    without = generator.normal(24, 3, views)
    return loss_between(without, without - loss + generator.normal(0, 0.5, views))


@pytest.mark.parametrize("views", VIEWS)
def test_error_rates_on_simulated_views(views: int) -> None:
    """Twenty seeds: a loss of just what is allowed is taken back in 5 % of the cases, one without loss never, and a
    loss of 4 dB nearly always from three views on; two views have a range of six standard errors."""
    back = sum(simulated(COST, views, seed).exceeds(COST) for seed in range(SEEDS))
    assert back <= 3  # more has a probability of 1.6 % at 5 %
    assert not any(simulated(-0.5, views, seed).exceeds(COST) for seed in range(SEEDS)) or views == 2
    found = sum(simulated(4.0, views, seed).exceeds(COST) for seed in range(SEEDS))
    assert found == SEEDS if views > 3 else found >= SEEDS / 2
    assert sum(simulated(-4.0, views, seed).gains() for seed in range(SEEDS)) >= SEEDS / 2


def test_the_rate_of_the_test_is_five_percent() -> None:
    """10,000 trials of a decision that costs just what it may: 5 %, standard error .2 %."""
    generator = np.random.default_rng(0)
    for views in (2, 6, 42):
        costs = COST + generator.normal(0, 0.5, (10_000, views))
        rate = np.mean([loss_between(c, np.zeros(views)).exceeds(COST) for c in costs])
        assert rate == pytest.approx(0.05, abs=0.008), views


@pytest.mark.parametrize(
    ("without", "with_it", "back"),
    [
        ([25.0], [5.0], False),  # one view: no standard error
        ([], [], False),
        ([25.0, np.nan], [5.0, np.nan], False),  # one of two views is judged
        ([25.0, 24.0], [5.0, 4.0], True),  # alike in all views: no standard error is left
        ([25.0, 24.0], [25.0, 24.0], False),
        ([25.0, 24.0], [-np.inf, 24.0], True),  # not finite with the decision
        ([-np.inf, 24.0], [20.0, 19.0], False),  # not finite without it
        ([-np.inf, 24.0], [-np.inf, 4.0], False),
    ],
)
def test_the_loss_at_its_extremes(without: list[float], with_it: list[float], back: bool) -> None:
    loss = loss_between(np.array(without), np.array(with_it))
    assert loss.exceeds(COST) is back and not loss.gains()


# ------------------------------------------------------------------ the course of a trial
@dataclass
class Made:
    """A fit that is one number, the PSNR in dB of all its views. Each step brings it nearer to `best`, and the views'
    own differences stay. spread: dB, of what a step does to single views."""

    steps: int = 100
    step: int = 0
    spent: float = 0.0
    level: float = 20.0
    best: float = 26.0
    damaged: float = 0.0
    views: int = 8
    done: list[tuple[int, bool]] = field(default_factory=list)  # steps that were done, with the decision or not

    def share(self) -> float:
        return self.step / self.steps

    def kept(self) -> dict[str, Any]:
        return {"step": self.step, "level": self.level, "best": self.best, "damaged": self.damaged}

    def recall(self, state: dict[str, Any]) -> None:
        for name, value in copy.deepcopy(state).items():
            setattr(self, name, value)

    def probe(self) -> F64:
        each = np.random.default_rng(self.step).normal(0, 0.05, self.views)
        return np.asarray(self.level - self.damaged + np.arange(self.views) + each, np.float64)

    def run(self, trials: Trials, at: dict[int, tuple[str, Any]], until: int | None = None) -> None:
        """Steps, with decisions at some of them: their names, and what they do to the fit."""
        taken = set()
        while self.step < (self.steps if until is None else until):
            trials.settle(self)
            if self.step in at:
                name, act = at[self.step]
                if trials.allows(self, name):
                    act(self)
                    taken.add(self.step)
                else:
                    taken.discard(self.step)
            self.level += 0.02 * (self.best - self.level)
            self.step += 1
            self.spent += 1.0
            self.done.append((self.step, bool(taken)))
        trials.finish(self)


def hurts(fit: Made) -> None:
    fit.damaged += 8.0


def helps(fit: Made) -> None:
    fit.best += 4.0


def jolts(fit: Made) -> None:
    """Less than it may cost."""
    fit.level -= 0.2


def test_what_hurts_is_taken_back() -> None:
    fit, without, trials = Made(), Made(), Trials(True)
    fit.run(trials, {50: (SHADOWS, hurts)})
    without.run(Trials(False), {})
    assert fit.kept() == without.kept()
    (entry,) = trials.log
    assert not entry["kept"] and entry["loss"] == pytest.approx(8.0, abs=0.2) and entry["views"] == 8
    assert [s for s, _ in fit.done].count(51) == 2 and len(fit.done) == 100 + round(100 * LENGTH)
    assert trials.facts()["taken_back"] == 1 and "taken back" in str(trials.facts()["shadows_at_step_50"])


@pytest.mark.parametrize("act", [helps, jolts])
def test_what_helps_or_costs_little_stays_and_no_step_is_done_twice(act: Any) -> None:
    fit, free, trials = Made(), Made(), Trials(True)
    fit.run(trials, {50: (SHADOWS, act)})
    free.run(Trials(False), {50: (SHADOWS, act)})
    assert fit.kept() == free.kept() and len(fit.done) == 100
    assert trials.log[0]["kept"] and "without" not in trials.log[0]


def test_a_fall_that_comes_without_the_decision_too_is_not_its_fault() -> None:
    """The photos become harder to show at the same step: the steps are done again, and the decision stays."""

    class Falls(Made):
        def probe(self) -> F64:
            return Made.probe(self) - (5.0 if self.step > 50 else 0.0)

    fit, trials = Falls(), Trials(True)
    fit.run(trials, {50: (SHADOWS, helps)})
    assert trials.log[0]["kept"] and "without" in trials.log[0] and fit.best == 30.0
    assert len(fit.done) == 100 + round(100 * LENGTH) and not trials.taken_back


def test_a_second_one_has_to_make_it_better() -> None:
    """After shadows were taken back once, a solve that changes nothing is not kept, and one that helps is."""
    for act, kept in ((jolts, False), (hurts, False), (helps, True)):
        fit, trials = Made(), Trials(True)

        def strongly(fit: Made, act: Any = act) -> None:
            act(fit)
            if act is helps:
                fit.level += 2.0

        fit.run(trials, {50: (SHADOWS, hurts), 70: (SHADOWS, strongly)})
        assert [e["kept"] for e in trials.log] == [False, kept]
        assert (SHADOWS in trials.taken_back) is not kept


def test_what_comes_due_while_a_trial_is_open_belongs_to_both_sides() -> None:
    fit, trials = Made(), Trials(True)
    fit.run(trials, {50: (SHADOWS, hurts), 51: (SKIN, helps)})
    assert len(trials.log) == 1 and fit.damaged == 0 and fit.best == 30.0


@pytest.mark.parametrize("views", [0, 1])
def test_too_few_views_decide_nothing(views: int) -> None:
    fit, trials = Made(views=views), Trials(True)
    fit.run(trials, {50: (SHADOWS, hurts)})
    assert fit.damaged == 8.0 and len(fit.done) == 100 and trials.log[0]["kept"]
    assert "fewer than 2 views" in str(trials.facts()["shadows_at_step_50"])


def test_a_model_that_is_not_finite_is_taken_back() -> None:
    class Breaks(Made):
        def probe(self) -> F64:
            found = Made.probe(self)
            if self.damaged:
                found[3] = -np.inf
            return found

    fit, trials = Breaks(), Trials(True)
    fit.run(trials, {50: (SHADOWS, hurts)})
    assert fit.damaged == 0 and not trials.log[0]["kept"]


def test_off_asks_nothing() -> None:
    fit, trials = Made(), Trials(False)
    fit.run(trials, {50: (SHADOWS, hurts)})
    assert fit.damaged == 8.0 and not trials.log and not trials.withholds and trials.facts() == {}


def test_a_fit_that_ends_early_keeps_what_was_decided() -> None:
    fit, trials = Made(), Trials(True)
    fit.run(trials, {50: (SHADOWS, hurts)}, until=52)
    assert fit.damaged == 8.0 and trials.open is None and "ended" in str(trials.log[0]["why"])
    again, trials = Made(), Trials(True)
    again.recall(fit.kept() | {"step": 50, "damaged": 0.0})
    trials.allows(again, SHADOWS)
    hurts(again)
    again.step = 53
    trials.settle(again)
    assert again.step == 50 and again.damaged == 0
    trials.finish(again)
    assert again.damaged == 8.0


def test_pixels_are_withheld_until_the_last_trial_is_over() -> None:
    fit, trials = Made(steps=100), Trials(True)
    assert trials.withholds
    while fit.share() < OVER_AT + LENGTH:
        trials.settle(fit)
        assert trials.withholds
        fit.step += 1
    trials.settle(fit)
    assert not trials.withholds


def test_a_time_limit_counts_both_sides() -> None:
    """Shares go on without a jump after the steps that were done twice, and the rest of the time is what is left."""
    trials, allowance, seen = Trials(True), 100.0, []

    class Timed(Made):
        def share(self) -> float:
            return trials.share(self.step, self.spent, allowance)

    fit = Timed(steps=1000)
    while fit.share() < 1:
        trials.settle(fit)
        seen.append((fit.step, fit.share()))
        if fit.step == 50 and trials.allows(fit, SHADOWS):
            hurts(fit)
        fit.step, fit.spent = fit.step + 1, fit.spent + 1.0
    shares = dict(seen)
    ordered = [shares[step] for step in sorted(shares)]
    assert (np.diff(ordered) > 0).all() and fit.spent == 100 and fit.damaged == 0
    assert fit.step == 97 and max(np.diff(ordered)) < 0.012
    first = [share for step, share in seen if step == 52]
    assert len(first) == 2 and first[0] == pytest.approx(first[1])


# ------------------------------------------------------------------ in a fit
def ball() -> Trainer:
    """A ball with a lobe under a light, as for resumed fits, with trials."""
    return new_trainer(BALL.photos(), start(0.103), SMALL.changed(trials="on"), True, "cpu", start(0.104))


def spoiled(model: FaceModel) -> None:
    """Shadows everywhere, from the second time on."""
    assert model.shadowing is not None
    if bool(model.shadowing.solved):
        model.shadowing.ratio.fill_(0.02)
    model.shadowing.solved.fill_(True)


def unsolved(model: FaceModel) -> None:
    """No shadows."""
    assert model.shadowing is not None
    model.shadowing.solved.fill_(True)


@pytest.mark.slow
def test_a_state_comes_back_bit_by_bit() -> None:
    """Before the selection, at an old size of the model, and after it: all that the rest of the fit depends on."""
    t, states, kept = ball(), {}, {}
    while t.step < 36:
        t.advance()
        if t.step in (17, 22, 34):
            states[t.step], kept[t.step] = everything(t), t.kept()
    t.trials.open = None
    for step in (34, 17, 34, 22):
        t.recall(kept[step])
        assert t.step == step
        got, want = everything(t), states[step]
        left = {k for k in want if got.get(k) != want[k] and not k.startswith("/parts/trials")}
        assert left - {"/uniform_albedo"} == set()
        while t.step < step + 2 and step != 34:  # and the fit goes on from it
            t.advance()


@pytest.mark.slow
def test_shadows_that_spoil_a_fit_are_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit ends with the bytes of one that never took the decision."""
    monkeypatch.setattr(FaceModel, "solve_shadows", spoiled)
    t = ball()
    while t.share() < 0.68:
        t.advance()
    entry = next(e for e in t.trials.log if e["decision"] == SHADOWS)
    assert not entry["kept"] and float(entry["loss"]) > COST and entry["step"] == 30
    monkeypatch.setattr(FaceModel, "solve_shadows", unsolved)
    free = ball()
    while free.share() < 0.68:
        free.advance()
    got, want = everything(t), everything(free)
    assert [k for k in want if not k.startswith("/parts/trials") and got[k] != want[k]] == []


@pytest.mark.slow
def test_a_fit_goes_on_from_inside_of_a_trial(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Stopped at every step of one, also while they are done again, it ends as one that was not stopped."""
    monkeypatch.setattr(FaceModel, "solve_shadows", spoiled)
    whole, stopped, path = ball(), ball(), tmp_path / "checkpoint.pt"
    seen = set()
    while whole.share() < 0.6:
        whole.advance()
    while stopped.share() < 0.6:
        stopped.advance()
        o = stopped.trials.open
        seen.add("no trial" if o is None else f"{o.decision}, {'again' if o.again else 'first'}")
        if stopped.step >= 29:
            stopped.save(path)
            stopped = ball()
            assert stopped.load(path)
    assert {f"{SHADOWS}, first", f"{SHADOWS}, again"} <= seen
    got, want = everything(stopped), everything(whole)
    assert [k for k in want if got[k] != want[k]] == ["/parts/trials/spent_from"]  # seconds, for a time limit alone
    assert got.keys() == want.keys()


@pytest.mark.slow
def test_no_trial_damages_a_sound_fit() -> None:
    t = ball()
    while t.share() < 1:
        t.advance()
    t.finish()
    assert t.trials.log and all(math.isfinite(float(e["before"])) for e in t.trials.log)
    assert t.judged is None and not t.trials.withholds
