"""Another preset or budget while a run goes on: the result is that of a run that had it from the beginning."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import Cancelled
from stages.presets import PRESETS
from tests.support.points import wait_for
from tests.support.steered import Recorded, in_thread, plan_of
from workflows.cli.console import Console
from workflows.cli.keys import TIMES, Keys
from workflows.live.look import look_at
from workflows.live.publisher import told_live
from workflows.live.wishes import ask
from workflows.run import changes
from workflows.run.changes import run_as_asked
from workflows.run.plan import Plan, make_plan
from workflows.run.publish import publish
from workflows.run.run_lock import exclusive_run
from workflows.run.runner import run_stages
from workflows.run.session import Session
from workflows.run.steering import Steering, is_wish


@pytest.fixture
def studio_adds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A preset studio that changes a setting of the second toy."""
    monkeypatch.setitem(PRESETS, "studio", {**PRESETS["studio"], "second": {"plus": 5}})


SLOW = ("second.steps=40", "second.pause=0.02")


def changed_run(plan: Plan, watch: Session, *wishes: str) -> dict[str, Any]:
    """run.json of a run that is asked for another time when its second stage is at work; each wish when the one
    before it was taken."""
    found: list[dict[str, Any]] = []

    def work() -> None:
        with exclusive_run(plan.store.root, plan.out, watch.stopped, print), told_live(plan, watch) as told:
            carried_out, done = run_as_asked(plan, told)
            found.append(publish(carried_out, done, told.observer.note, told.asked_to_stop))

    thread, errors = in_thread(work)
    for number, wish in enumerate(wishes, 1):
        wait_for(lambda: look_at(plan.out).state.get("percent", 0) > 0 and _at_work(plan, "second"))
        assert ask(plan.out, wish)
        wait_for(lambda n=number: _answers(watch) >= n)
    thread.join(60)
    assert errors == []
    return found[0]


def _answers(watch: Session) -> int:
    said = [str(t) for t in watch.observer.told]  # type: ignore[attr-defined]
    return sum("setting" in t or "from now on" in t for t in said)


def _at_work(plan: Plan, stage: str) -> bool:
    return any(s["name"] == stage and s["state"] == "running" for s in look_at(plan.out).state.get("stages", []))


def manifests(plan: Plan, record: dict[str, Any]) -> list[tuple[str, bytes]]:
    root = plan.store.root
    return [(s["key"], (root / n / s["key"] / "manifest.json").read_bytes()) for n, s in record["stages"].items()]


def test_another_preset_gives_the_bytes_of_a_run_that_had_it_from_the_start(
    photos: Path, toys: None, studio_adds: None
) -> None:
    plan, watch = plan_of(photos, sets=SLOW), Session(Recorded())
    record = changed_run(plan, watch, "preset studio")
    assert record["request"]["preset"] == "studio" and record["stages"]["first"]["reused"]
    assert watch.observer.told.count("first") == 2  # type: ignore[attr-defined]
    fresh = make_plan(plan.request.model_copy(update={"preset": "studio", "out": str(photos.parent / "fresh")}))
    other = publish(fresh, run_stages(fresh))
    assert manifests(plan, record) == manifests(fresh, other)
    draft = make_plan(plan.request.model_copy(update={"out": str(photos.parent / "draft")}))
    assert manifests(draft, publish(draft, run_stages(draft)))[1] != manifests(fresh, other)[1]


def test_there_and_back_goes_on_from_the_checkpoint(photos: Path, toys: None, studio_adds: None) -> None:
    plan, watch = plan_of(photos, sets=("second.steps=100", "second.pause=0.02")), Session(Recorded())
    record = changed_run(plan, watch, "preset studio", "preset draft")
    assert record["request"]["preset"] == "draft"
    made = plan.store.folder("second", record["stages"]["second"]["key"])
    assert 0 < len(list(made.glob("part*.bin"))) < 100  # the steps before were not made again
    fresh = make_plan(plan.request.model_copy(update={"out": str(photos.parent / "fresh")}))
    assert manifests(plan, record) == manifests(fresh, publish(fresh, run_stages(fresh)))


def test_a_budget_counts_from_when_it_is_chosen(photos: Path, toys: None, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[float | None, float]] = []

    def within(plan: Plan, done: list[Any], watch: Session) -> Plan:
        asked.append((plan.request.budget, watch.elapsed()))
        return plan

    monkeypatch.setattr("workflows.run.runner.FIT", "third")
    monkeypatch.setattr("workflows.run.runner.within_budget", within)
    plan = plan_of(photos, sets=SLOW)
    watch = Session(Recorded(), begun=time.monotonic() - 1000)
    record = changed_run(plan, watch, "budget 600")
    assert (record["request"]["budget"], record["request"]["preset"]) == (600, "draft")
    assert len(asked) == 1 and asked[0][0] == 600 and asked[0][1] < 900


def test_what_is_no_change_costs_nothing_and_what_can_not_be_goes_on(
    photos: Path, toys: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, watch = plan_of(photos, sets=("second.steps=60", "second.pause=0.02")), Session(Recorded())
    monkeypatch.setitem(PRESETS, "studio", {"second": {"plus": -7}})  # outside the setting's limits
    record = changed_run(plan, watch, "preset draft", "preset studio")
    said = " ".join(map(str, watch.observer.told))  # type: ignore[attr-defined]
    assert "has this setting already" in said and "goes on as before" in said
    assert record["request"]["preset"] == "draft"
    fresh = make_plan(plan.request.model_copy(update={"out": str(photos.parent / "fresh")}))
    assert manifests(plan, record) == manifests(fresh, publish(fresh, run_stages(fresh)))


def test_a_run_that_takes_no_change_goes_on(photos: Path, toys: None) -> None:
    """A batch's captures have one setting."""
    watch = Session(Recorded())
    watch.steering.wish("preset studio")
    assert watch.steering.change is None and len(run_stages(plan_of(photos), watch)) == 3


def test_a_stop_is_a_stop_though_a_change_was_asked_for(
    photos: Path, toys: None, studio_adds: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both while the stages run: the run ends, and nothing is made or said of the change."""
    plan, recorded = plan_of(photos, sets=SLOW), Recorded()
    watch, calls = Session(recorded), list[Plan]()

    def interrupted(plan: Plan, *_: object) -> None:
        assert not calls, "the run goes on"
        calls.append(plan)
        watch.steering.wish("preset studio")
        watch.stop.set()
        assert watch.stopped() and watch.steering.change
        raise Cancelled

    monkeypatch.setattr(changes, "run_stages", interrupted)
    with pytest.raises(Cancelled):
        run_as_asked(plan, watch)
    assert not recorded.told


@pytest.mark.parametrize(
    "wish", ["preset none", "preset", "budget", "budget 1", "budget 1e9", "budget nan", "budget x"]
)
def test_only_known_presets_and_sound_budgets_are_wishes(wish: str, tmp_path: Path) -> None:
    assert not is_wish(wish)
    with pytest.raises(ValueError, match="none of"):
        ask(tmp_path, wish)


def test_keys_choose_another_time() -> None:
    import io

    stream, steering = io.StringIO(), Steering()
    keys = Keys(steering, Console(stream), None)
    keys.press("b")  # this run takes no change
    assert stream.getvalue() == ""
    with steering.open_to_changes():
        for typed, change in (("bx", None), ("b2", "preset studio"), ("b5", "budget 600"), ("B1", "preset draft")):
            for key in typed:
                keys.press(key)
            assert steering.take_change() == change
        keys.press("2")
        assert steering.change is None and not steering.pausing
    assert all(is_wish(x) for x in TIMES.values())
