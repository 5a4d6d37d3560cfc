"""A real server of ours against a hostile page, with and without a real browser, and a worker that is killed."""

from __future__ import annotations

import base64
import http.client
import http.server
import json
import sys
import threading
import time
import urllib.error
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.browser import installed, tab
from tests.support.facescape_tree import write_tree
from tests.support.points import hold, wait_for
from tests.support.servers import ASKED_EVERY, PREFECT, Process, ask, free_port, wait_healthy

CLOSED = json.loads((Path(__file__).resolve().parents[2] / "workflows/pools/process.json").read_text())


class Ours:
    """A running `neuface serve --server-only`."""

    def __init__(self, port: int, environment: dict[str, str], home: Path) -> None:
        self.port, self.environment, self.home = port, environment, home
        self.url, self.login = f"http://127.0.0.1:{port}/api", (home / "login").read_text().strip()

    def status(self, method: str, path: str, headers: dict[str, str], body: str | None = None) -> tuple[int, Any]:
        """Status and headers of the answer to a request as a page or a program may send it."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        answer.read()
        connection.close()
        return answer.status, answer.headers

    def ask(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """One call with the login and the token."""
        return ask(self.url, path, body, self.login)

    def deploy(self) -> str:
        """A pool and the deployment of the capture's flow with toy stages; its id."""
        self.ask("/work_pools/", {"name": "heads", "type": "process", "base_job_template": CLOSED})
        flow = self.ask("/flows/", {"name": "capture-to-asset"})["id"]
        made = self.ask(
            "/deployments/",
            {"name": "local", "flow_id": flow, "work_pool_name": "heads", "entrypoint":
             "tests.support.toy_batch.capture_to_asset", "enforce_parameter_schema": False, "pull_steps": [
                 {"prefect.deployments.steps.set_working_directory": {"directory": "/tmp"}}]},
        )  # fmt: skip
        return str(made["id"])


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory, child_environment: dict[str, str]) -> Iterator[Ours]:
    folder, port = tmp_path_factory.mktemp("server"), free_port()
    environment = {**child_environment, "PREFECT_HOME": str(folder / "prefect"), "PREFECT_WORKER_QUERY_SECONDS": "2"}
    command = [sys.executable, "-m", "workflows.cli", "serve", "--server-only", "--port", port, "--home",
               folder / "home", "--lost-after", "30s"]  # fmt: skip
    with Process(environment, folder / "log", folder, *command):
        wait_healthy(f"http://127.0.0.1:{port}/api")
        made = Ours(port, environment, folder / "home")
        made.environment = {**environment, "PREFECT_API_URL": made.url, "PREFECT_API_AUTH_STRING": made.login}
        yield made


def basic(login: str) -> str:
    return f"Basic {base64.b64encode(login.encode()).decode()}"


@pytest.mark.slow
def test_no_request_of_a_hostile_page_passes(ours: Ours) -> None:
    own, start = f"127.0.0.1:{ours.port}", "/api/deployments/filter"
    json_of = {"Host": own, "Content-Type": "application/json"}
    login = {"Authorization": basic(ours.login)}
    evil = {"Origin": "http://evil.example"}
    for method, path, headers, status in (
        ("POST", start, json_of, 403),  # no token, no login
        ("GET", "/api/csrf-token?client=t", json_of, 401),  # no login
        ("GET", "/api/admin/settings", {"Host": own, "Authorization": basic("neuface:guess")}, 401),
        ("POST", start, {**json_of, **login}, 403),  # the login alone: no token
        ("OPTIONS", start, {"Host": own, **evil, "Access-Control-Request-Method": "POST"}, 403),
        ("POST", start, {**json_of, **login, **evil}, 403),
        ("POST", start, {"Host": own, **evil, "Content-Type": "text/plain"}, 403),  # needs no preflight
        ("GET", "/api/health", {"Host": own, **evil}, 403),
        ("GET", "/api/health", {"Host": f"evil.example:{ours.port}"}, 421),
        ("GET", "/", {"Host": f"evil.example:{ours.port}"}, 421),
        ("POST", start, {**json_of, **login, "Host": "evil.example"}, 421),
        ("GET", "/api/admin/settings", {"Host": own, **login}, 200),
        ("OPTIONS", start, {"Host": own, "Origin": f"http://localhost:{ours.port}",
                            "Access-Control-Request-Method": "POST"}, 200),
    ):  # fmt: skip
        got, answered = ours.status(method, path, headers, "{}" if method == "POST" else None)
        assert got == status, (method, path, headers)
        allowed = answered.get("access-control-allow-origin")
        assert allowed in (None, f"http://localhost:{ours.port}"), (method, path, headers)
        assert answered["X-Frame-Options"] == "DENY"
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
               "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol": "prefect"}  # fmt: skip
    assert ours.status("GET", "/api/events/in", {"Host": own, **upgrade, **evil})[0] == 403
    assert ours.status("GET", "/api/events/in", {"Host": own, **upgrade})[0] == 101
    for file in ours.home.iterdir():
        assert file.stat().st_mode & 0o077 == 0, file


