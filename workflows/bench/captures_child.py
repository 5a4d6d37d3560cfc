"""One run of a capture as a process of its own, so that whatever ends it ends nothing else.

Its output goes to a log. What ended it, how far it came and how long its stages took is read from there, because a run
that failed leaves no run.json.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from workflows.bench.captures_find import PROJECT

CHILD = (sys.executable, "-m", "workflows.server.kept_child", str(os.getpid()), "-m", "workflows.cli")
GRACE = 30.0  # seconds that a run has to stop at its next checkpoint before it is killed
FINISHED = re.compile(r"^\[\d+/\d+\] (\w+): (?:(\d+(?:\.\d+)?) s|reused)\s*$")
BEGUN = re.compile(r"^\[\d+/\d+\] (\w+):")
LONGEST = 300  # characters of an error that go into the table


@dataclass(frozen=True, slots=True)
class Ended:
    """exit_code: None where the time limit or the user ended it. error: its last error in one line; stage: the last
    that it is known to have worked at; stages: seconds of those that it finished, without reused ones."""

    exit_code: int | None
    how: Literal["by itself", "time limit"]
    seconds: float
    error: str
    stage: str
    stages: dict[str, float]


def run_child(arguments: Sequence[str], log: Path, limit: float, command: Sequence[str] = CHILD) -> Ended:
    """Run `neuface ARGUMENTS` for at most `limit` seconds; nothing of it is left when this returns or raises."""
    log.parent.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    how: Literal["by itself", "time limit"] = "by itself"
    code: int | None = None
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [*command, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            env=_environment(),
            start_new_session=True,  # a group of its own, so that its helpers can be ended with it
        )
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            how = "time limit"
        finally:
            if process.poll() is None:
                _stop(process)
            _signal(process.pid, signal.SIGKILL)  # whatever it left behind
    return _ended(code, how, time.monotonic() - began, log.read_text(errors="replace").splitlines())


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Ctrl-C first: the run keeps its checkpoint, so that the next one resumes there."""
    _signal(process.pid, signal.SIGINT)
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        _signal(process.pid, signal.SIGKILL)
        process.wait()


def _signal(group: int, number: int) -> None:
    try:
        os.killpg(group, number)
    except ProcessLookupError:
        return


def _environment() -> dict[str, str]:
    here = str(PROJECT)
    paths = os.pathsep.join(p for p in (here, os.environ.get("PYTHONPATH", "")) if p)
    return {**os.environ, "PYTHONPATH": paths}


# ------------------------------------------------------------------ the end of the log
def _ended(code: int | None, how: Literal["by itself", "time limit"], seconds: float, lines: list[str]) -> Ended:
    stages, stage = {}, ""
    for line in lines:
        if match := BEGUN.match(line):
            stage = match[1]
        if match := FINISHED.match(line):
            stages[match[1]] = float(match[2] or 0.0)
    error = "" if code in (0, 3) else last_error(lines)
    if how == "by itself" and code not in (0, 3):
        stage = _after(stages) or stage
    return Ended(code, how, round(seconds, 1), error, stage, {k: v for k, v in stages.items() if v})


def _after(finished: dict[str, float]) -> str:
    """The stage that came after the last finished one: a quick failure writes nothing of its own."""
    from stages.registry import REGISTRY

    names = [s.name for s in REGISTRY]
    at = max((names.index(n) for n in finished if n in names), default=-1)
    return names[at + 1] if at + 1 < len(names) else ""


def last_error(lines: Sequence[str]) -> str:
    """The last line "error: ..." with what was found, or the last line of all."""
    for at in range(len(lines) - 1, -1, -1):
        if lines[at].startswith("error: "):
            details = (x.strip() for x in lines[at + 1 : at + 5])
            found = next((x.removeprefix("found: ") for x in details if x.startswith("found: ")), "")
            text = lines[at].removeprefix("error: ")
            return (f"{text} (found: {found})" if found else text)[:LONGEST]
    return next((x.strip() for x in reversed(lines) if x.strip()), "no message")[:LONGEST]
