"""A whole run: its stages and what is published of them, alone in its folders. The same with Prefect and without."""

from __future__ import annotations

from typing import Any

from pipeline.errors import Cancelled
from workflows.run.output_dirs import writable
from workflows.run.plan import Plan
from workflows.run.publish import publish
from workflows.run.run_lock import exclusive_run
from workflows.run.runner import RunStage, run_plan
from workflows.run.session import current


def complete(plan: Plan, run_stage: RunStage) -> dict[str, Any]:
    """Run a plan's stages and publish asset/, report/ and run.json in its `out`. Hands back what run.json holds.

    Raises:
        StageError: a stage can't go on, or a disk fault. Cancelled: the user stopped it; nothing was published.
    """
    watch = current()
    with (
        writable(plan.out, plan.store.root),
        exclusive_run(plan.store.root, plan.out, watch.stopped, watch.observer.note),
    ):
        done = run_plan(plan, run_stage)
        if watch.stop.is_set():
            raise Cancelled("stopped by the user; finished stages are kept, nothing was published")
        return publish(plan, done, watch.observer.note)
