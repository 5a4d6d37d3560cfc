"""Which requests the guard before a Prefect server lets through, and which runs are called lost. No server here."""

from __future__ import annotations

import asyncio
import os
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import httpx
import pytest
from prefect.client.schemas.objects import StateType
from prefect.exceptions import ObjectNotFound

from workflows.server import life
from workflows.server.environment import SLOTS_ON_DISK
from workflows.server.guard import SIGN, Guard, Signs
from workflows.server.lost import LOOK, QUICK_START, SLOW_START, Lost
from workflows.server.own_server import names_of, prepare, reachable

OWN = "127.0.0.1:4200"


class Inside:
    """The server behind the guard: says what reached it."""

    def __init__(self, status: int = 200) -> None:
        self.status = status
        self.reached: list[str] = []

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self.reached.append(scope["type"])
        if scope["type"] == "http":
            await send({"type": "http.response.start", "status": self.status, "headers": []})
            await send({"type": "http.response.body", "body": b"inside"})


def guard(inside: Inside, signs: Signs | None = None) -> Guard:
    return Guard(inside, names_of("127.0.0.1", ["pool.example"]), ["http://localhost:4200"], signs or Signs())


def ask(
    app: Guard, headers: dict[str, str], path: str = "/api/x", kind: str = "http", method: str = "GET"
) -> list[dict[str, Any]]:
    """What the client gets."""
    sent: list[dict[str, Any]] = []

    async def send(message: Any) -> None:
        sent.append(dict(message))

    async def receive() -> Any:
        return {"type": "http.request", "body": b""}

    raw = [(k.lower().encode(), v.encode("latin-1")) for k, v in headers.items()]
    asyncio.run(app({"type": kind, "path": path, "method": method, "headers": raw}, receive, send))
    return sent


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": OWN}, 200),
        ({"Host": "LOCALHOST:4200"}, 200),
        ({"Host": "[::1]:4200"}, 200),
        ({"Host": "pool.example"}, 200),  # behind a proxy
        ({"Host": OWN, "Origin": f"http://{OWN}"}, 200),
        ({"Host": OWN, "Origin": "http://localhost:4200"}, 200),
        ({"Host": "pool.example", "Origin": "https://pool.example"}, 200),
        ({"Host": OWN, "Sec-Fetch-Site": "same-origin"}, 200),
        ({}, 421),
        ({"Host": "evil.example:4200"}, 421),
        ({"Host": "127.0.0.1.evil.example"}, 421),
        ({"Host": "127.0.0.1@evil.example"}, 421),
        ({"Host": "evil.example#127.0.0.1"}, 421),
        ({"Host": "127.0.0.1:x"}, 421),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, 421),  # rebinding: a page of its own origin
        ({"Host": OWN, "Origin": "http://evil.example"}, 403),
        ({"Host": OWN, "Origin": "null"}, 403),
        ({"Host": OWN, "Origin": ""}, 403),
        ({"Host": OWN, "Origin": "http://127.0.0.1:8000"}, 403),  # another server of this machine
        ({"Host": OWN, "Origin": "http://localhost:4200.evil.example"}, 403),
        ({"Host": OWN, "Sec-Fetch-Site": "cross-site"}, 403),
        ({"Host": OWN, "Sec-Fetch-Site": "same-site"}, 403),
    ],
)
def test_only_requests_of_its_own_page_and_programs_pass(headers: dict[str, str], status: int) -> None:
    for method in ("GET", "POST", "OPTIONS"):
        inside = Inside()
        answer = ask(guard(inside), headers, method=method)
        assert answer[0]["status"] == status and bool(inside.reached) == (status == 200)
        assert (b"x-frame-options", b"DENY") in answer[0]["headers"]
        assert "allow-origin" not in str(answer[0]["headers"])
    inside = Inside()
    answer = ask(guard(inside), headers, kind="websocket")
    assert [m["type"] for m in answer] == ([] if status == 200 else ["websocket.close"])


def test_a_link_from_elsewhere_opens_the_page_and_not_the_api() -> None:
    link = {"Host": OWN, "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert [ask(guard(Inside()), link, path)[0]["status"] for path in ("/", "/runs", "/api", "/api/flows")] == [
        200, 200, 403, 403]  # fmt: skip


def test_what_is_no_request_passes() -> None:
    inside = Inside()
    ask(guard(inside), {}, kind="lifespan")
    assert inside.reached == ["lifespan"]


def test_a_sign_of_life_counts_once_the_server_has_accepted_it() -> None:
    run, now = uuid4(), [5.0]
    headers = {"Host": OWN, SIGN: "1"}
    for path, status, sent, method, noted in (
        (f"/api/flow_runs/{run}", 200, headers, "GET", True),
        (f"/api/flow_runs/{run}", 401, headers, "GET", False),  # without the login
        (f"/api/flow_runs/{run}", 200, {"Host": OWN}, "GET", False),  # the page looks at the run
        (f"/api/flow_runs/{run}", 200, headers, "PATCH", False),
        (f"/api/flow_runs/{run}/graph", 200, headers, "GET", False),
    ):
        signs = Signs(lambda: now[0])
        ask(guard(Inside(status), signs), sent, path, method=method)
        assert signs.last(run) == (5.0 if noted else float("-inf"))


def test_names_of_a_server_and_the_address_to_call_it_by() -> None:
    assert [reachable(h) for h in ("0.0.0.0", "::", "::1", "10.0.0.5")] == ["127.0.0.1", "[::1]", "[::1]", "10.0.0.5"]
    assert names_of("10.0.0.5", ["pool"]) == ["pool", "10.0.0.5", "127.0.0.1", "localhost", "[::1]"]


