"""The flows: photos of a head in, an asset and its report out; and a tree of captures, each as a run of its own."""

import pipeline.threads  # noqa: F401  isort: skip  (before anything that loads torch)

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.context import FlowRunContext
from prefect.exceptions import TerminationSignal
from prefect.states import Completed

from pipeline.errors import Cancelled
from workflows.batch.request import BatchRequest
from workflows.live.publisher import told_live
from workflows.run.changes import run_as_asked
from workflows.run.interrupt import PARENT, end_with, interruptible
from workflows.run.plan import make_plan
from workflows.run.publish import publish
from workflows.run.request import RunRequest
from workflows.run.run_lock import exclusive_run
from workflows.run.session import Session
from workflows.run.verdict import last_lines, level_in, state_name
from workflows.server.access import check_folders
from workflows.server.adapter import execute_as_task, publish_result, report_batch, with_slot
from workflows.server.flow_signature import takes
from workflows.server.life import signs_of_life

CAPTURE_FLOW: dict[str, Any] = {
    "name": "capture-to-asset",
    "flow_run_name": "{capture} -> {out}",
    "retries": 0,
    "persist_result": False,
}


@flow(**CAPTURE_FLOW)
@takes(RunRequest)
def capture_to_asset(**asked: Any) -> Any:
    """Run the stages on one capture and publish asset/, report/ and run.json in `out`.

    It ends Completed where the result is good, else in a completed state named Usable or Unusable: the run did its
    work, and no retry of failed runs should repeat it. Called as a function it returns run.json.
    """
    return _run_capture(asked, None)


def run_with_session(request: RunRequest, watch: Session) -> dict[str, Any]:
    """The same flow, in a command of this process: `watch` shows its progress and can stop it. Returns run.json."""

    @flow(**CAPTURE_FLOW)
    @takes(RunRequest)
    def capture_to_asset(**asked: Any) -> Any:
        return _run_capture(asked, watch)

    record: dict[str, Any] = capture_to_asset(**{**request.model_dump(), "sets": list(request.sets)})
    return record


def _run_capture(asked: Mapping[str, Any], watch: Session | None) -> Any:
    request = RunRequest(**asked)
    with _watched(asked, watch) as watched:
        plan, note = make_plan(request), watched.observer.note
        lock = exclusive_run(plan.store.root, plan.out, watched.stopped, note)
        with lock, told_live(plan, watched) as told:
            plan, done = run_as_asked(plan, told, execute_as_task, with_slot(plan, told.stopped))
            record = publish(plan, done, told.observer.note, told.asked_to_stop)
    publish_result(Path(request.out), record)
    name = state_name(level_in(record))
    return record if name is None else Completed(name=name, message="\n".join(last_lines(record)), data=record)


@flow(name="facescape-batch", flow_run_name="{root} -> {out}", retries=0, persist_result=False)
@takes(BatchRequest)
def facescape_batch(**asked: Any) -> Any:
    """Submit every capture of a tree or list as a run of its own, follow them, and keep a table and a page.

    Run it in a pool of its own: it waits for the captures' runs and would hold the slot that they need.
    """
    from workflows.batch.loop import run_batch
    from workflows.batch.pool import Pool

    request = BatchRequest(**asked)
    with _watched(asked) as watch:
        summary = run_batch(request, Pool(request), stopped=watch.stop.is_set, notify=watch.observer.note)
    report_batch(Path(request.out), summary.counts())
    if summary.failed:
        raise RuntimeError(
            f"{summary.failed} of {summary.total} captures have no asset: {request.out}/batch/index.html"
        )
    refused, counts = summary.refused(request.strict), summary.counts()
    message = f"{refused} of {summary.total} results are not good enough"
    return Completed(name="Unusable", message=message, data=counts) if refused else counts


@contextmanager
def _watched(asked: Mapping[str, Any], known: Session | None = None) -> Iterator[Session]:
    """The session of this flow: that of the command (`known`), or a new one. Signals stop it at a checkpoint,
    and not at any place, as Prefect's own handler would.

    A run that a server started may only use the allowed folders, and ends with the worker that started it. Each run
    gives its server signs of life.
    """
    context = FlowRunContext.get()
    from_server = known is None and context is not None
    if from_server:
        end_with(int(os.environ.get(PARENT, os.getppid())))
        check_folders(asked)
    watch = known or Session()
    signs = signs_of_life(context.flow_run if context is not None else None)
    with signs, interruptible(watch.stop, watch.observer.note) as caught:
        try:
            yield watch
            return
        except Cancelled as e:
            if not from_server or caught.number is None:
                raise
            stopped = e
    raise TerminationSignal(caught.number) from stopped  # Prefect then calls the run cancelled or crashed
