"""Slots of the server's limit: who holds one, what a server that is away costs, what a wait is not."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import httpx
import pytest

from pipeline.contract import inputs_from, key
from pipeline.errors import Cancelled, StageError
from tests.support.points import wait_for
from tests.support.toy_stages import TOYS, source
from workflows.run import runner
from workflows.run.plan import make_plan
from workflows.run.request import RunRequest
from workflows.server import adapter, concurrency


def refused(status: int) -> httpx.HTTPStatusError:
    request = httpx.Request("POST", "http://x")
    return httpx.HTTPStatusError("no", request=request, response=httpx.Response(status, request=request))


class Server:
    """Answers as its script says, and as a server with a free slot once that is over."""

    def __init__(self, *script: Exception) -> None:
        self.script, self.lease, self.asked = list(script), uuid4(), list[str]()

    def _answer(self, what: str) -> None:
        self.asked.append(what)
        if self.script:
            raise self.script.pop(0)

    def increment_concurrency_slots_with_lease(self, names: list[str], slots: int, mode: str, lease: float) -> Any:
        self._answer("take")
        found = [{"name": n} for n in names if n != "none"]
        return SimpleNamespace(json=lambda: {"lease_id": str(self.lease), "limits": found})

    def renew_concurrency_lease(self, lease: UUID, seconds: float) -> None:
        assert lease == self.lease
        self._answer("renew")

    def release_concurrency_slots_with_lease(self, lease: UUID) -> None:
        assert lease == self.lease
        self._answer("give back")


@pytest.fixture
def serving(monkeypatch: pytest.MonkeyPatch) -> Any:
    for name, value in {"ASK": 0.01, "RENEW": 0.02}.items():
        monkeypatch.setattr(concurrency, name, value)

    def begin(*script: Exception) -> Server:
        server = Server(*script)

        @contextmanager
        def client(sync_client: bool) -> Iterator[Server]:
            yield server

        monkeypatch.setattr(concurrency, "get_client", client)
        return server

    return begin


AWAY, TAKEN = httpx.ConnectError("refused"), refused(423)


def test_a_slot_is_waited_for_kept_and_given_back(serving: Any) -> None:
    server = serving(TAKEN, AWAY, refused(503), TAKEN)
    with concurrency.slot("gpus", lambda: False):
        assert [a for a in server.asked if a != "renew"] == ["take"] * 5  # on a busy machine renewing has begun
        wait_for(lambda: server.asked.count("renew") >= 2)
    assert server.asked[-1] == "give back"
    seen = len(server.asked)
    time.sleep(0.1)
    assert len(server.asked) == seen, "nobody renews what was given back"


def test_a_server_that_is_away_costs_neither_the_slot_nor_the_fit(serving: Any) -> None:
    server = serving()
    with concurrency.slot("gpus", lambda: False):
        server.script = [AWAY] * 4
        wait_for(lambda: server.asked.count("renew") >= 6)
        server.script = [refused(410)]  # it took the slot back: the fit goes on
        wait_for(lambda: not server.script)
        server.script = [AWAY, AWAY]
    assert server.asked[-3:] == ["give back"] * 3


def test_a_server_that_stays_away_is_not_waited_for_for_ever(
    serving: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"GIVE_BACK": 0.3, "AWAY": 0.2}.items():
        monkeypatch.setattr(concurrency, name, value)
    server = serving()
    with concurrency.slot("gpus", lambda: False):
        server.script = [AWAY] * 10_000
    assert "free again in 300 s" in caplog.text
    with pytest.raises(httpx.ConnectError), concurrency.slot("gpus", lambda: False):
        pytest.fail("there was no slot")


def test_no_such_limit_is_no_leave_to_run_without(serving: Any) -> None:
    serving()
    with pytest.raises(StageError, match="does not exist"), concurrency.slot("none", lambda: False):
        pytest.fail("there was no slot")
    serving(refused(401))
    with pytest.raises(httpx.HTTPStatusError), concurrency.slot("gpus", lambda: False):
        pytest.fail("there was no slot")


def test_ctrl_c_ends_the_wait(serving: Any) -> None:
    server = serving(*[TAKEN] * 1000)
    with pytest.raises(Cancelled), concurrency.slot("gpus", lambda: len(server.asked) > 3):
        pytest.fail("there was no slot")


# ------------------------------------------------------------------ in a run
@pytest.mark.usefixtures("toys")
def test_the_fit_holds_a_slot_and_nothing_else_does(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[str] = []

    @contextmanager
    def slot(name: str, stopped: Any) -> Iterator[None]:
        held.append(name)
        yield

    monkeypatch.setattr(adapter, "slot", slot)
    monkeypatch.setattr(adapter, "FIT", "first")
    request = RunRequest(capture=str(photos), out=str(photos.parent / "out"), fit_slots="gpus")
    plan = make_plan(request)
    inputs = inputs_from(TOYS[0], {"source": source(photos)})
    around, config = adapter.with_slot(plan, lambda: False), plan.configs["first"]
    with around(TOYS[0], inputs, config):
        assert held == ["gpus"]
    stored = plan.store.folder("first", key(TOYS[0], inputs, plan.configs["first"]))
    stored.mkdir(parents=True)
    (stored / "manifest.json").write_text("{}")
    with around(TOYS[0], inputs, config):  # nothing will be computed
        assert len(held) == 1
    with around(TOYS[1], inputs, plan.configs["second"]):
        assert len(held) == 1
    without = replace(plan, request=request.model_copy(update={"fit_slots": None}))
    with adapter.with_slot(without, lambda: False)(TOYS[0], inputs, config):
        assert len(held) == 1


@pytest.mark.usefixtures("toys")
def test_the_wait_for_a_slot_does_not_count_as_a_hang(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage's clock starts when the slot is there."""
    order: list[str] = []

    @contextmanager
    def noted(name: str, *rest: Any) -> Iterator[None]:
        order.append(name)
        yield

    monkeypatch.setattr(adapter, "slot", noted)
    monkeypatch.setattr(runner, "time_limit", noted)
    monkeypatch.setattr(adapter, "FIT", "first")
    request = RunRequest(capture=str(photos), out=str(photos.parent / "out"), fit_slots="gpus", stage_limit=60)
    plan = make_plan(request)
    assert not any(d.reused for d in runner.run_stages(plan, around=adapter.with_slot(plan, lambda: False)))
    assert order == ["gpus", "first", "second", "third"]
