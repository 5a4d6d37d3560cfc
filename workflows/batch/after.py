"""What a batch makes of its captures together, after their own runs: measured expressions and the average head."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pipeline.contract import StageConfig
from pipeline.errors import Cancelled, DiskError, UsageError
from pipeline.store import Store
from stages import registry
from workflows.batch.average import average, check_average
from workflows.batch.average_stage import Config as AverageConfig
from workflows.batch.captures import Item
from workflows.batch.failures import failure_of
from workflows.batch.neutral import check_neutral, measure, subjects, wants_another_run
from workflows.batch.request import BatchRequest
from workflows.batch.state import Averaged, Entry, Measured, Summary
from workflows.run.plan import check_settings

Pair = tuple[Item, Entry]
LAST = {"--neutral": "usd", "--average": "bake"}  # option -> stage that every run must reach


def check_parts(request: BatchRequest, items: Sequence[Item]) -> None:
    """Are the settings of each capture such that the parts asked for can be made?

    Raises:
        UsageError: they are not; nothing has run yet.
    """
    asked = [o for o, on in (("--neutral", request.neutral is not None), ("--average", request.average)) if on]
    if request.neutral is not None:
        check_neutral(items, request.neutral)
    if request.average:
        check_average(items, Path(request.out).absolute())
    for item in {str(i.own): i for i in items}.values():
        own = request.run_request(item.capture, item.name, (), item.own)
        configs = check_settings(own)
        for option in asked:
            _has_head(option, configs, own.until)


def _has_head(option: str, configs: dict[str, StageConfig], until: str | None) -> None:
    mesh: Any = getattr(configs.get("uv"), "mesh", None)
    if mesh not in ("template", "both"):
        raise _refused(option, "uv.mesh", mesh, "template or both: heads are compared by the template's topology")
    if not getattr(configs.get("template"), "enabled", True):
        raise _refused(option, "template.enabled", False, "true")
    names = [s.name for s in registry.REGISTRY]
    if until is not None and names.index(until) < names.index(LAST[option]):
        raise _refused(option, "--until", until, f"{LAST[option]} or a later stage")
    if option == "--neutral" and not getattr(configs.get("usd"), "expressions", True):
        raise _refused(option, "usd.expressions", False, "true: measured expressions are blend shapes as the others")


def _refused(option: str, where: str, value: object, limit: str) -> UsageError:
    return UsageError(
        f"{option} can't be made with this setting",
        where=where,
        value=value,
        limit=limit,
        remedy=f"leave {where} out, or leave out {option}",
    )


def to_measure(
    pairs: Sequence[Pair],
    request: BatchRequest,
    summary: Summary,
    stopped: Callable[[], bool],
    notify: Callable[[str], None],
) -> Iterator[Entry]:
    """Measure every person's expressions; those neutrals whose asset has to be written with them."""
    assert request.neutral is not None
    out, store = Path(request.out).absolute(), Store(request.store_path)
    for person in subjects(pairs, request.neutral):
        _stop_if(stopped)
        try:
            made = measure(person, out, store, stopped)
        except DiskError as e:
            summary.held = failure_of(e)
            return
        summary.measured.append(made)
        notify(told(made))
        if person.neutral is not None and wants_another_run(person.neutral, made):
            yield person.neutral


def told(made: Measured) -> str:
    """One line for the user."""
    left = f", {len(made.left_out)} left out" if made.left_out else ""
    return f"{made.subject}: " + (
        f"no measured expressions: {made.reason.strip().splitlines()[0]}{left}"
        if made.reason
        else f"{len(made.shapes)} measured expressions{left}"
    )


def make_average(
    pairs: Sequence[Pair],
    request: BatchRequest,
    summary: Summary,
    stopped: Callable[[], bool],
    notify: Callable[[str], None],
) -> None:
    """The average of all captures, or of the neutrals if the batch has them."""
    _stop_if(stopped)
    entries = [e for _, e in pairs]
    if request.neutral is not None:
        entries = [p.neutral for p in subjects(pairs, request.neutral) if p.neutral is not None]
    item = pairs[0][0]
    template: Any = check_settings(request.run_request(item.capture, item.name, (), item.own)).get("template")
    config = AverageConfig(folder=template.folder, folder_digest=template.folder_digest)
    try:
        out, store = Path(request.out).absolute(), Store(request.store_path)
        made = average(entries, out, store, config, stopped, notify=notify)
    except DiskError as e:
        summary.held = failure_of(e)
        made = Averaged(reason=str(e))
    summary.average = made
    sharp = f", sharpness {made.sharpness['all']:.2f}" if "all" in made.sharpness else ""
    notify(f"no average: {made.reason}" if made.reason else f"average of {len(made.captures)} heads{sharp}")


def _stop_if(stopped: Callable[[], bool]) -> None:
    if stopped():
        raise Cancelled("stopped by the user; finished captures are kept, and the same command resumes")
