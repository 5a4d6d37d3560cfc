"""Captures one after another, or N at a time, as processes of this machine. No server, no Prefect."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline import threads
from pipeline.verdict import Level
from workflows.batch.failures import Failure
from workflows.batch.loop import Ended
from workflows.batch.request import BatchRequest
from workflows.batch.state import Entry
from workflows.run.request import RunRequest
from workflows.run.watchdog import grace

CHILD = (sys.executable, "-m", "workflows.batch.child")
POLL = 0.5  # seconds that one call of `poll` waits for something to happen
OVERDUE = 15.0  # seconds beyond limit and grace after which a child is killed from here: it could not end itself


@dataclass(slots=True)
class _Child:
    """A running capture. since: monotonic time of its last stage's begin. told: the last event of its kind."""

    name: str
    process: subprocess.Popen[bytes]
    limit: float | None
    since: float
    oom_kills: int
    stage: str | None = None
    fault: Failure | None = None
    batch: int | None = None
    done: bool = False
    level: Level | None = None
    overdue: bool = False


@dataclass(slots=True)
class Processes:
    """A Runner whose runs are child processes."""

    request: BatchRequest
    slots: int = 1
    command: tuple[str, ...] = field(default_factory=lambda: CHILD)
    _children: dict[str, _Child] = field(default_factory=dict)
    _events: queue.Queue[tuple[str, dict[str, Any] | None]] = field(default_factory=queue.Queue)

    def start(self, entry: Entry, request: RunRequest) -> None:
        """Start the capture's process; its stderr goes to OUT/batch/logs."""
        log = self.request.folder / "logs" / f"{entry.name.replace('/', '__')}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        read_end, write_end = os.pipe()
        with log.open("ab") as stream:
            process = subprocess.Popen(
                [*self.command, str(write_end), str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=stream,
                stderr=stream,
                pass_fds=(write_end,),
                env=_environment(self.slots),
                start_new_session=True,
            )
        os.close(write_end)
        assert process.stdin is not None
        try:
            process.stdin.write(request.model_dump_json().encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            pass  # it died at once: the end of its events shows that
        limit, now = request.stage_limit, time.monotonic()
        self._children[entry.name] = _Child(entry.name, process, limit, now, _oom_kills())
        threading.Thread(target=self._listen, args=(entry.name, read_end), daemon=True).start()

    def poll(self) -> Iterator[Ended]:
        """What ended, after at most POLL seconds."""
        self._end_overdue()
        try:
            name, event = self._events.get(timeout=POLL)
        except queue.Empty:
            return
        while True:
            if event is None:
                yield self._ended(name)
            else:
                self._heard(self._children[name], event)
            try:
                name, event = self._events.get_nowait()
            except queue.Empty:
                return

    def close(self, stopped: bool) -> Iterator[Ended]:
        """Let the children stop at their next checkpoint (stopped) or end as they will; wait for all."""
        if stopped:
            for child in self._children.values():
                _close_stdin(child)
        while self._children:
            yield from self.poll()

    def kill(self) -> None:
        """End all children at once: the second Ctrl-C."""
        for child in list(self._children.values()):
            _kill(child)

    # ---------------------------------------------------------------- events of a child
    def _listen(self, name: str, descriptor: int) -> None:
        with os.fdopen(descriptor, "rb") as events:
            for line in events:
                try:
                    self._events.put((name, json.loads(line)))
                except ValueError:
                    continue  # the last line of a process that was killed while it wrote
        self._events.put((name, None))

    def _heard(self, child: _Child, event: dict[str, Any]) -> None:
        if event["event"] == "stage":
            child.stage, child.since = event["stage"], time.monotonic()
        elif event["event"] == "plan":
            child.batch = event["batch"]
        elif event["event"] == "done":
            child.done, child.level = True, event.get("level")
        elif event["event"] == "failed":
            child.fault = Failure.model_validate(event["fault"])

    def _end_overdue(self) -> None:
        for child in self._children.values():
            if child.limit is not None and not child.overdue:
                late = time.monotonic() - child.since - child.limit - grace(child.limit)
                if late > OVERDUE:
                    child.overdue = True
                    _kill(child)

    def _ended(self, name: str) -> Ended:
        child = self._children.pop(name)
        _close_stdin(child)
        code = child.process.wait()
        if child.done:
            return Ended(name, level=child.level)
        if child.fault is not None:
            return Ended(name, child.fault, child.batch)
        return Ended(name, _silent_end(child, code, time.monotonic()), child.batch)


def _silent_end(child: _Child, code: int, now: float) -> Failure:
    """The fault of a process that ended without a word."""
    if child.limit is not None and (child.overdue or now - child.since >= child.limit):
        text = f"{child.stage or 'the run'} did not stop within its {child.limit:g} s and was ended; the log has stacks"
        return Failure(kind="limit", message=text, stage=child.stage)
    if code == -signal.SIGKILL and _oom_kills() > child.oom_kills:
        return Failure(kind="memory", message="the kernel ended the process: out of memory", stage=child.stage)
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    return Failure(kind="lost", message=f"the process ended without a message ({how}); see its log", stage=child.stage)


def _close_stdin(child: _Child) -> None:
    stdin = child.process.stdin
    if stdin is not None and not stdin.closed:
        try:
            stdin.close()
        except BrokenPipeError:
            return


def _kill(child: _Child) -> None:
    try:
        os.killpg(child.process.pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def _environment(slots: int) -> dict[str, str]:
    """Several fits at a time share the cores; a single fit uses them all."""
    environment = dict(os.environ)
    here = str(Path(__file__).resolve().parents[1])
    environment["PYTHONPATH"] = os.pathsep.join(p for p in (here, environment.get("PYTHONPATH", "")) if p)
    if slots > 1:
        each = str(max(1, len(os.sched_getaffinity(0)) // slots))
        for name in threads.NAMES:
            environment.setdefault(name, each)
    return environment


def _oom_kills() -> int:
    """Processes that the kernel ended for lack of memory since it started; 0 where that is not known."""
    try:
        lines = Path("/proc/vmstat").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("oom_kill "))
    except (OSError, StopIteration, ValueError):
        return 0
