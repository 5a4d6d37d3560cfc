"""Runs whose process is gone: our server marks them crashed.

A killed process can't say that it ended, and Prefect would show its run as running for ever, and keep its slot. Our
runs give a sign of life every few seconds (workflows/server/life.py). One that was silent for `patience` seconds is
marked crashed. Time is that of this process's monotonic clock alone: the clocks of other machines do not matter. While
the server or its database can't answer, nothing is judged, and after that everything gets the full time again.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, suppress
from uuid import UUID

import httpx
from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.filters import (
    FlowFilter,
    FlowFilterName,
    FlowRunFilter,
    FlowRunFilterState,
    FlowRunFilterStateType,
)
from prefect.client.schemas.objects import FlowRun, StateType
from prefect.exceptions import ObjectNotFound
from prefect.states import Crashed

from workflows.server.guard import Signs

log = logging.getLogger(__name__)
FLOWS = ["capture-to-asset", "facescape-batch"]  # the flows whose runs give signs
PATIENCE = 60.0  # seconds without a sign after which a run is lost
# Times `patience` for a run that a worker took until its process gives a sign: a process of the worker's own machine,
# and a container or a job, for which an image may have to be fetched.
QUICK_START, SLOW_START = 1.5, 10.0
LOOK = 5.0  # seconds between two looks
AT_A_TIME = 200  # runs in one answer of the server


class Lost:
    """Looks at the runs under way. connect: a client of the server, at each look; patience in seconds."""

    def __init__(
        self, connect: Callable[[], AbstractContextManager[SyncPrefectClient]], signs: Signs, patience: float = PATIENCE
    ) -> None:
        self.connect, self.signs, self.patience = connect, signs, patience
        self._since: dict[tuple[UUID, StateType | None], float] = {}

    def look(self) -> list[UUID]:
        """Mark what is lost; returns these runs. If the server does not answer, forget since when runs are silent."""
        try:
            with self.connect() as client:
                return self._look(client)
        except httpx.HTTPError as e:
            log.debug("no look at the runs: %s", e)
            self._since.clear()
            return []

    def _look(self, client: SyncPrefectClient) -> list[UUID]:
        runs, now, marked = _under_way(client), self.signs.clock(), []
        self._since = {(r.id, r.state_type): self._since.get((r.id, r.state_type), now) for r in runs}
        self.signs.forget_all_but(r.id for r in runs)
        quick = _quick_pools(client, {r.work_pool_name for r in runs if r.state_type == StateType.PENDING})
        for run in runs:
            start = QUICK_START if run.work_pool_name in quick else SLOW_START
            patience = self.patience * (start if run.state_type == StateType.PENDING else 1.0)
            quiet = now - max(self._since[run.id, run.state_type], self.signs.last(run.id))
            if quiet > patience:
                text = (
                    f"no sign of life for {quiet:.0f} s: its process, worker or machine is gone. "
                    "Start it again: finished stages are kept"
                )
                client.set_flow_run_state(run.id, Crashed(message=text), force=True)
                log.warning("run %s: %s", run.name, text)
                marked.append(run.id)
        return marked


def _under_way(client: SyncPrefectClient) -> list[FlowRun]:
    """Runs of our flows that a process should be at work on."""
    wanted = FlowRunFilter(
        state=FlowRunFilterState(
            type=FlowRunFilterStateType(any_=[StateType.RUNNING, StateType.PENDING, StateType.CANCELLING])
        )
    )
    flows, found = FlowFilter(name=FlowFilterName(any_=FLOWS)), list[FlowRun]()
    while True:
        some = client.read_flow_runs(flow_filter=flows, flow_run_filter=wanted, limit=AT_A_TIME, offset=len(found))
        found += some
        if len(some) < AT_A_TIME:
            return found


def _quick_pools(client: SyncPrefectClient, names: Iterable[str | None]) -> set[str | None]:
    """Those of the pools whose workers start a process of their machine. Runs without a pool are of `neuface serve`,
    which does so too."""
    quick: set[str | None] = {None}
    for name in names:
        with suppress(ObjectNotFound):  # it was deleted: nothing is known of it
            if name is not None and client.read_work_pool(name).type == "process":
                quick.add(name)
    return quick


def watch(lost: Lost, stop: threading.Event) -> None:
    """Look every few seconds until `stop`. A fault of one look is logged and ends no watch."""
    while not stop.wait(LOOK):
        try:
            lost.look()
        except Exception:
            log.exception("a look at the runs failed")
