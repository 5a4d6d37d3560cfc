"""`neuface report`: the report of a run again, from its finished stages. It never begins the run anew."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.errors import StageError
from pipeline.store import MANIFEST
from stages.registry import FIT
from workflows.run.moved import keys_of, store_of
from workflows.run.plan import Plan, make_plan, preview
from workflows.run.reasons import reasons
from workflows.run.request import RunRequest

REPORT = "report"


def report_request(record: Mapping[str, Any], out: Path) -> RunRequest:
    """The request of the run that left this record, for its report alone.

    Raises:
        StageError: run.json is of another version, its store is gone, or a stage before the report is.
    """
    store = store_of(record, out)
    asked = {"out": str(out), "store": str(store), "from_stage": REPORT, "until": None}
    try:
        request = RunRequest(**{**record["request"], **asked})
    except (ValidationError, TypeError) as e:
        raise _of_another_version(out, e) from e
    if not store.is_dir():
        raise _not_alone(request, "the store is gone", f"finished stages in {store} or in {out / '.store'}")
    check_alone(make_plan(request), record)
    return request


def check_alone(plan: Plan, record: Mapping[str, Any]) -> None:
    """See that the store has every stage before the report.

    Raises:
        StageError: one would be made again, which may take as long as the run.
    """
    steps = preview(plan)
    again = [s.stage for s in steps if s.stage != REPORT and s.action != "reused" and not _has(plan, s.stage, record)]
    if again:
        value = f"{', '.join(again)} would be made again ({again[0]}: {reasons(plan, steps).get(again[0])})"
        raise _not_alone(plan.request, value, f"every stage before the report in {plan.store.root}")


def _has(plan: Plan, stage: str, record: Mapping[str, Any]) -> bool:
    """Whether a run by the clock, whose settings from the fit on are only known when it comes there, has this stage."""
    names = [s.name for s in plan.stages]
    by_clock = plan.request.budget is not None and FIT in names and names.index(stage) >= names.index(FIT)
    return by_clock and (plan.store.folder(stage, dict(keys_of(record)).get(stage, "none")) / MANIFEST).is_file()


def _of_another_version(out: Path, e: ValidationError | TypeError) -> StageError:
    fault = e.errors()[0] if isinstance(e, ValidationError) else {"loc": ("request",), "msg": str(e)}
    return StageError(
        "run.json has a request that this version does not know",
        where=out / "run.json",
        value=f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}",
        limit="the options of neuface run",
        remedy="use the version that made the run, or give the command of the run again",
    )


def _not_alone(request: RunRequest, value: str, limit: str) -> StageError:
    return StageError(
        "the report can't be made again alone",
        where=request.out,
        value=value,
        limit=limit,
        remedy="put the store back where it was; where the number of threads changed, set OMP_NUM_THREADS as it was; "
        f"or give the command of the run again, which makes all that is missing: neuface run {request.capture} ...",
    )
