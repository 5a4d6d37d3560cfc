"""The run itself: stage after stage, each with the artifacts of those before it. Knows nothing of Prefect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

from pipeline.artifacts import MaskSet
from pipeline.contract import Done, Stage, StageConfig, execute, inputs_from, key
from pipeline.errors import Cancelled
from pipeline.people import shows_person
from stages.registry import FIT
from workflows.run.budget import START_UP, planned
from workflows.run.early import ends_early
from workflows.run.memory import within_memory
from workflows.run.plan import Plan, check_settings
from workflows.run.room import check_room_for_stage
from workflows.run.session import Session
from workflows.run.watchdog import time_limit

ExecuteStage = Callable[..., Done[Any]]  # as pipeline.contract.execute
Around = Callable[[Stage[Any, Any, Any], Any, StageConfig], AbstractContextManager[None]]


def run_stages(
    plan: Plan,
    watch: Session | None = None,
    execute_stage: ExecuteStage = execute,
    around: Around = lambda *_: nullcontext(),
) -> list[Done[Any]]:
    """Run the plan's stages in order; returns what was done, first to last.

    It ends before the fit where a stage before it finds its result unusable, unless the request has `force`.
    execute_stage: executes one stage; on a server, as a Prefect task. around: what surrounds a stage and does not count
    for its time limit, such as the wait for a slot of the server.

    Raises:
        StageError: from the first stage that can't go on, or takes longer than it may; those before it stay in the
            store.
        Cancelled: the user stopped the run.
    """
    watch = watch or Session()
    finished = plan.sources
    done: list[Done[Any]] = []
    for number, stage in enumerate(plan.stages, 1):
        _stop_if_asked(watch)
        watch.observer.started(stage.name, number, len(plan.stages))
        if stage.name == FIT and plan.request.budget is not None:
            plan = within_budget(plan, done, watch)
        inputs, config = inputs_from(stage, finished), plan.configs[stage.name]
        if stage.name in plan.anew:
            plan.store.forget(stage.name, key(stage, inputs, config))
        check_room_for_stage(stage, inputs, config, plan.store)
        limit = time_limit(stage.name, plan.request.stage_limit, watch.late, watch.steering)
        fits = within_memory(plan, stage, inputs, config, watch.observer.note)
        with around(stage, inputs, config), limit, watch.steering.telling(watch.observer.paused), fits:
            result = execute_stage(
                stage,
                inputs,
                config,
                plan.store,
                device=plan.device,
                progress=watch.observer.progress,
                cancelled=watch.stopped,
                show=watch.show,
            )
        watch.observer.finished(result)
        finished[stage.name] = result.located
        done.append(result)
        if ends_early(plan, done, watch):
            break
        if number < len(plan.stages):
            _stop_if_wished(watch, stage.name)
    _stop_if_asked(watch)
    return done


def _stop_if_asked(watch: Session) -> None:
    if watch.asked_to_stop():
        raise Cancelled("stopped by the user; finished stages are kept, nothing was published")


def _stop_if_wished(watch: Session, stage: str) -> None:
    """After a stage: whether the run was to go so far only."""
    if watch.steering.ends_after_stage.is_set():
        raise Cancelled(f"stopped by the user after {stage}; finished stages are kept, nothing was published")


def probably_from_template(plan: Plan, done: Sequence[Done[Any]]) -> bool:
    """Whether the head template is registered where it fits, and the photos show a person."""
    masks = [d.located.artifact for d in done if isinstance(d.located.artifact, MaskSet)]
    settings = plan.configs["template"].model_dump() if "template" in plan.configs else {}
    return bool(settings.get("enabled")) and any(shows_person(m) for m in masks)


def within_budget(plan: Plan, done: list[Done[Any]], watch: Session) -> Plan:
    """The plan with settings, from the fit on, that fit into the rest of its budget."""
    assert plan.request.budget is not None
    taken = sum(float(d.run.get("seconds", 0.0)) for d in done if not d.reused)
    left = plan.request.budget - max(watch.elapsed(), taken) - START_UP
    request = plan.request.model_dump(mode="json", include={"budget", "sets", "config", "holdout", "seed", "device"})
    purpose = {**request, "after": [d.key for d in done]}
    found = planned(plan.store, purpose, left, plan.device, from_template=probably_from_template(plan, done))
    watch.observer.note(found.describe(plan.request.budget))
    return replace(plan, configs=check_settings(plan.request, found.settings()))
