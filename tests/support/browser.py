"""A headless Chromium, driven through its debugging pipe: opens a page, clicks, types, reads the console."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
           "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage", "--use-gl=angle",
           "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-pipe")  # fmt: skip


def installed() -> str | None:
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class ScriptError(RuntimeError):
    """What an expression raised in the page."""


class Tab:
    """One page. `troubles`: errors and warnings of its console, and uncaught exceptions."""

    def __init__(self, send: int, receive: int, process: int = 0) -> None:
        self._send, self._receive, self._process = send, receive, process
        self._buffer, self._count, self._session = b"", 0, ""
        self.troubles: list[str] = []
        self.requests: list[str] = []

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._send, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return dict(answer["result"])
            self._note(answer)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            got = os.read(self._receive, 1 << 20)
            if not got:
                raise RuntimeError("the browser ended")
            self._buffer += got
        text, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(text))

    def _note(self, event: dict[str, Any]) -> None:
        method, params = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.troubles.append(str(params["exceptionDetails"])[:400])
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning"):
            self.troubles.append(str([a.get("value") for a in params["args"]])[:400])
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.troubles.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"][:60])

    def attach(self) -> None:
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def run(self, code: str) -> Any:
        """The value of an expression; promises are waited for."""
        found = self.call("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in found:
            raise ScriptError(str(found["exceptionDetails"])[:600])
        return found["result"].get("value")

    def until(self, code: str, seconds: float = 60) -> float:
        """Wait until an expression is true; returns the seconds that it took.

        While a page loads its document has no elements yet, so an expression may raise: that is not true yet.
        """
        start, raised = time.monotonic(), ""
        while True:
            try:
                if self.run(code):
                    return time.monotonic() - start
            except ScriptError as error:
                raised = str(error)
            if time.monotonic() - start > seconds:
                raise TimeoutError(f"{code} after {seconds} s; {self.troubles} {raised}")
            time.sleep(0.05)

    def processor_seconds(self) -> float:
        """Of all living processes of the browser since they began, its software renderer among them."""
        found, ticks = {self._process}, 0
        for stat in sorted(Path("/proc").glob("[0-9]*/stat"), key=lambda p: int(p.parent.name)):
            with suppress(OSError):  # a process that ended meanwhile
                fields = stat.read_text().rpartition(")")[2].split()
                if int(fields[1]) in found or int(stat.parent.name) == self._process:
                    found.add(int(stat.parent.name))
                    ticks += int(fields[11]) + int(fields[12])
        return ticks / os.sysconf("SC_CLK_TCK")

    def size(self, width: int, height: int, *, phone: bool = False) -> None:
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        kinds = (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end))
        for kind, (x, y) in kinds:
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def press(self, key: str, code: int) -> None:
        """A key of the keyboard, by its name and its number in Windows."""
        for kind in ("rawKeyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def picture(self, **clip: float) -> bytes:
        area = {"clip": {**clip, "scale": 1}} if clip else {}
        return base64.b64decode(self.call("Page.captureScreenshot", format="png", **area)["data"])


@contextmanager
def tab(profile: Path, *options: str) -> Iterator[Tab]:
    """A new browser with one empty page. `profile`: an empty folder; options: of the browser."""
    ours_read, theirs_write = os.pipe()
    theirs_read, ours_write = os.pipe()
    # the browser reads from descriptor 3 and writes to 4
    command = 'exec 3<&"$1" 4>&"$2"; shift 2; exec "$@"'
    program = [str(installed()), *OPTIONS, *options, f"--user-data-dir={profile}"]
    process = subprocess.Popen(["bash", "-c", command, "bash", str(theirs_read), str(theirs_write), *program],
                               pass_fds=(theirs_read, theirs_write), stderr=subprocess.DEVNULL)  # fmt: skip
    os.close(theirs_read)
    os.close(theirs_write)
    try:
        found = Tab(ours_write, ours_read, process.pid)
        found.attach()
        yield found
    finally:
        process.terminate()
        process.wait(20)
        os.close(ours_read)
        os.close(ours_write)
