"""Another time for a run that goes on: a preset or a time budget, chosen on its page or by keys in its terminal.

The stage at work stops at its next checkpoint, and the run goes on as the same command with the new setting would:
finished stages with the same key come from the store, and the fit starts again from its initial geometry under a key of
its own. So the result, and what the store keeps it as, are those of a run that had this setting from the beginning. The
checkpoint of the fit that was left stays, for a return to the earlier setting.

A budget counts from the moment in which it is chosen, as for a command that is started then.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

from pipeline.contract import Done, execute
from pipeline.errors import Cancelled, NeufaceError
from stages.presets import DEFAULT_PRESET
from workflows.run.estimate import expected
from workflows.run.plan import Plan, make_plan
from workflows.run.request import RunRequest
from workflows.run.runner import Around, ExecuteStage, run_stages
from workflows.run.session import Session
from workflows.run.spare_page import put_page_back
from workflows.run.steering import BUDGET, PRESET


def run_as_asked(
    plan: Plan,
    watch: Session,
    execute_stage: ExecuteStage = execute,
    around: Around = lambda *_: nullcontext(),
) -> tuple[Plan, list[Done[Any]]]:
    """As `run_stages`, and with every change that the user makes meanwhile. Returns the plan that was carried out, and
    what was done. Raises as `run_stages`."""
    steering = watch.steering
    put_page_back(plan)
    with steering.open_to_changes():
        while True:
            made: list[str] = []
            try:
                done = run_stages(plan, _noting(watch, made.append), execute_stage, around)
            except Cancelled:
                if watch.asked_to_stop() or steering.change is None:
                    raise
                done = []
            change = steering.take_change()
            if change is None:
                return plan, done
            changed = changed_plan(plan, change, made, watch.observer.note)
            if changed is None and done:
                return plan, done
            plan = changed or replace(plan, anew=plan.anew - set(made))
            if plan.request.budget is not None and changed is not None:
                watch = replace(watch, begun=time.monotonic() - steering.waited())
            seconds = {e.step.stage: e.seconds for e in expected(plan)}
            watch.observer.replanned(seconds, plan.request)


def changed_plan(plan: Plan, change: str, made: list[str], notify: Callable[[str], None]) -> Plan | None:
    """The plan with another preset or budget; None, with a word to the user, where it is no change or can't be made.
    made: stages that this run has made, which are not made anew again."""
    request = changed_request(plan.request, change)
    if request == plan.request:
        notify(f"the run has this setting already: {in_words(request)}")
        return None
    try:
        found = make_plan(request)
    except NeufaceError as e:
        notify(f"the setting can't be changed, and the run goes on as before: {e}")
        return None
    notify(f"from now on: {in_words(request)}; the fit starts again, finished stages are reused")
    return replace(found, anew=plan.anew - set(made))


def changed_request(request: RunRequest, change: str) -> RunRequest:
    """The request with another setting of time. change: as `steering.is_change` takes it."""
    kind, _, value = change.partition(" ")
    known: dict[str, dict[str, str | None]] = {
        PRESET: {"preset": value, "budget": None},
        BUDGET: {"preset": DEFAULT_PRESET, "budget": value},
    }
    return RunRequest(**{**request.model_dump(), **known[kind]})


def in_words(request: RunRequest) -> str:
    """ "preset studio", "10 min in all"."""
    return f"preset {request.preset}" if request.budget is None else f"{request.budget / 60:g} min from now on"


def _noting(watch: Session, note: Callable[[str], object]) -> Session:
    """The session whose observer also tells which stages are done."""
    observer: Any = _Noting(watch.observer, note)
    return replace(watch, observer=observer)


class _Noting:
    """An Observer in front of another one."""

    def __init__(self, inner: Any, note: Callable[[str], object]) -> None:
        self._inner, self._note = inner, note

    def finished(self, done: Done[Any]) -> None:
        """The stage is done."""
        self._note(done.stage)
        self._inner.finished(done)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)
