"""Which requests reach a Prefect server: those that name it by a name of its own, and no page of another origin.

Prefect checks the login, but neither the Host header (a foreign page can give its own name this machine's address: DNS
rebinding) nor the Origin of a request or of a websocket: its CORS setting only decides who may read the answers.
The guard also notes the signs of life of runs (workflows/server/life.py).
"""

from __future__ import annotations

import re
import time
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from typing import Any
from urllib.parse import urlsplit
from uuid import UUID

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

SIGN = "neuface-alive"  # header of a request by which a run says that its process lives
RUN = re.compile(r"/flow_runs/([0-9a-f-]{36})$")
OTHER_NAME, OTHER_ORIGIN = 421, 403  # HTTP: Misdirected Request, Forbidden
NO_FRAME = [(b"x-frame-options", b"DENY"), (b"content-security-policy", b"frame-ancestors 'none'")]


class Signs:
    """When each run last gave a sign of life, by this process's monotonic clock."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._last: dict[UUID, float] = {}

    def note(self, run: UUID) -> None:
        """A sign from `run`, now."""
        self._last[run] = self.clock()

    def last(self, run: UUID) -> float:
        """Time of the last sign; minus infinity if there was none."""
        return self._last.get(run, float("-inf"))

    def forget_all_but(self, runs: Iterable[UUID]) -> None:
        """Keep no more than these."""
        wanted = set(runs)
        for run in self._last.keys() - wanted:
            self._last.pop(run, None)


class Guard:
    """An ASGI application around another one.

    names: host names and addresses of this server, without a port. origins: of pages that may call it (scheme, host and
    port), besides its own page, whose origin has the Host of the request.
    """

    def __init__(self, app: App, names: Iterable[str], origins: Iterable[str], signs: Signs) -> None:
        self.app, self.signs = app, signs
        self.names = {n.lower() for n in names}
        self.origins = {o.lower().rstrip("/") for o in origins}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse the request, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        refusal = self.refusal(str(scope["path"]), headers)
        if refusal is None:
            await self.app(scope, receive, self._noting(scope, headers, send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
        else:
            await _answer(send, *refusal)

    def refusal(self, path: str, headers: dict[str, str]) -> tuple[int, str] | None:
        """Status and text of the answer to a request that must not pass; None: it may. Names of headers in lower case.

        The text names no allowed host: it would help whoever guesses.
        """
        host = headers.get("host", "").lower()
        if _name(host) not in self.names:
            return OTHER_NAME, "this server is not known by this name: neuface serve --allow-host NAME allows it\n"
        origin = headers.get("origin")
        if origin is not None:
            own = origin.lower() in (f"http://{host}", f"https://{host}")
            return None if own or origin.lower() in self.origins else (OTHER_ORIGIN, "a page of another origin\n")
        # pictures, scripts and links of a foreign page carry no Origin
        if "/api/" in f"{path}/" and headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return OTHER_ORIGIN, "a page of another origin\n"
        return None

    def _noting(self, scope: Scope, headers: dict[str, str], send: Send) -> Send:
        """`send`, which notes a run's sign of life once the server has accepted its login, and forbids frames."""
        found = RUN.search(scope["path"]) if SIGN in headers and scope.get("method") == "GET" else None

        async def noting(message: Message) -> None:
            if message["type"] == "http.response.start":
                if found is not None and message["status"] == 200:
                    self.signs.note(UUID(found.group(1)))
                message["headers"] = [*message.get("headers", ()), *NO_FRAME]
            await send(message)

        return noting


def _name(host: str) -> str:
    """The host of a Host header, without port; of an IPv6 address with its brackets. Empty if it is not well-formed."""
    try:
        parts = urlsplit(f"//{host}")
        parts.port  # noqa: B018  (raises ValueError for what is no port)
    except ValueError:
        return ""
    if parts.hostname is None or parts.path or parts.query or parts.fragment or "@" in host:
        return ""
    return f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname


async def _answer(send: Send, status: int, text: str) -> None:
    body = text.encode()
    headers = [(b"content-type", b"text/plain"), (b"content-length", str(len(body)).encode()), *NO_FRAME]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
