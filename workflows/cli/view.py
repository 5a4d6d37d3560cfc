"""`neuface view`: serves one run's folder to this machine's browser, and to nothing else.

The server listens on the loopback interface at a free port. Every address begins with a random token, and a request
must name this server as its host, so that neither another user nor a page of another site (DNS rebinding) can read it.
What changes a run is a POST, which only a page of this server may send: a browser names the page's origin, and any
other is refused.

    GET TOKEN/                the live page, if the run goes on or something is wrong, else the report
    GET TOKEN/state           what the page shows, as JSON
    GET TOKEN/page/NAME       the page's script and style
    GET TOKEN/live/NAME, report/..., asset/..., reflectance/..., run.json    files of the run
    POST TOKEN/ask            {"wish": "pause" | "go on" | "stop after stage" | "stop" |
                                 "preset NAME" | "budget SECONDS"}
"""

from __future__ import annotations

import functools
import http.server
import json
import secrets
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from urllib.parse import unquote, urlsplit

from workflows.live.folder import FOLDER, PICTURES
from workflows.live.look import REPORT, look_at
from workflows.live.wishes import ask
from workflows.run.steering import WISHES, is_wish

LOOPBACK = "127.0.0.1"
SERVED = ("report", "asset", "reflectance")  # folders of a run
RECORD = "run.json"
LIVE = "live.html"
PARTS = {LIVE: "text/html", "live.css": "text/css", "live.js": "text/javascript"}
ICON = b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 16 16"><circle cx="8" cy="8" r="7" fill="#2a6fb8"/></svg>'
MOST = 1000  # bytes of a POST
POLICY = (
    "default-src 'none'; img-src 'self'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Handler(http.server.SimpleHTTPRequestHandler):
    """Answers requests for files of `root` below the token."""

    def __init__(self, *args: object, root: Path, token: str, **options: object) -> None:
        self.root, self.token = root, token
        super().__init__(*args, directory=str(root), **options)  # type: ignore[arg-type]

    # ------------------------------------------------------------------ who asks
    def is_ours(self) -> bool:
        """Whether the request names this server and the token; else it is answered with a refusal."""
        if self.headers.get("Host") not in self._hosts():
            self.send_error(HTTPStatus.FORBIDDEN, "not a host of this server")
            return False
        token = self.path_parts()[0]
        if not secrets.compare_digest(token.encode(), self.token.encode()):
            self.send_error(HTTPStatus.NOT_FOUND, "no such file of the run")
            return False
        return True

    def _hosts(self) -> tuple[str, str]:
        port = self.connection.getsockname()[1]
        return f"{LOOPBACK}:{port}", f"localhost:{port}"

    def path_parts(self) -> tuple[str, str]:
        """Token and the rest of the path."""
        token, _, name = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
        return token, name

    # ------------------------------------------------------------------ GET
    def do_GET(self) -> None:
        """The page, its state, or a file."""
        if not self.is_ours():
            return
        name = self.path_parts()[1]
        if name == "":
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", f"/{self.token}/{REPORT if look_at(self.root).whole else f'page/{LIVE}'}")
            self.send_header("Content-Length", "0")
            self.end_headers()
        elif name == "state":
            self._send(json.dumps(look_at(self.root).json()).encode(), "application/json")
        elif name == "page/icon.svg":
            self._send(ICON, "image/svg+xml")
        elif name.removeprefix("page/") in PARTS and name.startswith("page/"):
            part = name.removeprefix("page/")
            self._send(files("workflows.live").joinpath("page", part).read_bytes(), PARTS[part])
        elif self.file() is None:
            self.send_error(HTTPStatus.NOT_FOUND, "no such file of the run")
        else:
            super().do_GET()

    def do_HEAD(self) -> None:
        """As GET of a file, without its content."""
        if not self.is_ours():
            return
        if self.file() is None:
            self.send_error(HTTPStatus.NOT_FOUND, "no such file of the run")
        else:
            super().do_HEAD()

    def _send(self, content: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def file(self) -> Path | None:
        """The file that the request names, or None if it is not a file of the run's folders."""
        name = self.path_parts()[1]
        if "\0" in name or name.startswith("/"):
            return None
        found = (self.root / name).resolve()
        folder, _, picture = name.partition("/")
        if name == RECORD or (folder == FOLDER and picture in PICTURES):
            inside = found == self.root / name  # no link
        else:
            served = [f for f in ((self.root / s).resolve() for s in SERVED) if f.is_relative_to(self.root)]
            inside = any(found.is_relative_to(f) for f in served)
        return found if inside and found.is_file() else None

    def translate_path(self, path: str) -> str:
        return str(self.file() or self.root / "no such file")

    # ------------------------------------------------------------------ POST
    def do_POST(self) -> None:
        """Hand a wish of the page to the run."""
        if not self.is_ours():
            return
        refused = self._refusal()
        if refused is not None:
            self.send_error(*refused)

    def _refusal(self) -> tuple[HTTPStatus, str] | None:
        """Ask the run; where that can't be, why."""
        if self.path_parts()[1] != "ask":
            return HTTPStatus.NOT_FOUND, "nothing to ask for there"
        same = self.headers.get("Sec-Fetch-Site", "same-origin") == "same-origin"
        if not same or self.headers.get("Origin") not in [f"http://{host}" for host in self._hosts()]:
            return HTTPStatus.FORBIDDEN, "not from a page of this server"
        wish = self._wish()
        if wish is None:
            return HTTPStatus.BAD_REQUEST, f"a wish is one of {', '.join(WISHES)}, preset NAME, budget SECONDS"
        try:
            taken = look_at(self.root).alive and ask(self.root, wish)
        except OSError:
            return HTTPStatus.INTERNAL_SERVER_ERROR, "the run's folder can't be written"
        if not taken:
            return HTTPStatus.CONFLICT, "no run is at work here"
        self._send(json.dumps({"asked": wish}).encode(), "application/json")
        return None

    def _wish(self) -> str | None:
        """The wish in the request; None if it is none."""
        length = self.headers.get("Content-Length", "")
        kind = self.headers.get("Content-Type", "").partition(";")[0].strip()
        if not length.isdecimal() or int(length) > MOST or kind != "application/json":
            return None
        try:
            found = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            return None
        wish = found.get("wish") if isinstance(found, dict) else None
        return wish if isinstance(wish, str) and is_wish(wish) else None

    # ------------------------------------------------------------------ all answers
    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: the addresses hold the token."""


def server_of(root: Path) -> tuple[http.server.ThreadingHTTPServer, str]:
    """A server of a run's folder that does not listen to the network, and the address of its page."""
    token = secrets.token_urlsafe(24)
    handler = functools.partial(Handler, root=root.resolve(), token=token)
    server = http.server.ThreadingHTTPServer((LOOPBACK, 0), handler)
    return server, f"http://{LOOPBACK}:{server.server_address[1]}/{token}/"
