"""The server of `neuface view` answers for one run only, hands wishes to it, and says what is wrong with a folder."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.browser import installed, tab

from pipeline.errors import StageError
from pipeline.store import LOCKS
from tests.support.points import wait_for
from workflows.cli.view import server_of
from workflows.live.folder import LiveFolder
from workflows.live.look import check_is_run, look_at
from workflows.live.wishes import Wishes
from workflows.run.run_lock import exclusive_run

RECORD = {"stages": {}, "request": {}, "store": "", "verdict": {"level": "good"}}
STATE = {"run": "abc", "status": "running", "stages": [{"name": "first", "state": "running"}], "percent": 3}


def serve(root: Path) -> Iterator[str]:
    server, address = server_of(root)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield address
    server.shutdown()
    server.server_close()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A folder with a report, a picture of a run at work, and links that lead out of it."""
    for name, text in (("run/report/index.html", "page"), ("run/run.json", json.dumps(RECORD)), ("secret.txt", "no"),
                       ("run/.published.json", "{}"), ("run/live/mine.txt", "no")):  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "run/report/link").symlink_to(tmp_path / "secret.txt")
    (tmp_path / "run/reflectance").symlink_to(tmp_path)
    return tmp_path / "run"


@pytest.fixture
def served(run: Path) -> Iterator[str]:
    yield from serve(run)


