"""A whole run: its stages and what is published of them, alone in its folders. The same with Prefect and without."""

from __future__ import annotations

from typing import Any

from pipeline.errors import Cancelled
from workflows.alone import alone
from workflows.folders import writable
from workflows.plan import Plan
from workflows.publish import publish
from workflows.runner import RunStage, run_plan
from workflows.session import current


def complete(plan: Plan, run_stage: RunStage) -> dict[str, Any]:
    """Run a plan's stages and publish asset/, report/ and run.json in its `out`. Hands back what run.json holds.

    Raises:
        StageError: a stage can't go on, or a disk fault. Cancelled: the user stopped it; nothing was published.
    """
    watch = current()
    with (
        writable(plan.out, plan.store.root),
        alone(plan.store.root, plan.out, watch.stopped, watch.observer.note),
    ):
        done = run_plan(plan, run_stage)
        if watch.stop.is_set():
            raise Cancelled("stopped by the user; finished stages are kept, nothing was published")
        return publish(plan, done, watch.observer.note)
