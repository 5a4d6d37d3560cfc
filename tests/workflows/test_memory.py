"""A stage that does not fit into the memory says how much it needs and what to set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import MemoryLimitError, StageError
from stages.registry import REGISTRY
from tests.support.toy_stages import SECOND
from workflows.run import memory
from workflows.run.memory import LIGHTER, free_mb, needed_mb, remedy
from workflows.run.plan import Plan, make_plan
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages
from workflows.run.session import Session


class Told:
    """An Observer that keeps the notes."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def plan_of(photos: Path, *sets: str) -> Plan:
    return make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out"), sets=sets))


@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize(
    "error",
    [MemoryError("Unable to allocate 3.0 GiB"), RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"),
     RuntimeError("DefaultCPUAllocator: can't allocate memory"), RuntimeError("std::bad_alloc")],
)  # fmt: skip
def test_a_stage_that_ran_out_says_what_it_needs_and_what_to_set(
    photos: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(memory, "needed_mb", lambda *_: 3 * 1024.0)
    monkeypatch.setattr(memory, "free_mb", lambda: 1.5 * 1024)
    monkeypatch.setitem(LIGHTER, "second", "second.steps")

    def executed(stage: Any, *_: Any, **__: Any) -> Any:
        raise error

    with pytest.raises(MemoryLimitError, match="the stage first ran out of memory") as caught:
        run_stages(plan_of(photos), Session(Told()), executed)  # type: ignore[arg-type]
    told = str(caught.value)
    assert "about 3.0 GB is needed" in told and "1.5 GB free when it began" in told and "--preset draft" in told
    assert caught.value.exit_code == 1 and str(error)[:20] in told


@pytest.mark.usefixtures("toys")
def test_other_errors_stay_what_they_are(photos: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        run_stages(plan_of(photos, "second.fault=bug"))
    with pytest.raises(StageError, match="the toy is broken"):
        run_stages(plan_of(photos, "second.fault=stage"))


@pytest.mark.usefixtures("toys")
def test_it_is_told_before_the_stage_and_not_of_stored_results(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "peak_memory_mb", lambda: 100.0)
    monkeypatch.setattr(memory, "needed_mb", lambda *_: 2048.0)
    for plus, free, notes in ((1, 2048.0 - 100.0, 0), (2, 2048.0 - 101.0, 3), (2, 1.0, 0)):  # the last: all is stored
        monkeypatch.setattr(memory, "free_mb", lambda free=free: free)
        told = Told()
        run_stages(plan_of(photos, f"first.plus={plus}"), Session(told))  # type: ignore[arg-type]
        assert len([n for n in told.notes if "GB of memory" in n]) == notes, free
        assert all("2.0 GB of memory, and 1.9 GB are free" in n for n in told.notes if "GB of memory" in n)


@pytest.mark.usefixtures("toys")
def test_the_need_is_that_of_earlier_runs_else_of_the_preset(photos: Path) -> None:
    plan = plan_of(photos)
    assert needed_mb(plan, SECOND.name, plan.configs["second"]) == memory.MEMORY_MB["draft"]
    run_stages(plan)
    peak = needed_mb(plan, SECOND.name, plan.configs["second"])
    assert peak is not None and 10 < peak < 100_000 and peak != memory.MEMORY_MB["draft"]


def test_a_control_group_may_have_less_than_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free_memory_mb", lambda: 8000.0)
    assert free_mb(tmp_path) == 8000.0
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("1048576\n")
    assert free_mb(tmp_path) == 8000.0
    (tmp_path / "memory.max").write_text(f"{3 * 2**30}\n")
    assert free_mb(tmp_path) == 3 * 1024 - 1
    monkeypatch.setattr(memory, "free_memory_mb", lambda: None)
    assert free_mb(tmp_path / "none") is None


def test_every_setting_that_is_named_exists() -> None:
    stages = {s.name: s for s in REGISTRY}
    for stage, text in LIGHTER.items():
        words = [w.strip(",") for w in text.split() if "." in w]
        assert words and all(w.split(".")[1] in stages[w.split(".")[0]].config.model_fields for w in words), stage
        assert text in remedy(stage)
    assert "--preset draft" in remedy("report")