def ask(address: str, path: str | None = None, host: str | None = None) -> tuple[int, bytes, dict[str, str]]:
    """Status, content and headers of an answer."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=5)
    connection.putrequest("GET", parts.path if path is None else path, skip_host=True)
    connection.putheader("Host", host or parts.netloc)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.getheaders())


def post(address: str, wish: object, path: str = "ask", **changes: str | None) -> int:
    """Status of a wish as the page sends it; changes: headers, None without one."""
    parts = urlsplit(address)
    body = json.dumps({"wish": wish})
    headers = {"Origin": f"http://{parts.netloc}", "Content-Type": "application/json",
               "Sec-Fetch-Site": "same-origin", "Content-Length": str(len(body))}  # fmt: skip
    headers |= {k.replace("_", "-"): v for k, v in changes.items()}
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=5)
    connection.putrequest("POST", f"{parts.path}{path}", skip_host=True)
    connection.putheader("Host", headers.pop("Host", parts.netloc) or "")
    for name, value in headers.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(body.encode())
    return connection.getresponse().status


# ------------------------------------------------------------------ who may read
def test_the_report_is_served_on_loopback(served: str) -> None:
    assert urlsplit(served).hostname == "127.0.0.1"
    path = urlsplit(served).path
    assert ask(served, f"{path}report/index.html")[:2] == (200, b"page")
    assert json.loads(ask(served, f"{path}run.json")[1]) == RECORD
    assert ask(served, host=served.split("/")[2].replace("127.0.0.1", "localhost"))[0] == 302


def test_other_hosts_paths_and_tokens_are_refused(served: str) -> None:
    token = urlsplit(served).path.split("/")[1]
    for path in ("", "state", "report/index.html", "page/live.js"):
        assert ask(served, f"/{token}/{path}", host="evil.example")[0] == 403
    for path in ("/", "/report/index.html", f"/{token}x/report/index.html", f"/{token[:-1]}/state", "/state",
                 f"/{token}/report/", f"/{token}/../secret.txt", f"/{token}/report/..%2f..%2fsecret.txt",
                 f"/{token}/report/link", f"/{token}//etc/passwd", f"/{token}/report/%00", f"/{token}/live/mine.txt",
                 f"/{token}/live/../run.json", f"/{token}/.published.json", f"/{token}/reflectance/secret.txt",
                 f"/{token}/page/../view.py", f"/{token}/page/none.js"):  # fmt: skip
        assert ask(served, path)[0] == 404, path


def test_a_record_or_picture_that_is_a_link_is_not_followed(run: Path, served: str, tmp_path: Path) -> None:
    path, secret = urlsplit(served).path, tmp_path / "elsewhere.txt"
    secret.write_text("secret")
    (run / "live").mkdir(exist_ok=True)
    for name in ("run.json", "live/fit.jpg"):
        (run / name).unlink(missing_ok=True)
        (run / name).symlink_to(secret)
        assert ask(served, f"{path}{name}")[0] == 404, name


def test_pages_may_load_nothing_of_others(served: str) -> None:
    path = urlsplit(served).path
    for name in ("page/live.html", "page/live.js", "page/live.css", "state"):
        status, content, headers = ask(served, path + name)
        assert status == 200 and content
        assert headers["Content-Security-Policy"].startswith("default-src 'none'; img-src 'self'; script-src 'self'")
        assert (headers["X-Frame-Options"], headers["Cache-Control"]) == ("DENY", "no-store")


# ------------------------------------------------------------------ who may steer
def test_a_wish_reaches_the_run_at_work(run: Path, served: str, tmp_path: Path) -> None:
    store = run / ".store"
    with exclusive_run(store, run, lambda: False, print):
        LiveFolder(run).state({**STATE, "store": str(store)})
        wishes = Wishes(run, "abc")
        assert wishes() is None
        for wish in ("pause", "go on", "stop after stage", "preset studio", "budget 600", "stop"):
            assert post(served, wish) == 200
            assert (wishes(), wishes()) == (wish, None)
        other = Wishes(run, "another run")
        assert post(served, "stop") == 200 and other() is None
        assert wishes() == "stop"


@pytest.mark.slow
def test_the_page_chooses_another_time_and_asks_first(run: Path, served: str, tmp_path: Path) -> None:
    """In a browser: the present preset is chosen; another one is asked for when the user agrees, and not before."""
    if installed() is None:
        pytest.skip("no Chromium is installed")
    state = {**STATE, "preset": "draft", "budget": None, "presets": ["draft", "studio"], "minutes": [10], "elapsed": 1}
    with exclusive_run(run / ".store", run, lambda: False, print), tab(tmp_path / "profile") as page:
        folder, wishes = LiveFolder(run), Wishes(run, "abc")
        folder.state({**state, "store": str(run / ".store"), "changeable": False, "updated": 0})
        page.call("Page.navigate", url=f"{served}page/live.html")
        page.until("document.documentElement.dataset.status === 'running'")
        assert page.run("document.getElementById('change').hidden")  # a batch's capture has the batch's setting
        folder.state({**state, "store": str(run / ".store"), "changeable": True, "updated": 0})
        page.until("!document.getElementById('change').hidden")
        assert page.run("document.getElementById('time').value") == "preset draft"
        for agrees, wanted in ((False, None), (True, "budget 600")):
            page.run(f"window.confirm = () => {str(agrees).lower()}")
            page.run("(() => { const e = document.getElementById('time');"
                     " e.value = 'budget 600'; e.dispatchEvent(new Event('change')); })()")  # fmt: skip
            if wanted is not None:
                wait_for(lambda wanted=wanted: wishes() == wanted)
            page.until("document.getElementById('time').value === 'preset draft'")  # as the run tells
            assert wishes() is None
        folder.state({**state, "store": str(run / ".store"), "changeable": True, "updated": 0, "budget": 600})
        page.until("document.getElementById('time').value === 'budget 600'")
        assert page.troubles == []


def test_only_the_servers_own_page_may_ask(run: Path, served: str) -> None:
    store, port = run / ".store", urlsplit(served).port
    with exclusive_run(store, run, lambda: False, print):
        LiveFolder(run).state({**STATE, "store": str(store)})
        for changes in ({"Origin": "http://evil.example"}, {"Origin": None}, {"Origin": "null"},
                        {"Origin": f"http://127.0.0.1:{int(port or 0) + 1}"}, {"Sec_Fetch_Site": "cross-site"},
                        {"Host": "evil.example"}):  # fmt: skip
            assert post(served, "stop", **changes) == 403, changes
        assert post(served, "stop", "state") == 404
        assert post(served[:-1] + "x/", "stop") == 404
        for bad in ({"Content_Type": "text/plain"}, {"Content_Length": "100000"}):
            assert post(served, "stop", **bad) == 400
        for wish in ("fly", None, ["stop"], {"a": 1}, "preset none", "budget 1"):
            assert post(served, wish) == 400
        assert not (run / "live/ask.json").exists()


def test_without_a_run_nobody_takes_a_wish(run: Path, served: str) -> None:
    assert post(served, "pause") == 409
    LiveFolder(run).state(STATE)
    assert post(served, "pause") == 409 and not (run / "live/ask.json").exists()


# ------------------------------------------------------------------ what is wrong with a folder
def troubles(run: Path) -> str:
    return " ".join(look_at(run).troubles)


def finished(run: Path, **changes: object) -> None:
    store = run / ".store"
    (store / "report/k").mkdir(parents=True, exist_ok=True)
    (store / "report/k/manifest.json").write_text("{}")
    record = {**RECORD, "stages": {"report": {"key": "k"}}, "store": str(store), "request": {"out": str(run)}}
    (run / "run.json").write_text(json.dumps(record | changes))


def test_a_whole_run_shows_its_report(run: Path) -> None:
    finished(run)
    assert troubles(run) == "" and look_at(run).whole
    for address in serve(run):
        assert ask(address)[2]["Location"].endswith("/report/index.html")


def test_each_fault_is_said_and_the_rest_is_shown(run: Path, tmp_path: Path) -> None:
    finished(run, request={"out": str(tmp_path / "before")})
    assert "was moved" in troubles(run) and "before" in troubles(run)
    finished(run, request={"out": str(tmp_path / "before")}, store=str(tmp_path / "gone"))
    assert "was moved" in troubles(run) and "store is not" not in troubles(run)  # its own store moved with it
    (run / ".store").rename(run / "elsewhere")
    assert "store is not where it was" in troubles(run)
    (run / "elsewhere").rename(run / ".store")
    finished(run, stages={"report": {"key": "other"}})
    assert "no longer in the store" in troubles(run)
    finished(run, verdict=None)
    assert "older version" in troubles(run)
    finished(run, stages={"capture": {"key": "k"}, "poses": {"key": "k"}})
    assert "ended after poses" in troubles(run)
    finished(run, stages=3)
    assert "another version" in troubles(run)
    finished(run)
    (run / ".published.json").write_text(json.dumps({"files": {f"asset/{i}.usd": ["x"] for i in range(8)}}))
    assert "asset/0.usd" in troubles(run) and "3 more" in troubles(run)
    (run / "report/index.html").unlink()
    assert "report/index.html is missing" in troubles(run)
    (run / "run.json").write_text("{ half")
    assert "no run.json that can be read" in troubles(run)
    for address in serve(run):
        assert ask(address)[2]["Location"].endswith("/page/live.html")
        shown = json.loads(ask(address, urlsplit(address).path + "state")[1])
        assert not shown["whole"] and [x["path"] for x in shown["links"]] == ["run.json"]


OURS = '{"what": "neuface live"'


@pytest.mark.parametrize("content", ["", "{ half", "[]", f"{OURS}}}", f'{OURS}, "format": 1, "stages": 7}}',
                                     f'{OURS}, "format": 99}}'])  # fmt: skip
def test_a_damaged_state_shows_nothing_and_says_so(content: str, run: Path) -> None:
    finished(run)
    (run / "live/state.json").write_text(content)
    look = look_at(run)
    assert look.state == {} and not look.alive
    assert ("live/state.json is damaged" in troubles(run)) == content.startswith('{"')  # else it is no file of ours


def test_a_killed_run_is_told_from_one_at_work(run: Path) -> None:
    store = run / ".store"
    LiveFolder(run).state({**STATE, "store": str(store)})
    assert not look_at(run).alive and "ended without a word" in troubles(run)
    with exclusive_run(store, run, lambda: False, print):
        assert look_at(run).alive and troubles(run) == ""


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    for folder in (tmp_path / "none", tmp_path):
        with pytest.raises(StageError, match="nothing of a run"):
            check_is_run(folder)
    (tmp_path / LOCKS).mkdir()
    (tmp_path / ".store").mkdir()
    check_is_run(tmp_path)
