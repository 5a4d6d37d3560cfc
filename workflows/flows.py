"""The flows: photos of a head in, an asset and its report out; and a tree of captures, each as a run of its own."""

import pipeline.threads  # noqa: F401  isort: skip  (before anything that loads torch)

from pathlib import Path
from typing import Any

from prefect import flow
from prefect.states import Completed

from workflows.adapter import as_tasks, publish_result, report_batch
from workflows.alone import alone
from workflows.batch_request import BatchRequest
from workflows.folders import writable
from workflows.forms import takes
from workflows.plan import Plan, RunRequest, make_plan
from workflows.publish import publish
from workflows.runner import run_plan
from workflows.session import current
from workflows.verdict import last_lines, level_in, state_name


@flow(name="capture-to-asset", flow_run_name="{capture} -> {out}", retries=0, persist_result=False)
@takes(RunRequest)
def capture_to_asset(**asked: Any) -> Any:
    """Run the stages on one capture and publish asset/, report/ and run.json in `out`.

    It ends Completed where the result is good, else in a completed state named Usable or Unusable: the run did its
    work, and nothing that tries failed runs again should do it twice. Called as a function it hands back run.json.
    """
    request = RunRequest(**asked)
    watch = current()
    out, store = Path(request.out).absolute(), request.store_path
    with writable(out, store), alone(store, out, watch.stop.is_set, watch.observer.note):
        prepared = watch.plan
        plan: Plan = prepared if prepared is not None and prepared.request == request else make_plan(request)
        record = publish(plan, run_plan(plan, as_tasks(plan)))
    publish_result(Path(request.out), record)
    name = state_name(level_in(record))
    return record if name is None else Completed(name=name, message="\n".join(last_lines(record)), data=record)


@flow(name="facescape-batch", flow_run_name="{root} -> {out}", retries=0, persist_result=False)
@takes(BatchRequest)
def facescape_batch(**asked: Any) -> Any:
    """Submit every capture of a tree or list as a run of its own, follow them, and keep a table and a page.

    Run it in a pool of its own: it waits for the captures' runs and would hold the slot that they need.
    """
    from workflows.batch import run_batch
    from workflows.batch_prefect import Pool

    request = BatchRequest(**asked)
    watch = current()
    summary = run_batch(request, Pool(request), stopped=watch.stop.is_set, said=watch.observer.note)
    report_batch(Path(request.out), summary.counts())
    if summary.failed:
        raise RuntimeError(
            f"{summary.failed} of {summary.total} captures have no asset: {request.out}/batch/index.html"
        )
    refused, counts = summary.refused(request.strict), summary.counts()
    told = f"{refused} of {summary.total} results are not good enough"
    return Completed(name="Unusable", message=told, data=counts) if refused else counts
