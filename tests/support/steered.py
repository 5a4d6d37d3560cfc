"""Runs of the toy stages that a test steers, in a thread of their own."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from workflows.run.plan import Plan, make_plan
from workflows.run.request import RunRequest

TOY = Path(__file__).parents[1] / "support" / "toy_neuface.py"


class Recorded:
    """An observer that remembers what it was told."""

    def __init__(self) -> None:
        self.told: list[Any] = []

    def started(self, stage: str, number: int, of: int) -> None:
        self.told.append(stage)

    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None: ...
    def finished(self, done: Any) -> None: ...

    def paused(self, waits: bool) -> None:
        self.told.append(waits)

    def replanned(self, seconds: Any, request: RunRequest) -> None: ...

    def note(self, text: str) -> None:
        self.told.append(text)


def plan_of(photos: Path, **changes: Any) -> Plan:
    out = photos.parent / "out"
    sets = changes.pop("sets", ("second.steps=3",))
    return make_plan(RunRequest(capture=str(photos), out=str(out), sets=sets, **changes))


def in_thread(work: Any) -> tuple[threading.Thread, list[BaseException]]:
    errors: list[BaseException] = []

    def run() -> None:
        try:
            work()
        except BaseException as e:
            errors.append(e)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread, errors
