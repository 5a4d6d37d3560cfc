"""The report's page is large, and OUT and OUT's own store would each have one that differs in the seconds alone.

After a run the store therefore gives its page up, and the next run takes it back from OUT, without the seconds. A page
that OUT no longer has as it was published is made again. `--keep-all` keeps both.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.artifacts import FileRef, Located
from pipeline.asset_artifacts import Report
from pipeline.contract import Done
from pipeline.store import write_synced
from workflows.run.plan import Plan
from workflows.run.report_timing import with_seconds
from workflows.run.request import OWN_STORE

STAGE, PAGE = "report", "index.html"


def page_in_one_place(plan: Plan, stages: Mapping[str, Done[Any]]) -> None:
    """After the report was published: remove the store's page, if it can be had back from OUT byte by byte."""
    if plan.request.keep_all or STAGE not in stages or not owns_its_store(plan):
        return
    located: Located[Report] = stages[STAGE].located
    for ref in _pages(located.artifact):
        if _without_seconds(plan.out, ref) is not None:
            with plan.store.lock(STAGE, stages[STAGE].key):
                located.path(ref).unlink(missing_ok=True)


def put_page_back(plan: Plan) -> None:
    """Before a run: complete the stored report whose page OUT has. Others stay as they are, and are made again."""
    folder = plan.store.root / STAGE
    if not owns_its_store(plan) or not folder.is_dir():
        return
    for made in folder.iterdir():
        with suppress(OSError, ValidationError):  # no finished result: the store deals with what is damaged
            for ref in _pages(plan.store.manifest(STAGE, made.name, Report)):
                target = made / ref.path
                content = None if target.exists() else _without_seconds(plan.out, ref)
                if content is not None:
                    write_synced(target, content)


def owns_its_store(plan: Plan) -> bool:
    """Whether finished stages are kept in OUT itself, for this run alone."""
    return plan.store.root.resolve() == (plan.out / OWN_STORE).resolve()


def _pages(report: Report) -> list[FileRef]:
    return [f for f in report.files if f.path == PAGE]


def _without_seconds(out: Path, ref: FileRef) -> bytes | None:
    """The stored page, from the published one; None if that is not there, or is another."""
    try:
        content = with_seconds(PAGE, (out / STAGE / PAGE).read_bytes(), {})
    except (OSError, ValueError):
        return None
    return content if hashlib.sha256(content).hexdigest() == ref.sha256 else None
