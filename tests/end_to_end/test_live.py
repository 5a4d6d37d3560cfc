"""A run that is watched, paused and taken up again has the bytes of one that nobody looked at; and its page."""

from __future__ import annotations

import http.client
import json
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import pytest

from pipeline.demo.capture import write_demo_capture
from tests.end_to_end.test_whole_pipeline import SMALL
from tests.support.browser import Tab, installed, tab
from tests.support.points import wait_for
from workflows.cli.view import server_of
from workflows.live.folder import FOLDER
from workflows.live.look import look_at

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    write_demo_capture(folder, views=16, size=96, samples=8, mesh_step=0.003)
    return folder


def start(
    environment: dict[str, str], capture: Path, out: Path, *options: str, **changes: object
) -> subprocess.Popen[bytes]:
    sets = [f"--set={k}={v}" for k, v in {**SMALL, **changes}.items()]
    command = [sys.executable, "-m", "tests.support.often_shown", "run", str(capture), "--out", str(out)]
    return subprocess.Popen(
        [*command, "--preset", "draft", "--holdout", "every:5:2", *sets, *options],
        env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip


def ended(child: subprocess.Popen[bytes], out: Path) -> dict[str, Any]:
    _, errors = child.communicate(timeout=600)
    assert child.returncode == 0, errors.decode()
    record: dict[str, Any] = json.loads((out / "run.json").read_text())
    return record


@contextmanager
def served(out: Path) -> Iterator[str]:
    server, address = server_of(out)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield address
    finally:
        server.shutdown()
        server.server_close()


def post(address: str, wish: str) -> int:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=20)
    headers = {"Origin": f"http://{parts.netloc}", "Content-Type": "application/json"}
    connection.request("POST", f"{parts.path}ask", json.dumps({"wish": wish}), headers)
    return connection.getresponse().status


def previews(out: Path) -> int:
    return int(look_at(out).state.get("pictures", {}).get("fit.jpg", {}).get("number", 0))


@pytest.fixture(scope="module")
def undisturbed(
    capture: Path, child_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    """A run that tells nobody anything."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    return out, ended(start(child_environment, capture, out, "--no-live"), out)


def test_watched_paused_and_resumed_it_has_the_same_bytes(
    undisturbed: tuple[Path, dict[str, Any]], capture: Path, child_environment: dict[str, str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    child = start(child_environment, capture, out, "--stage-limit", "400s")
    with served(out) as address:
        wait_for(lambda: previews(out) >= 3 or child.poll() is not None)
        assert post(address, "pause") == 200
        wait_for(lambda: look_at(out).state.get("status") == "paused")
        look = look_at(out)
        seen = previews(out)
        assert seen >= 3 and len(look.state["curve"]) >= 2
        assert look.state["pictures"].keys() >= {"cameras.svg", "masks.jpg", "fit.jpg"}
        picture = cv2.imread(str(out / FOLDER / "fit.jpg"))
        assert picture is not None and picture.std() > 10  # a photo and a head, on grey
        time.sleep(1)
        assert previews(out) == seen and child.poll() is None
        assert post(address, "go on") == 200
        wait_for(lambda: previews(out) > seen or child.poll() is not None)
    record = ended(child, out)
    assert record["asset_hash"] == undisturbed[1]["asset_hash"]
    assert {n: s["key"] for n, s in record["stages"].items()} == {
        n: s["key"] for n, s in undisturbed[1]["stages"].items()}  # fmt: skip
    fits = [p / ".store/inverse_rendering" / record["stages"]["inverse_rendering"]["key"] / "field.npz"
            for p in (out, undisturbed[0])]  # fmt: skip
    assert fits[0].read_bytes() == fits[1].read_bytes()
    assert not (out / FOLDER).exists()


# ------------------------------------------------------------------ in a browser
@pytest.fixture
def page(tmp_path: Path) -> Iterator[Tab]:
    if installed() is None:
        pytest.skip("no Chromium is installed")
    with tab(tmp_path / "profile") as found:
        found.size(1280, 720)
        yield found


def test_the_page_follows_the_run_and_becomes_its_report(
    undisturbed: tuple[Path, dict[str, Any]],
    capture: Path,
    child_environment: dict[str, str],
    tmp_path: Path,
    page: Tab,
) -> None:
    """The run reuses the stages before the fit, whose pictures are there all the same."""
    out = tmp_path / "out"
    shutil.copytree(undisturbed[0] / ".store", out / ".store")
    child = start(child_environment, capture, out, **{"inverse_rendering.steps": 120})
    with served(out) as address:
        page.call("Page.navigate", url=address)
        page.until("document.documentElement && document.documentElement.dataset.status === 'running'", 120)
        page.until("document.getElementById('picture-fit.jpg').naturalWidth > 0", 120)
        click(page, "[data-wish='pause']")
        page.until("document.documentElement.dataset.status === 'paused'", 60)
        shown = page.run("[...document.querySelectorAll('main section:not([hidden]) h2')].map(h => h.textContent)")
        assert shown[:4] == ["Stages", "Fit", "Cameras and points", "Masks"]
        assert page.run("document.querySelectorAll('.drawing svg path').length") > 10
        drawn = len(look_at(out).state["curve"]) > 1  # a machine at rest is paused after the first preview
        assert page.run("document.querySelector('#curve path') !== null") is drawn
        assert page.run("document.querySelector('[data-wish=pause]').disabled") is True
        assert page.run("[...document.querySelectorAll('#stages td:last-child')].map(c => c.textContent)")[:3] == [
            "reused"] * 3  # fmt: skip
        for width, height in ((1280, 720), (375, 667)):
            page.size(width, height, phone=width < 500)
            assert page.run("document.documentElement.scrollWidth <= innerWidth")
        page.run("document.body.dispatchEvent(new KeyboardEvent('keydown', {key: ' ', bubbles: true}))")
        page.until("document.documentElement.dataset.status !== 'paused'", 60)
        page.until("location.pathname.endsWith('/report/index.html')", 300)
        assert page.troubles == []
        assert all(r.startswith(("http://127.0.0.1:", "data:", "blob:")) for r in page.requests)
    ended(child, out)


def click(page: Tab, selector: str) -> None:
    """A real click in the middle of an element."""
    x, y = page.run(f"(r => [r.x + r.width / 2, r.y + r.height / 2])(document.querySelector(\"{selector}\")"
                    ".getBoundingClientRect())")  # fmt: skip
    for kind in ("mousePressed", "mouseReleased"):
        page.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
