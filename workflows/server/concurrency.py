"""A slot of a global concurrency limit of the server, for as long as a fit runs.

The server lends the slot for a time that is renewed, so that the slot of a process that died comes back. Prefect's own
`concurrency` stops renewing for good after a few seconds without the server, and fails the run when the server is away
at the fit's end; here both are repeated until the server is back.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from uuid import UUID

import httpx
from prefect.client.orchestration import get_client

from pipeline.errors import Cancelled, StageError

log = logging.getLogger(__name__)
LEASE = 300.0  # seconds until the slot of a dead process is free again; a server may restart within it
RENEW = 60.0  # seconds between two renewals
ASK = 5.0  # seconds until a server that is away, or whose slots are taken, is asked again
AWAY = 900.0  # seconds that a server may be away before a run without a slot gives up
GIVE_BACK = 60.0  # seconds for which the end of a fit waits for a server that is away
TAKEN = 423  # HTTP: no slot is free


@contextmanager
def slot(limit: str, stopped: Callable[[], bool]) -> Iterator[None]:
    """Wait for a slot, hold it, give it back.

    Raises:
        StageError: no such limit: it would mean no limit at all. Cancelled: stopped by the user while waiting.
        httpx.HTTPError: the server stays away.
    """
    lease, over = _take(limit, stopped), threading.Event()
    keeper = threading.Thread(target=_keep, args=(lease, over), daemon=True)
    keeper.start()
    try:
        yield
    finally:
        over.set()
        keeper.join(ASK)
        _give_back(lease)


def _take(limit: str, stopped: Callable[[], bool]) -> UUID:
    answered = time.monotonic()
    while not stopped():
        try:
            with get_client(sync_client=True) as client:
                answer = client.increment_concurrency_slots_with_lease([limit], 1, "concurrency", LEASE).json()
        except httpx.HTTPError as e:
            if _taken(e):
                answered = time.monotonic()
            elif not _away(e) or time.monotonic() - answered > AWAY:
                raise
            time.sleep(ASK)
            continue
        if not answer["limits"]:
            raise StageError(
                "the limit on fits does not exist",
                where="fit_slots",
                value=limit,
                limit="a global concurrency limit of the server",
                remedy=f"make it: prefect gcl create {limit} --limit N; neuface batch --gpus N does",
            )
        return UUID(answer["lease_id"])
    raise Cancelled("stopped by the user while it waited for a slot")


def _keep(lease: UUID, over: threading.Event) -> None:
    """Renew until the fit is over. A slot that the server took back does not end the fit: hours of work weigh more
    than two fits on one GPU for a while."""
    pause = RENEW
    while not over.wait(pause):
        try:
            with get_client(sync_client=True) as client:
                client.renew_concurrency_lease(lease, LEASE)
            pause = RENEW
        except httpx.HTTPError as e:
            if not _away(e):
                log.warning("the server revoked the slot; the fit continues without it: %s", e)
                return
            pause = ASK


def _give_back(lease: UUID) -> None:
    end = time.monotonic() + GIVE_BACK
    while True:
        try:
            with get_client(sync_client=True) as client:
                client.release_concurrency_slots_with_lease(lease)
            return
        except httpx.HTTPError as e:
            if not _away(e) or time.monotonic() > end:
                log.warning("the slot was not given back and is free again in %.0f s: %s", LEASE, e)
                return
        time.sleep(min(ASK, 1.0))


def _taken(e: httpx.HTTPError) -> bool:
    return isinstance(e, httpx.HTTPStatusError) and e.response.status_code == TAKEN


def _away(e: httpx.HTTPError) -> bool:
    """Whether the server did not answer, or answered that it is busy."""
    return not isinstance(e, httpx.HTTPStatusError) or e.response.status_code >= 500
