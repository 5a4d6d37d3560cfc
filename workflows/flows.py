"""The flows: photos of a head in, an asset and its report out; and a tree of captures, each as a run of its own."""

import pipeline.threads  # noqa: F401  isort: skip  (before anything that loads torch)

from pathlib import Path
from typing import Any

from prefect import flow

from workflows.adapter import as_tasks, publish_result, report_batch
from workflows.alone import alone
from workflows.batch_request import BatchRequest
from workflows.folders import writable
from workflows.forms import takes
from workflows.plan import Plan, RunRequest, make_plan
from workflows.publish import publish
from workflows.runner import run_plan
from workflows.session import current


@flow(name="capture-to-asset", flow_run_name="{capture} -> {out}", retries=0, persist_result=False)
@takes(RunRequest)
def capture_to_asset(**asked: Any) -> dict[str, Any]:
    """Run the stages on one capture and publish asset/, report/ and run.json in `out`."""
    request = RunRequest(**asked)
    watch = current()
    out, store = Path(request.out).absolute(), request.store_path
    with writable(out, store), alone(store, out, watch.stop.is_set, watch.observer.note):
        prepared = watch.plan
        plan: Plan = prepared if prepared is not None and prepared.request == request else make_plan(request)
        record = publish(plan, run_plan(plan, as_tasks(plan)))
    publish_result(Path(request.out), record)
    return record


@flow(name="facescape-batch", flow_run_name="{root} -> {out}", retries=0, persist_result=False)
@takes(BatchRequest)
def facescape_batch(**asked: Any) -> dict[str, int]:
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
    return summary.counts()
