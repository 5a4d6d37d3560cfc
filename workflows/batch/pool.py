"""Captures as runs of a deployment: a Prefect server hands them to the workers of a pool.

One deployment run for each capture and never one flow over all: a server keeps every task of a flow at hand. Each has
an idempotency key, so that a batch that is started again joins the runs that it left, and submits none twice.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from uuid import UUID

import httpx
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.exceptions import ObjectAlreadyExists, ObjectNotFound, PrefectHTTPStatusError
from prefect.settings import get_current_settings
from prefect.states import Crashed

from pipeline.errors import StageError, UsageError
from workflows.batch.failures import Failure, failure_in
from workflows.batch.loop import Ended
from workflows.batch.request import PRIORITIES, BatchRequest
from workflows.batch.state import Entry, idempotency_key
from workflows.run.plan import make_plan
from workflows.run.request import RunRequest
from workflows.run.run_lock import is_held
from workflows.run.verdict import level_of_state
from workflows.server.environment import SLOTS_ON_DISK

log = logging.getLogger(__name__)
T = TypeVar("T")
POLL = 2.0  # seconds between two looks at the runs
AWAY = 900.0  # seconds that the server may be away
SLOW_START = 10.0  # a run that a worker took may need this many times `lost_after` until its process works
AT_A_TIME = 200  # runs in one answer of the server


@dataclass(slots=True)
class _Run:
    """A run under way. quiet_since: monotonic time since which no process worked on it; running_since: of its begin."""

    id: UUID
    name: str
    request: RunRequest
    state: StateType | None = None
    quiet_since: float = field(default_factory=time.monotonic)
    running_since: float | None = None


class Pool:
    """A Runner whose runs are those of a deployment."""

    def __init__(self, request: BatchRequest) -> None:
        if get_current_settings().api.url is None:
            raise UsageError(
                "there is no Prefect server",
                where="PREFECT_API_URL",
                value="not set",
                limit="the address of a server with a pool and workers",
                remedy="set it, or leave out --server to run the captures on this machine",
            )
        self.request, self.slots = request, request.chunk
        self._runs: dict[UUID, _Run] = {}
        self._looked = 0.0
        self._deployment = self._prepare()

    # ---------------------------------------------------------------- Runner
    def start(self, entry: Entry, request: RunRequest) -> None:
        """Submit the attempt, or find the run that was submitted for it before."""
        run = self._patiently(
            lambda c: c.create_flow_run_from_deployment(
                self._deployment,
                parameters=request.model_dump(mode="json"),
                name=f"{entry.name} #{entry.attempt}",
                tags=["neuface", "batch"],
                idempotency_key=idempotency_key(entry, str(Path(self.request.out).absolute())),
                work_queue_name=self.request.priority,
            )
        )
        self._runs[run.id] = _Run(run.id, entry.name, request)

    def poll(self) -> Iterator[Ended]:
        """What ended, after a pause of POLL seconds."""
        time.sleep(max(0.0, self._looked + POLL - time.monotonic()))
        self._looked = time.monotonic()
        for seen in self._read(list(self._runs)):
            run = self._runs[seen.id]
            ended = self._look_at(run, seen)
            if ended is not None:
                del self._runs[seen.id]
                yield ended

    def close(self, stopped: bool) -> Iterable[Ended]:
        """Leave what is under way to the workers: the same command follows it again."""
        return ()

    # ---------------------------------------------------------------- runs
    def _read(self, ids: list[UUID]) -> Iterator[FlowRun]:
        for at in range(0, len(ids), AT_A_TIME):
            some = FlowRunFilter(id=FlowRunFilterId(any_=ids[at : at + AT_A_TIME]))
            yield from self._patiently(partial(_runs_among, some))

    def _look_at(self, run: _Run, seen: FlowRun) -> Ended | None:
        state, now = seen.state_type, time.monotonic()
        message = (seen.state.message or "") if seen.state else ""
        if state == StateType.COMPLETED:
            return Ended(run.name, level=level_of_state(seen.state.name if seen.state else None))
        if state == StateType.FAILED:
            fault = failure_in(message)
            return Ended(run.name, fault, _rays(run.request) if fault.kind == "memory" else None)
        if state == StateType.CRASHED:
            return Ended(run.name, _crash(run, message, now))
        if state in (StateType.CANCELLED, StateType.CANCELLING):
            return Ended(run.name, Failure(kind="bug", message="the run was cancelled on the server"))
        if state != run.state or state == StateType.SCHEDULED or self._works(run):
            run.state, run.quiet_since = state, now
            if state == StateType.RUNNING and run.running_since is None:
                run.running_since = now
        patience = self.request.lost_after * (1.0 if state == StateType.RUNNING else SLOW_START)
        return self._lost(run, now - run.quiet_since) if now - run.quiet_since > patience else None

    def _works(self, run: _Run) -> bool:
        """Whether a process holds the run's lock: the one sign of life that a killed process can't leave behind."""
        return is_held(self.request.store_path, Path(run.request.out))

    def _lost(self, run: _Run, quiet: float) -> Ended:
        text = f"no process has worked on this run for {quiet:.0f} s: its worker is gone"
        self._patiently(lambda c: c.set_flow_run_state(run.id, Crashed(message=text), force=True))
        return Ended(run.name, Failure(kind="lost", message=text))

    # ---------------------------------------------------------------- server
    def _prepare(self) -> UUID:
        """Find the deployment; make the queue and the limit that the request names."""
        try:
            deployment = self._patiently(lambda c: c.read_deployment_by_name(self.request.deployment))
        except ObjectNotFound as e:
            raise StageError(
                "the server has no such deployment",
                where="--deployment",
                value=self.request.deployment,
                limit="a deployment of the flow capture-to-asset",
                remedy="deploy it first: prefect --no-prompt deploy --prefect-file workflows/prefect.yaml "
                f"-n {self.request.deployment.rpartition('/')[2]}",
            ) from e
        if self.request.priority and deployment.work_pool_name:
            self._queue(deployment.work_pool_name, self.request.priority)
        if self.request.fit_slots and self.request.gpus:
            self._limit(self.request.fit_slots, self.request.gpus)
        return deployment.id

    def _queue(self, pool: str, name: str) -> None:
        rank = PRIORITIES.index(name) + 1
        try:
            self._patiently(lambda c: c.create_work_queue(name, work_pool_name=pool, priority=rank))
        except ObjectAlreadyExists:
            queue = self._patiently(lambda c: c.read_work_queue_by_name(name, work_pool_name=pool))
            self._patiently(lambda c: c.update_work_queue(queue.id, priority=rank))

    def _limit(self, name: str, slots: int) -> None:
        self._patiently(lambda c: c.upsert_global_concurrency_limit_by_name(name, slots))
        if self._patiently(_forgets_slots):
            log.warning(
                "the server keeps in its memory who holds a slot of %s: should it restart, slots in use stay taken. "
                "Start it with %s=%s",
                name,
                *SLOTS_ON_DISK,
            )

    def _patiently(self, ask: Callable[[SyncPrefectClient], T]) -> T:
        """Ask the server; repeat while it does not answer (during a restart, say)."""
        end, pause = time.monotonic() + AWAY, 1.0
        while True:
            try:
                with get_client(sync_client=True) as client:
                    return ask(client)
            except (httpx.TransportError, PrefectHTTPStatusError) as e:
                answered = isinstance(e, PrefectHTTPStatusError) and e.response.status_code < 500
                if answered or time.monotonic() > end:
                    raise _away(e) from e
                log.warning("the server is away (%s); asking again in %.0f s", e, pause)
            time.sleep(pause)
            pause = min(2 * pause, 30.0)


def _runs_among(some: FlowRunFilter, client: SyncPrefectClient) -> list[FlowRun]:
    return client.read_flow_runs(flow_run_filter=some, limit=AT_A_TIME)


def _forgets_slots(client: SyncPrefectClient) -> bool:
    """Whether a restart of the server loses slots of global limits for good."""
    settings: Any = client.request("GET", "/admin/settings").json()
    storage = settings.get("server", {}).get("concurrency", {}).get("lease_storage", "")
    return str(storage).endswith(".memory")


def _crash(run: _Run, message: str, now: float) -> Failure:
    """A process that ended itself with code 1 after the time that a stage may take hung: it would hang again."""
    limit = run.request.stage_limit
    long_enough = limit is not None and run.running_since is not None and now - run.running_since >= limit
    if long_enough and re.search(r"status code:? 1\b", message):
        return Failure(kind="limit", message=f"a stage did not stop within its {limit:g} s: {message}")
    return Failure(kind="lost", message=message or "the run crashed")


def _away(e: Exception) -> StageError:
    return StageError(
        "the Prefect server does not answer as it should",
        where=str(get_current_settings().api.url),
        value=f"{type(e).__name__}: {e}",
        limit=f"an answer within {AWAY:.0f} s",
        remedy="start it, then run the same command again: it continues with the submitted runs",
    )


def _rays(request: RunRequest) -> int | None:
    """Rays a step of a run's fit."""
    config: Any = make_plan(request).configs.get("inverse_rendering")
    return getattr(config, "batch", None)
