"""One capture in a process of its own, without Prefect: what a local batch starts for each.

    python -m workflows.batch.child EVENTS_FD PARENT < request

The request comes as one line of JSON on stdin; what happens goes as lines of JSON to the file descriptor EVENTS_FD.
The end of stdin means stop. When the batch, process PARENT, dies, the kernel kills this process.
"""

import pipeline.threads  # noqa: F401  isort: skip  (before anything that loads torch)

import json
import os
import sys
import threading
from collections.abc import Mapping
from typing import Any

from pipeline.contract import Done
from workflows.batch.failures import failure_of
from workflows.live.publisher import told_live
from workflows.run.interrupt import end_with, interruptible
from workflows.run.plan import Plan, make_plan
from workflows.run.publish import publish
from workflows.run.request import RunRequest
from workflows.run.run_lock import exclusive_run
from workflows.run.runner import run_stages
from workflows.run.session import Session
from workflows.run.verdict import exit_code, level_in


class Events:
    """An Observer that writes a line for every stage."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.stage: str | None = None

    def tell(self, **event: Any) -> None:
        """One line. Whoever read them may be gone: then stdin has ended too, and the run stops."""
        try:
            os.write(self.descriptor, json.dumps(event).encode() + b"\n")
        except BrokenPipeError:
            return

    def started(self, stage: str, number: int, of: int) -> None:
        """A stage begins."""
        self.stage = stage
        self.tell(event="stage", stage=stage, number=number, of=of)

    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None:
        """Not shown: a batch shows captures, not steps."""

    def finished(self, done: Done[Any]) -> None:
        """Not shown: run.json has it."""

    def paused(self, waits: bool) -> None:
        """Not shown: whoever paused the capture's run sees it there."""

    def replanned(self, seconds: Mapping[str, float | None], request: RunRequest) -> None:
        """Never told: captures of a batch have the batch's setting."""

    def note(self, text: str) -> None:
        """Into the capture's log."""
        print(text, file=sys.stderr, flush=True)


def main(arguments: list[str]) -> int:
    """Exit code as in `neuface`; the last event is how it ended."""
    end_with(int(arguments[1]))
    events = Events(int(arguments[0]))
    watch = Session(events)
    request = RunRequest.model_validate_json(sys.stdin.buffer.readline())
    threading.Thread(target=_stop_at_the_end_of_stdin, args=(watch,), daemon=True).start()
    try:
        with interruptible(watch.stop, events.note):  # its process group is its own: no Ctrl-C reaches it
            plan = make_plan(request)
            events.tell(event="plan", batch=rays_a_step(plan))
            lock = exclusive_run(plan.store.root, plan.out, watch.stopped, events.note)
            with lock, told_live(plan, watch) as told:
                record = publish(plan, run_stages(plan, told), told.observer.note, told.asked_to_stop)
    except Exception as e:
        fault = failure_of(e, events.stage)
        events.tell(event="failed", fault=fault.model_dump())
        if fault.kind == "bug":
            raise
        print(f"error: {e}", file=sys.stderr)
        return getattr(e, "exit_code", 1)
    events.tell(event="done", level=level_in(record))
    return exit_code(record)


def rays_a_step(plan: Plan) -> int | None:
    """What a fit that ran out of memory can halve."""
    config = plan.configs.get("inverse_rendering")
    return getattr(config, "batch", None)


def _stop_at_the_end_of_stdin(watch: Session) -> None:
    descriptor = sys.stdin.fileno()  # not through sys.stdin: its lock would be held when the interpreter ends
    while os.read(descriptor, 1024):
        continue
    watch.stop.set()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
