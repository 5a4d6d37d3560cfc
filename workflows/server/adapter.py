"""The one seam between stages and Prefect.

Each stage becomes a task without Prefect's caching, result storage or retries: the store is the only cache, manifests
and folders are all that is passed, and a stage that failed on bad input would only fail again.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, cast
from uuid import UUID

from prefect import task
from prefect.artifacts import (
    create_link_artifact,
    create_markdown_artifact,
    create_progress_artifact,
    update_progress_artifact,
)
from prefect.cache_policies import NO_CACHE
from prefect.logging import get_run_logger

from pipeline.contract import Done, Stage, StageConfig, execute, key
from pipeline.store import MANIFEST
from stages.registry import FIT
from workflows.run.plan import Plan
from workflows.run.runner import Around
from workflows.run.verdict import last_lines
from workflows.server.concurrency import slot

log = logging.getLogger(__name__)
PUBLISH_EVERY = 5.0  # seconds between two updates of a progress artifact: each is a request to the server


def execute_as_task(stage: Stage[Any, Any, Any], *arguments: Any, **options: Any) -> Done[Any]:
    """As pipeline.contract.execute, but as a Prefect task."""
    as_task = task(
        name=stage.name,
        task_run_name=stage.name,
        description=(stage.run.__doc__ or "").strip(),
        version=str(stage.version),
        retries=0,
        cache_policy=NO_CACHE,
        persist_result=False,
    )
    run: Callable[[_Call], Done[Any]] = as_task(_execute)
    return run(_Call(stage, arguments, options))


class _Call:
    """A task's parameters as one object: Prefect would otherwise walk through every manifest in search of futures."""

    def __init__(self, stage: Stage[Any, Any, Any], arguments: tuple[Any, ...], options: dict[str, Any]) -> None:
        self.stage, self.arguments, self.options = stage, arguments, options

    def __repr__(self) -> str:
        return f"{self.stage.name} v{self.stage.version}, {self.arguments[1]!r}"


def _execute(call: _Call) -> Done[Any]:
    run_log, shown = get_run_logger(), _Published(call.stage.name)

    def progress(done: int, total: int, message: str = "", **figures: float) -> None:
        call.options["progress"](done, total, message, **figures)
        shown(done, total, message, figures)

    done = execute(call.stage, *call.arguments, **{**call.options, "progress": progress})
    run_log.info("%s: %s, %s", done.stage, "reused" if done.reused else f"{done.run['seconds']} s", done.key[:12])
    for warning in getattr(done.located.artifact, "warnings", ()):
        run_log.warning("%s: %s", done.stage, warning)
    shown.close("reused from the store" if done.reused else f"done in {done.run['seconds']} s")
    return done


def with_slot(plan: Plan, stopped: Callable[[], bool]) -> Around:
    """Holds a slot of the limit that the request names while the fit runs; a fit that the store has needs none."""

    def around(stage: Stage[Any, Any, Any], inputs: Any, config: StageConfig) -> AbstractContextManager[None]:
        limit = plan.request.fit_slots
        if limit is None or stage.name != FIT:
            return nullcontext()
        stored = (plan.store.folder(stage.name, key(stage, inputs, config)) / MANIFEST).is_file()
        return nullcontext() if stored else slot(limit, stopped)

    return around


class _Published:
    """A stage's progress artifact, updated every few seconds."""

    def __init__(self, stage: str) -> None:
        self.key = f"progress-{stage.replace('_', '-')}"
        self.artifact: UUID | None = None
        self.last = 0.0

    def __call__(self, done: int, total: int, message: str, figures: dict[str, float]) -> None:
        if time.monotonic() - self.last >= PUBLISH_EVERY:
            text = " ".join([message, *(f"{k} {v:.4g}" for k, v in figures.items())])
            self._put(min(100.0 * done / max(total, 1), 100.0), text.strip())

    def close(self, text: str) -> None:
        """The last word on this stage."""
        self._put(100.0, text)

    def _put(self, percent: float, text: str) -> None:
        self.last = time.monotonic()
        try:
            if self.artifact is None:
                self.artifact = cast(UUID, create_progress_artifact(percent, key=self.key, description=text))
            else:
                update_progress_artifact(self.artifact, percent, description=text)
        except Exception as e:  # only for display: an error of the server must not fail the stage
            log.debug("progress not shown: %s", e)


def publish_result(out: Path, record: dict[str, Any]) -> None:
    """Show a finished run in Prefect: a table of its stages and a link to the report."""
    lines = ["| stage | seconds | key |", "|---|---|---|"]
    for name, s in record["stages"].items():
        lines.append(f"| {name} | {'reused' if s['reused'] else s['seconds']} | `{s['key'][:12]}` |")
    warnings = [f"- {name}: {w}" for name, s in record["stages"].items() for w in s["warnings"]]
    verdict = [f"- {line.strip()}" for line in last_lines(record)]
    text = "\n".join([f"# {out.name}", f"`{out.resolve()}`", "", *verdict, "", *lines, "", *warnings])
    page = out.resolve() / "report" / "index.html"
    try:
        create_markdown_artifact(text, key="run", description="stages of this run")
        if page.is_file():
            create_link_artifact(page.as_uri(), link_text="report", key="report", description="figures and pictures")
    except Exception as e:  # the run is done and published, whatever the server does
        log.warning("the run's table is not shown on the server: %s", e)


def report_batch(out: Path, counts: dict[str, int]) -> None:
    """Show a batch's end in Prefect: how many captures came to which end, and where its page is."""
    rows = "\n".join(f"| {state} | {count} |" for state, count in counts.items())
    create_markdown_artifact(f"| state | captures |\n|---|---|\n{rows}\n\n`{out}/batch/index.html`", key="batch")
