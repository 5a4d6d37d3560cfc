"""`neuface view`: serves one run's folder to this machine's browser, and to nothing else.

The server listens on the loopback interface at a free port. Every address begins with a random token, and a request
must name this server as its host, so that neither another user nor a page of another site (DNS rebinding) can read it.
"""

from __future__ import annotations

import functools
import http.server
import secrets
from http import HTTPStatus
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOOPBACK = "127.0.0.1"
SERVED = ("report", "asset")  # folders of a run
PAGE = "report/index.html"


class Handler(http.server.SimpleHTTPRequestHandler):
    """Answers requests for files of `root` below the token."""

    def __init__(self, *args: object, root: Path, token: str, **options: object) -> None:
        self.root, self.token = root, token
        super().__init__(*args, directory=str(root), **options)  # type: ignore[arg-type]

    def send_head(self):  # type: ignore[no-untyped-def]  # the base class has no types here
        """Refuse other hosts, other paths and folders; else as the base class."""
        port = self.connection.getsockname()[1]
        if self.headers.get("Host") not in (f"{LOOPBACK}:{port}", f"localhost:{port}"):
            return self.send_error(HTTPStatus.FORBIDDEN, "not a host of this server")
        if self.file() is None:
            return self.send_error(HTTPStatus.NOT_FOUND, "no such file of the run")
        return super().send_head()

    def file(self) -> Path | None:
        """The file that the request names, or None if it is not a file of the run's folders."""
        token, _, name = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
        if not secrets.compare_digest(token.encode(), self.token.encode()) or "\0" in name:
            return None
        found = (self.root / name).resolve()
        inside = any(found.is_relative_to((self.root / f).resolve()) for f in SERVED)
        return found if inside and found.is_file() else None

    def translate_path(self, path: str) -> str:
        return str(self.file() or self.root / "no such file")

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: the addresses hold the token."""


def server_of(root: Path) -> tuple[http.server.ThreadingHTTPServer, str]:
    """A server of a run's folder that does not listen to the network, and the address of its report."""
    token = secrets.token_urlsafe(24)
    handler = functools.partial(Handler, root=root.resolve(), token=token)
    server = http.server.ThreadingHTTPServer((LOOPBACK, 0), handler)
    return server, f"http://{LOOPBACK}:{server.server_address[1]}/{token}/{PAGE}"
