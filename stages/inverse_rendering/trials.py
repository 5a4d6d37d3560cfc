"""Decisions during the fit are trials: one that makes the model worse is taken back.

A decision (`DECISIONS`) changes the model at once: parts are removed, a light is set, shadows are solved. Whether that
was right shows some steps later, in pixels that are not fitted (probe.py), a PSNR for each view:

1. Before a decision the state of the fit is kept and the PSNR of each view measured.
2. After its steps it is measured again. If the mean over the views has not fallen by more than half of what the
   decision may cost, and its standard error, nothing more happens.
3. Else the kept state is restored, and the same steps are done without the decision: the same batches, the same rates.
4. Both are compared, view by view. d: mean loss in dB by the decision, s its standard error over V views. The decision
   is taken back if d - t(V - 1) s > cost, with t the 95 % quantile of Student's distribution, and kept otherwise.

So a decision that costs nothing is taken back in at most one of twenty trials, however few the views are, and a fit in
which all goes well does no step twice. A kind of decision that was taken back once is later kept only if it makes the
model better, by the same test. What comes due while a trial is open belongs to both of its sides.

The views of a capture show one surface, so that their losses are not independent and s is a little too small; `cost` is
there for that too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

F64 = npt.NDArray[np.float64]
Fact = dict[str, str | float | bool]
State = dict[str, Any]

SELECTION, SHADOWS, SKIN, SMOOTHING = "model selection", "shadows", "light by the skin", "smoothing"
# dB that a decision may cost the photos for what it does to albedo, light and unseen surface, which the photos do not
# show (docs/model.md): light and albedo apart, 1 dB for 8 dB of albedo; light by the skin, .1 to 1.2 for 1 to 4.
DECISIONS: dict[str, float] = {SELECTION: 1.0, SHADOWS: 0.5, SKIN: 1.5, SMOOTHING: 0.5}
LENGTH = 0.03  # share of the fit after which a decision is judged
CONFIDENCE = 0.95
FEWEST_VIEWS = 2  # with one there is no standard error
OVER_AT = 0.8  # share of the fit at which the last decision is made


@dataclass(frozen=True, slots=True)
class Loss:
    """Mean loss in dB by a decision over the views, its standard error, and their number. inf: the model is not finite
    with the decision; nan: nothing is known."""

    mean: float
    error: float
    views: int

    def exceeds(self, cost: float) -> bool:
        """Whether the loss is more than `cost` dB, at CONFIDENCE."""
        if np.isinf(self.mean):
            return self.mean > 0
        return bool(self.mean - self._range() > cost)  # False for nan

    def gains(self) -> bool:
        """Whether the decision makes the model better, at CONFIDENCE."""
        return bool(self.mean + self._range() < 0)

    def _range(self) -> float:
        return float(stdtrit(self.views - 1, CONFIDENCE)) * self.error


def loss_between(without: F64, with_it: F64) -> Loss:
    """The loss from PSNR of each view (V,), NaN for views that are not judged and -inf where a model is not finite."""
    judged = ~np.isnan(without) & ~np.isnan(with_it)
    a, b = without[judged], with_it[judged]
    count = len(a)
    if count < FEWEST_VIEWS or not np.isfinite(a).all():
        return Loss(np.nan, np.nan, count)
    if not np.isfinite(b).all():
        return Loss(np.inf, np.nan, count)
    d = a - b
    return Loss(float(d.mean()), float(d.std(ddof=1) / np.sqrt(count)), count)


class Fit(Protocol):
    """What a trial needs of a running fit. kept: its whole state, which `recall` brings back; probe: PSNR (V,) of each
    view."""

    step: int
    spent: float

    def share(self) -> float: ...
    def kept(self) -> State: ...
    def recall(self, state: State) -> None: ...
    def probe(self) -> F64: ...


@dataclass(frozen=True, slots=True)
class Open:
    """A trial that is not over. begun: share of the fit at the decision, `step` its step; until: share at which it is
    judged. before: PSNR at the decision. strict: the decision has to make the model better. state: of the fit before
    the decision, {} once it is restored; other: that with the decision and its steps, {} until then; taken: its PSNR;
    end, ended: its step and share."""

    decision: str
    step: int
    begun: float
    until: float
    strict: bool
    before: list[float]
    state: State = field(default_factory=dict)
    other: State = field(default_factory=dict)
    taken: list[float] = field(default_factory=list)
    end: int = 0
    ended: float = 0.0

    @property
    def again(self) -> bool:
        """Whether the steps are being done without the decision."""
        return bool(self.other)


@dataclass(slots=True)
class Trials:
    """All trials of a fit. log: one entry each. share_from, spent_from: share of a fit with a time limit and its
    seconds when the last steps without a decision were over: the rest of the schedule has the rest of the time."""

    on: bool
    log: list[Fact] = field(default_factory=list)
    taken_back: list[str] = field(default_factory=list)
    open: Open | None = None
    over: bool = False
    share_from: float = 0.0
    spent_from: float = 0.0

    @property
    def withholds(self) -> bool:
        """Whether pixels are withheld from the fit."""
        return self.on and not self.over

    # ---------------------------------------------------------------- decisions
    def allows(self, fit: Fit, decision: str, until: float = 0.0, ignored: tuple[int, ...] = ()) -> bool:
        """Whether to take a decision now; begins its trial, if no other is open. until: share of the fit at which it is
        judged, LENGTH from now at the earliest. ignored: views whose PSNR now is not that of fitted ones."""
        if not self.on:
            return True
        if self.open is not None:
            here = self.open.again and (self.open.decision, self.open.step) == (decision, fit.step)
            return not here
        before = fit.probe()
        before[list(ignored)] = np.nan
        if (~np.isnan(before)).sum() < FEWEST_VIEWS:
            self._note(decision, fit.step, before, why=f"fewer than {FEWEST_VIEWS} views to judge it by")
            return True
        begun, strict = fit.share(), decision in self.taken_back
        until = max(until, begun + LENGTH)
        self.open = Open(decision, fit.step, begun, until, strict, before.tolist(), fit.kept())
        return True

    def withdraw(self, decision: str) -> None:
        """There was nothing to decide: end the trial that began with this decision, without an entry."""
        if self.open is not None and self.open.decision == decision and not self.open.again:
            self.open = None

    # ---------------------------------------------------------------- verdicts
    def settle(self, fit: Fit) -> None:
        """Judge the open trial if its steps are done; called before each step."""
        if self.open is None:
            self.over = self.over or fit.share() >= OVER_AT + LENGTH
        elif not self.open.again:
            if fit.share() >= self.open.until:
                self._doubt(fit, self.open)
        elif fit.step >= self.open.end:
            self._decide(fit, self.open)

    def finish(self, fit: Fit) -> None:
        """The fit is over: what is still open is not judged."""
        if self.open is not None:
            state, before = self.open.other, np.array(self.open.before)
            self._note(self.open.decision, self.open.step, before, why="the fit ended before it was judged")
            self.open = None
            if state:
                fit.recall(state)
        self.over = True

    def _doubt(self, fit: Fit, o: Open) -> None:
        """The steps with the decision are done: accept it, or do them again without it."""
        before, taken = np.array(o.before), fit.probe()
        fell = loss_between(before, taken)
        doubtful = np.isinf(fell.mean) or fell.mean - fell.error > DECISIONS[o.decision] / 2
        if not (doubtful or o.strict):
            self._note(o.decision, o.step, before, taken, why="no worse than before")
            self.open = None
            return
        after = replace(o, state={}, other=fit.kept(), taken=taken.tolist(), end=fit.step, ended=fit.share())
        fit.recall(o.state)
        self.open = after

    def _decide(self, fit: Fit, o: Open) -> None:
        """The steps without the decision are done too: keep the better of both."""
        without, taken = fit.probe(), np.array(o.taken)
        loss = loss_between(without, taken)
        keep = loss.gains() if o.strict else not loss.exceeds(DECISIONS[o.decision])
        why = "the same steps without it"
        self._note(o.decision, o.step, np.array(o.before), taken, without, loss, keep, why)
        self.open, self.share_from, self.spent_from = None, o.ended, fit.spent
        if keep:
            fit.recall(o.other)
            self.taken_back = [d for d in self.taken_back if d != o.decision]
        elif not o.strict:
            self.taken_back.append(o.decision)

    def _note(
        self,
        decision: str,
        step: int,
        before: F64,
        taken: F64 | None = None,
        without: F64 | None = None,
        loss: Loss | None = None,
        keep: bool = True,
        why: str = "",
    ) -> None:
        entry: Fact = {"decision": decision, "step": step, "kept": keep, "why": why, "before": _mean(before)}
        if taken is not None:
            entry["with"] = _mean(taken)
        if without is not None:
            entry["without"] = _mean(without)
        if loss is not None:
            entry |= {"loss": loss.mean, "standard_error": loss.error, "views": loss.views}
        self.log.append(entry)

    # ---------------------------------------------------------------- time
    def share(self, step: int, spent: float, allowance: float) -> float:
        """Finished share of a fit with a time limit. Steps that are done again have the shares of the first time."""
        o = self.open
        if o is not None and o.again:
            return o.begun + (o.ended - o.begun) * (step - o.step) / (o.end - o.step)
        left = allowance - self.spent_from
        return self.share_from + (1 - self.share_from) * (spent - self.spent_from) / left if left > 0 else 1.0

    # ---------------------------------------------------------------- report and checkpoints
    def facts(self) -> Fact:
        """For the report: each trial in one sentence; empty without trials."""
        if not self.on:
            return {}
        back = sum(not e["kept"] for e in self.log)
        out: Fact = {"count": len(self.log), "taken_back": back, "why": "withheld pixels of the fitted views"}
        return out | {f"{e['decision']} at step {e['step']}".replace(" ", "_"): sentence(e) for e in self.log}

    def stored(self) -> State:
        """For a checkpoint."""
        plain = {name: getattr(self, name) for name in ("log", "taken_back", "over", "share_from", "spent_from")}
        return {**plain, "open": _plain(self.open) if self.open is not None else None}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Inverse of `stored`."""
        for name in ("over", "share_from", "spent_from"):
            setattr(self, name, state[name])
        self.log, self.taken_back = [dict(e) for e in state["log"]], list(state["taken_back"])
        self.open = Open(**state["open"]) if state["open"] is not None else None


def sentence(entry: Fact) -> str:
    """An entry of the log in words."""
    parts = [f"{'kept' if entry['kept'] else 'taken back'} ({entry['why']}): {entry['before']:.2f} dB before"]
    parts += [f"{entry[k]:.2f} dB {k}" for k in ("with", "without") if k in entry]
    if "loss" in entry:
        cost = DECISIONS[str(entry["decision"])]
        parts.append(
            f"loss {entry['loss']:.2f} dB, standard error {entry['standard_error']:.2f} over {entry['views']} views, "
            f"{cost:g} allowed"
        )
    return ", ".join(parts)


def _mean(psnr: F64) -> float:
    known = psnr[~np.isnan(psnr)]
    return round(float(known.mean()), 4) if len(known) else float("nan")


def _plain(o: Open) -> dict[str, Any]:
    """As a dictionary; the tensors of the states are not copied."""
    return {name: getattr(o, name) for name in Open.__dataclass_fields__}