@contextmanager
def page(content: bytes) -> Iterator[int]:
    """A web server with one page; its port."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None: ...

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.slow
@pytest.mark.skipif(installed() is None, reason="no Chromium is installed: no real browser to attack with")
def test_a_page_in_a_real_browser_reaches_nothing(ours: Ours, tmp_path: Path) -> None:
    with (
        page(b"<!doctype html><title>evil</title><body>") as port,
        tab(tmp_path / "browser", "--host-resolver-rules=MAP evil.example 127.0.0.1") as browser,
    ):
        browser.call("Page.navigate", url=f"http://localhost:{port}/")
        browser.until("document.title == 'evil'")
        target = f"http://127.0.0.1:{ours.port}"
        for options in ("{}", "{method: 'POST', headers: {'Content-Type': 'application/json'}, body: '{}'}"):
            code = f"fetch('{target}/api/deployments/filter', {options}).then(r => 'read ' + r.status, e => 'refused')"
            assert browser.run(code) == "refused"
        quiet = f"fetch('{target}/api/health', {{mode: 'no-cors'}}).then(r => r.type + r.status, e => 'refused')"
        assert browser.run(quiet) in ("opaque0", "refused")
        socket = f"new WebSocket('ws://127.0.0.1:{ours.port}/api/events/in', 'prefect')"
        socket = f"""new Promise(done => {{ const s = {socket};
            s.onopen = () => done('open'); s.onerror = () => done('refused') }})"""
        assert browser.run(socket) == "refused"
        browser.call("Page.navigate", url=f"http://evil.example:{ours.port}/")  # its name leads to this machine now
        browser.until("document.readyState == 'complete' && location.host.startsWith('evil.example')")
        assert "not known by this name" in browser.run("document.body.innerText")
        assert browser.run("fetch('/api/health').then(r => r.status)") == 421
        browser.call("Page.navigate", url=f"{target}/")  # the own page asks for the login, as before
        browser.until("document.title.includes('Prefect')")
        assert browser.run("fetch('/api/health').then(r => r.status)") == 200
        assert browser.run("fetch('/api/admin/settings').then(r => r.status)") == 401


@pytest.mark.slow
def test_the_run_of_a_killed_worker_is_marked_and_its_slot_free_within_two_minutes(ours: Ours, tmp_path: Path) -> None:
    write_tree(tmp_path / "tree", {"1/1_neutral": True})
    point, tally = hold("work.checkpoint@2", tmp_path / "signs"), tmp_path / "tally"
    environment = {**ours.environment, "NEUFACE_ROOTS": str(tmp_path), "NEUFACE_TALLY": str(tally),
                   **point.environment()}  # fmt: skip
    deployment = ours.deploy()
    asked = {"capture": str(tmp_path / "tree/1/1_neutral"), "out": str(tmp_path / "out"), "preset": "draft"}
    for variables in ({"command": "touch /tmp/x"}, {"env": {"PYTHONPATH": str(tmp_path)}}):
        with pytest.raises(urllib.error.HTTPError) as e:
            ours.ask(f"/deployments/{deployment}/create_flow_run", {"parameters": asked, "job_variables": variables})
        assert e.value.code == 422
    start = f"/deployments/{deployment}/create_flow_run"
    first = ours.ask(start, {"parameters": asked})["id"]
    worker = Process(environment, tmp_path / "worker.log", tmp_path, PREFECT, "worker", "start", "--pool", "heads",
                     "--limit", 1)  # fmt: skip
    with worker:
        wait_for(lambda: point.reached())
        time.sleep(35)  # longer than the server's patience: a run that lives is left alone
        assert ours.ask(f"/flow_runs/{first}")["state_type"] == "RUNNING"
        worker.kill()
        killed = time.monotonic()
        wait_for(lambda: ours.ask(f"/flow_runs/{first}")["state_type"] == "CRASHED", 120, ASKED_EVERY)
        assert time.monotonic() - killed < 120
        assert "no sign of life" in ours.ask(f"/flow_runs/{first}")["state"]["message"]
        point.release()
        worker.start()
        second = ours.ask(start, {"parameters": asked})["id"]
        wait_for(lambda: ours.ask(f"/flow_runs/{second}")["state_type"] == "COMPLETED", every=ASKED_EVERY)
    assert (tmp_path / "out/run.json").is_file()
    finished = [line.split()[0] for line in tally.read_text().splitlines()]
    assert sorted(finished) == ["capture", "usd", "work"], "finished stages were kept"
