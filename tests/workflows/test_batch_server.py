"""How a batch reads the states of a server's runs, what it asks of the server, the flow around it. No server here."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import httpx
import pytest
from prefect.client.schemas.objects import StateType

from pipeline.errors import StageError, UsageError
from workflows import flows
from workflows.batch import pool as pool_module
from workflows.batch.pool import Pool
from workflows.batch.request import BatchRequest
from workflows.batch.state import Entry, Summary
from workflows.run.run_lock import exclusive_run
from workflows.server.environment import SLOTS_ON_DISK


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    fake = Clock()
    monkeypatch.setattr(pool_module, "time", fake)
    return fake


@pytest.fixture
def pool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock) -> Pool:
    """A pool whose server answers nothing and says yes to all."""
    monkeypatch.setattr(
        pool_module, "get_current_settings", lambda: SimpleNamespace(api=SimpleNamespace(url="http://x"))
    )
    monkeypatch.setattr(Pool, "_prepare", lambda self: uuid4())
    made = Pool(BatchRequest(root="/r", out=str(tmp_path / "out"), lost_after=30, stage_limit=100))
    monkeypatch.setattr(Pool, "_patiently", lambda self, ask: None)
    return made


def look(pool: Pool, run: Any, state: StateType, message: str = "", name: str = "") -> Any:
    told = SimpleNamespace(message=message, name=name)
    return pool._look_at(run, SimpleNamespace(id=run.id, state_type=state, state=told))  # type: ignore[arg-type]


def new_run(pool: Pool, clock: Clock, name: str = "a") -> Any:
    request = pool.request.run_request(Path("/c"), name, (), {})
    return pool_module._Run(uuid4(), name, request, quiet_since=clock.now)


@pytest.mark.parametrize(
    ("state", "message", "kind"),
    [
        (StateType.COMPLETED, "", None),
        (StateType.FAILED, "Flow run encountered an exception: StageError: a bad photo", "capture"),
        (StateType.FAILED, "Flow run encountered an exception: DiskError: no space is left", "disk"),
        (StateType.FAILED, "Flow run encountered an exception: ConnectError: all attempts failed", "lost"),
        (StateType.FAILED, "Flow run encountered an exception: ZeroDivisionError: x", "bug"),
        (StateType.CRASHED, "Process exited with status code: -9.", "lost"),
        (StateType.CRASHED, "", "lost"),
        (StateType.CANCELLED, "", "bug"),
    ],
)
def test_ends(pool: Pool, clock: Clock, state: StateType, message: str, kind: str | None) -> None:
    ended = look(pool, new_run(pool, clock), state, message)
    assert (ended.fault.kind if ended.fault else None) == kind


@pytest.mark.parametrize(("name", "level"), [("Completed", "good"), ("Usable", "usable"), ("Unusable", "unusable")])
def test_the_name_of_a_completed_state_tells_the_verdict(pool: Pool, clock: Clock, name: str, level: str) -> None:
    ended = look(pool, new_run(pool, clock), StateType.COMPLETED, name=name)
    assert (ended.fault, ended.level) == (None, level)


def test_a_process_that_ended_itself_after_the_limit_hung(pool: Pool, clock: Clock) -> None:
    early, late = new_run(pool, clock), new_run(pool, clock)
    text = "Flow run process exited with non-zero status code 1."
    for run in (early, late):
        assert look(pool, run, StateType.RUNNING) is None
    assert look(pool, early, StateType.CRASHED, text).fault.kind == "lost"
    clock.now += 101
    assert look(pool, late, StateType.CRASHED, text.replace("code 1", "code 137")).fault.kind == "lost"
    assert look(pool, late, StateType.CRASHED, text).fault.kind == "limit"


def test_running_without_a_process_is_lost_after_a_while(pool: Pool, clock: Clock) -> None:
    run = new_run(pool, clock)
    assert look(pool, run, StateType.RUNNING) is None
    clock.now += 29
    assert look(pool, run, StateType.RUNNING) is None
    clock.now += 2
    assert look(pool, run, StateType.RUNNING).fault.kind == "lost"


def test_a_process_that_holds_the_lock_is_never_lost(pool: Pool, clock: Clock, tmp_path: Path) -> None:
    run = new_run(pool, clock)
    with exclusive_run(pool.request.store_path, Path(run.request.out), lambda: False, print):
        for _ in range(10):
            clock.now += 1000
            assert look(pool, run, StateType.RUNNING) is None
    clock.now += 31
    assert look(pool, run, StateType.RUNNING).fault.kind == "lost"


def test_waiting_in_the_queue_is_no_loss_but_never_starting_is(pool: Pool, clock: Clock) -> None:
    run = new_run(pool, clock)
    clock.now += 1e6
    assert look(pool, run, StateType.SCHEDULED) is None
    clock.now += 299
    assert look(pool, run, StateType.PENDING) is None  # a container may have to be fetched
    clock.now += 299
    assert look(pool, run, StateType.PENDING) is None
    clock.now += 2
    assert look(pool, run, StateType.PENDING).fault.kind == "lost"


def test_a_server_that_is_away_is_asked_again_and_not_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    @contextmanager
    def client(sync_client: bool) -> Any:
        yield None

    monkeypatch.setattr(pool_module, "get_client", client)
    answers = iter([httpx.ConnectError("refused"), httpx.ReadTimeout("slow"), 7])

    def ask(_: Any) -> int:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    assert Pool._patiently(None, ask) == 7  # type: ignore[arg-type]
    begin = clock.now

    def never(_: Any) -> int:
        raise httpx.ConnectError("refused")

    with pytest.raises(StageError, match="does not answer"):
        Pool._patiently(None, never)  # type: ignore[arg-type]
    assert pool_module.AWAY <= clock.now - begin < pool_module.AWAY + 60


def test_a_server_that_forgets_who_holds_a_slot_is_told(
    pool: Pool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Client:
        def request(self, *_: str) -> Any:
            return SimpleNamespace(json=lambda: {"server": {"concurrency": {"lease_storage": f"prefect.{self.kept}"}}})

        def upsert_global_concurrency_limit_by_name(self, name: str, slots: int) -> None:
            assert (name, slots) == ("neuface-fits", 2)

        kept = "memory"

    client = Client()
    monkeypatch.setattr(Pool, "_patiently", lambda self, ask: ask(client))
    pool._limit("neuface-fits", 2)
    assert SLOTS_ON_DISK[0] in caplog.text
    caplog.clear()
    client.kept = "filesystem"
    pool._limit("neuface-fits", 2)
    assert caplog.text == ""


def test_as_many_runs_at_a_time_as_a_chunk_has(pool: Pool) -> None:
    assert pool.slots == pool.request.chunk == 50


def test_without_a_server_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_module, "get_current_settings", lambda: SimpleNamespace(api=SimpleNamespace(url=None)))
    with pytest.raises(UsageError, match="PREFECT_API_URL"):
        Pool(BatchRequest(root="/r", out="/o"))


# ------------------------------------------------------------------ the flow
@pytest.mark.parametrize("failed", [0, 1])
def test_the_batch_flow_fails_when_a_capture_has_no_asset(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, failed: int
) -> None:
    states = ["failed"] * failed + ["done"] * 2
    summary = Summary([Entry(name=f"{i}", capture="/c", state=s) for i, s in enumerate(states)])  # type: ignore[arg-type]
    asked: list[BatchRequest] = []
    monkeypatch.setattr(pool_module, "Pool", lambda request: None)
    monkeypatch.setattr("workflows.batch.loop.run_batch", lambda request, *a, **k: (asked.append(request), summary)[1])
    monkeypatch.setattr(flows, "report_batch", lambda out, counts: None)
    if failed:
        with pytest.raises(RuntimeError, match="1 of 3 captures have no asset"):
            flows.facescape_batch.fn(root="/r", out=str(tmp_path), gpus=2)
    else:
        assert flows.facescape_batch.fn(root="/r", out=str(tmp_path), gpus=2)["done"] == 2
    assert asked[0].gpus == 2 and asked[0].fit_slots == "neuface-fits"


@pytest.mark.parametrize(("level", "strict", "name"), [("unusable", False, "Unusable"), ("usable", True, "Unusable"),
                                                      ("usable", False, None), ("good", True, None)])  # fmt: skip
def test_the_batch_flow_ends_in_a_state_of_its_own_when_results_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, level: Any, strict: bool, name: str | None
) -> None:
    state = "unusable" if level == "unusable" else "done"
    summary = Summary([Entry(name="0", capture="/c", state=state, level=level)])  # type: ignore[arg-type]
    monkeypatch.setattr(pool_module, "Pool", lambda request: None)
    monkeypatch.setattr("workflows.batch.loop.run_batch", lambda request, *a, **k: summary)
    monkeypatch.setattr(flows, "report_batch", lambda out, counts: None)
    ended = flows.facescape_batch.fn(root="/r", out=str(tmp_path), strict=strict)
    assert getattr(ended, "name", None) == name
    if name is not None:
        assert ended.is_completed() and "1 of 1 results" in ended.message
