"""The run itself: stage after stage, each with the artifacts of those before it. Knows nothing of Prefect."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from pipeline.artifacts import Artifact, Located
from pipeline.contract import Done, Stage, StageConfig, execute, inputs_from, key
from pipeline.errors import Cancelled
from stages import registry
from stages.registry import FIT
from workflows.run.budget import START_UP, planned
from workflows.run.early import ends_early
from workflows.run.plan import Plan, check_settings
from workflows.run.session import current
from workflows.run.watchdog import time_limit

RunStage = Callable[[Stage[Any, Any, Any], Any, StageConfig], Done[Any]]


def run_plan(plan: Plan, run_stage: RunStage) -> list[Done[Any]]:
    """Run the plan's stages in order and hand back what was done, first to last.

    It ends before the fit where a stage before it finds its result unusable, unless the request says `force`.

    Raises:
        StageError: from the first stage that can't go on, or takes longer than it may; those before it stay in the
            store.
        Cancelled: the user stopped the run.
    """
    watch = current()
    finished: dict[str, Located[Artifact]] = {registry.SOURCE: plan.source}
    done: list[Done[Any]] = []
    for number, stage in enumerate(plan.stages, 1):
        if watch.stop.is_set():
            raise Cancelled("stopped by the user; finished stages are kept")
        watch.observer.started(stage.name, number, len(plan.stages))
        if stage.name == FIT and plan.request.budget is not None:
            plan = within_budget(plan, done)
        inputs, config = inputs_from(stage, finished), plan.configs[stage.name]
        if stage.name in plan.anew:
            plan.store.forget(stage.name, key(stage, inputs, config))
        result = run_stage(stage, inputs, config)
        watch.observer.finished(result)
        finished[stage.name] = result.located
        done.append(result)
        if ends_early(plan, done):
            break
    return done


def within_budget(plan: Plan, done: list[Done[Any]]) -> Plan:
    """The plan with settings, from the fit on, that the rest of its budget pays for."""
    assert plan.request.budget is not None
    watch = current()
    taken = sum(float(d.run.get("seconds", 0.0)) for d in done if not d.reused)
    left = plan.request.budget - max(time.monotonic() - watch.begun, taken) - START_UP
    request = plan.request.model_dump(mode="json", include={"budget", "sets", "config", "holdout", "seed", "device"})
    found = planned(plan.store, {**request, "after": [d.key for d in done]}, left, plan.device)
    watch.observer.note(found.describe(plan.request.budget))
    return replace(plan, configs=check_settings(plan.request, found.settings()))


def run_here(plan: Plan) -> RunStage:
    """Run a stage by a plain call, as tests and debuggers want it."""

    def run_stage(stage: Stage[Any, Any, Any], inputs: Any, config: StageConfig) -> Done[Any]:
        watch = current()
        with time_limit(stage.name, plan.request.stage_limit, watch.late):
            return execute(
                stage,
                inputs,
                config,
                plan.store,
                device=plan.device,
                progress=watch.observer.progress,
                cancelled=watch.stopped,
            )

    return run_stage