def test_the_server_keeps_slots_on_disk_and_its_page_calls_it_by_the_first_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in (SLOTS_ON_DISK[0], "PREFECT_UI_API_URL", "PREFECT_SERVER_API_HOST", "PREFECT_SERVER_API_PORT"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    prepare("0.0.0.0", 4200, names_of("0.0.0.0", ["127.0.0.1", "server"]))
    assert os.environ[SLOTS_ON_DISK[0]] == SLOTS_ON_DISK[1]
    assert os.environ["PREFECT_UI_API_URL"] == "http://127.0.0.1:4200/api"


# ------------------------------------------------------------------ lost runs
class Server:
    """A server with these runs; `away`: it answers nothing."""

    def __init__(self, *runs: SimpleNamespace) -> None:
        self.runs, self.away, self.now = list(runs), False, 0.0
        self.marked: dict[UUID, str] = {}

    @contextmanager
    def __call__(self) -> Any:
        yield self

    def read_flow_runs(self, *, flow_filter: Any, flow_run_filter: Any, limit: int, offset: int) -> list[Any]:
        if self.away:
            raise httpx.ConnectError("away")
        assert set(flow_filter.name.any_) == {"capture-to-asset", "facescape-batch"}
        wanted = flow_run_filter.state.type.any_
        return [r for r in self.runs if r.state_type in wanted][offset : offset + limit]

    def set_flow_run_state(self, run: UUID, state: Any, force: bool) -> None:
        assert state.type == StateType.CRASHED and force
        self.marked[run] = state.message
        next(r for r in self.runs if r.id == run).state_type = StateType.CRASHED

    def read_work_pool(self, name: str) -> Any:
        if name == "deleted":
            raise ObjectNotFound(Exception())
        return SimpleNamespace(type=name)


def a_run(state: StateType = StateType.RUNNING, pool: str | None = "docker") -> SimpleNamespace:
    return SimpleNamespace(id=uuid4(), name="x", state_type=state, work_pool_name=pool)


def watched(server: Server) -> tuple[Lost, Signs]:
    signs = Signs(lambda: server.now)
    return Lost(server, signs, 60.0), signs  # type: ignore[arg-type]


def test_a_silent_run_is_marked_and_one_that_speaks_is_not() -> None:
    silent, speaks, done, late = a_run(), a_run(), a_run(StateType.COMPLETED), a_run(StateType.CANCELLING)
    server = Server(silent, speaks, done)
    lost, signs = watched(server)
    for second in range(0, 121, 10):
        server.now = second
        if second == 50:
            server.runs.append(late)
        signs.note(speaks.id)
        marked = lost.look()
        assert marked == {70: [silent.id], 120: [late.id]}.get(second, [])
    assert "finished stages are kept" in server.marked[silent.id] and "70 s" in server.marked[silent.id]


def test_a_run_that_waits_for_its_process_gets_more_time_and_then_starts_anew() -> None:
    run = a_run(StateType.PENDING)
    server = Server(run)
    lost, _ = watched(server)
    for second, state, marked in (
        (0, StateType.PENDING, False),
        (60 * SLOW_START, StateType.PENDING, False),
        (60 * SLOW_START + 1, StateType.RUNNING, False),
        (60 * SLOW_START + 61, StateType.RUNNING, False),
        (60 * SLOW_START + 62, StateType.RUNNING, True),
    ):
        server.now, run.state_type = second, state
        assert bool(lost.look()) == marked, second


@pytest.mark.parametrize(
    ("pool", "times"),
    [("process", QUICK_START), (None, QUICK_START), ("docker", SLOW_START), ("kubernetes", SLOW_START),
     ("deleted", SLOW_START)],
)  # fmt: skip
def test_a_run_that_a_worker_took_is_lost_after_the_time_that_its_kind_of_pool_needs(
    pool: str | None, times: float
) -> None:
    """In a pool of processes within two minutes, with the default of 60 s and a look every 5 s."""
    assert 60.0 * QUICK_START + LOOK < 120.0
    run = a_run(StateType.PENDING, pool)
    server = Server(run)
    lost, _ = watched(server)
    for second in (0.0, 60.0 * times):
        server.now = second
        assert lost.look() == [], second
    server.now = 60.0 * times + 1.0
    assert lost.look() == [run.id]


def test_nothing_is_judged_by_the_time_in_which_the_server_was_away() -> None:
    run = a_run()
    server = Server(run)
    lost, _ = watched(server)
    lost.look()
    server.away, server.now = True, 1000.0
    assert lost.look() == []
    server.away, server.now = False, 1001.0
    assert lost.look() == []
    server.now = 1061.0
    assert lost.look() == []
    server.now = 1062.0
    assert lost.look() == [run.id]


def test_all_pages_of_runs_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workflows.server.lost.AT_A_TIME", 2)
    server = Server(*(a_run() for _ in range(5)))
    lost, _ = watched(server)
    lost.look()
    server.now = 61.0
    assert len(lost.look()) == 5 == len(server.marked)


def test_a_run_without_a_server_sends_no_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(life, "_server", lambda: (None, ""))
    monkeypatch.setattr(life.subprocess, "Popen", lambda *a, **k: pytest.fail("a process was started"))
    with life.signs_of_life(SimpleNamespace(id=uuid4())), life.signs_of_life(None):
        pass


def test_a_sign_carries_the_login_and_no_more() -> None:
    told = life.request("http://x/api/flow_runs/1", "a:b")
    assert told.get_method() == "GET" and told.get_header("Authorization") == "Basic YTpi"
    assert life.request("http://x", "").get_header("Authorization") is None
    assert told.get_header(SIGN.capitalize()) == "1"
