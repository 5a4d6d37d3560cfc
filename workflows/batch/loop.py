"""A batch: many captures, each a run of its own. One failure does not affect the rest.

The loop here uses neither processes nor Prefect: a `Runner` starts runs and reports how they ended
(workflows/batch/local.py, workflows/batch/pool.py). The state is on disk after every change: run the same
command again to resume.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from pipeline.errors import Cancelled, StageError
from pipeline.verdict import Level
from workflows.batch import captures
from workflows.batch.after import check_parts, make_average, to_measure
from workflows.batch.captures import Item
from workflows.batch.failures import Failure, back_off, smaller
from workflows.batch.fingerprint import fingerprint
from workflows.batch.page import write_page
from workflows.batch.request import BatchRequest
from workflows.batch.state import ENDED, BatchState, Entry, Summary
from workflows.run.plan import check_settings
from workflows.run.request import RunRequest
from workflows.run.run_lock import exclusive_run

PAGE_EVERY = 20.0  # seconds between two updates of the page while the batch runs


@dataclass(frozen=True, slots=True)
class Ended:
    """How one attempt ended. fault: None when the run came to its end. batch: rays a step that the fit had. level: of
    the result, where that is known."""

    name: str
    fault: Failure | None = None
    batch: int | None = None
    level: Level | None = None


class Runner(Protocol):
    """Starts runs and reports how they end."""

    slots: int  # runs that may be under way at a time

    def start(self, entry: Entry, request: RunRequest) -> None:
        """Begin, or join, the attempt `entry.attempt`."""
        ...

    def poll(self) -> Iterable[Ended]:
        """Those that have ended since the last call; returns within a few seconds."""
        ...

    def close(self, stopped: bool) -> Iterable[Ended]:
        """No more runs. When stopped by the user, ask what is under way to stop too, and wait for it."""
        ...


@dataclass(slots=True)
class Work:
    """One capture on its way through the batch. not_before: monotonic seconds."""

    item: Item
    entry: Entry
    not_before: float = 0.0


def run_batch(
    request: BatchRequest,
    runner: Runner,
    *,
    stopped: Callable[[], bool] = lambda: False,
    notify: Callable[[str], None] = lambda text: None,
) -> Summary:
    """Bring every capture to its end. A capture that fails is an entry of the summary and no exception.

    Raises:
        StageError: no captures, folders that can't be written. UsageError: a wrong request. Cancelled: Ctrl-C.
    """
    items, store, state = checked(request), request.store_path, BatchState(request.folder)
    with exclusive_run(store, request.folder, stopped, notify):
        works = [prepared(i, state, request) for i in items]
        for work in works:
            if work.item.fault is not None:
                state.write(work.entry)
        summary = Summary([w.entry for w in works])
        notify(f"{len(items)} captures, {len(items) - summary.failed} of them done before")
        page = _Page(lambda: write_page(request, summary))
        try:
            run = partial(_loop, request=request, runner=runner, state=state, summary=summary, stopped=stopped,
                          notify=notify, page=page)  # fmt: skip
            run(works)
            _after(works, request, summary, stopped, notify, run)
        finally:
            page.last()
        return summary


def _after(
    works: list[Work],
    request: BatchRequest,
    summary: Summary,
    stopped: Callable[[], bool],
    notify: Callable[[str], None],
    run: Callable[[list[Work]], None],
) -> None:
    """What is made of the captures together; not while captures wait for room on the disk. run: runs some again."""
    pairs = [(w.item, w.entry) for w in works]
    if request.neutral is not None and summary.held is None:
        again = {e.name for e in to_measure(pairs, request, summary, stopped, notify)}
        run([w for w in works if w.item.name in again])
    if request.average and summary.held is None:
        make_average(pairs, request, summary, stopped, notify)


def checked(request: BatchRequest) -> list[Item]:
    """The captures of a request whose folders and settings fit together. Nothing is written.

    Raises:
        StageError: no captures, or results among them. UsageError: a wrong request.
    """
    items = captures.find(Path(request.root), request.subjects, request.expressions)
    _not_inside(Path(request.out).absolute(), Path(request.root))
    for item in {str(i.own): i for i in items}.values():  # a wrong setting is reported once, not by each capture
        check_settings(request.run_request(item.capture, item.name, (), item.own))
    check_parts(request, items)
    return items


def prepared(item: Item, state: BatchState, request: BatchRequest) -> Work:
    """What is known of a capture, less what is no longer true of it. Nothing is written."""
    entry = state.read(item)
    if item.fault is not None:
        entry.state, entry.fault = "failed", Failure(kind="capture", message=item.fault)
        return Work(item, entry)
    now = fingerprint(request.run_request(item.capture, item.name, (), item.own))
    if entry.fingerprint != now:
        entry = Entry(name=item.name, capture=str(item.capture), fingerprint=now, attempt=entry.attempt)
    elif entry.state in ENDED and not (Path(request.out) / item.name / "run.json").is_file():
        entry.state = "waiting"
    elif entry.state == "failed":
        entry.state, entry.fault, entry.earlier = "waiting", None, ()
    if entry.measured and (request.neutral is None or not Path(entry.measured).is_file()):
        entry.measured = ""  # not asked for any more, or purged: the asset is written without
        entry.state = "waiting" if entry.state in ENDED else entry.state
    return Work(item, entry)


def _loop(
    works: list[Work],
    request: BatchRequest,
    runner: Runner,
    state: BatchState,
    summary: Summary,
    stopped: Callable[[], bool],
    notify: Callable[[str], None],
    page: _Page,
) -> None:
    queue = [w for w in works if w.entry.state in ("submitted", "waiting")]
    queue.sort(key=lambda w: w.entry.state == "waiting")  # those that a server already has come first
    under_way: dict[str, Work] = {}

    def take(ended: Iterable[Ended]) -> None:
        for e in ended:
            work = under_way.pop(e.name)
            _settle(work, e, request, state, notify)
            if work.entry.state == "waiting":
                queue.append(work)
            if work.entry.fault is not None and work.entry.fault.kind == "disk":
                summary.held = work.entry.fault
            page.soon()

    while (queue or under_way) and not stopped() and not (summary.held and not under_way):
        while queue and len(under_way) < runner.slots and summary.held is None:
            ready = next((w for w in queue if w.not_before <= time.monotonic()), None)
            if ready is None:
                break
            queue.remove(ready)
            _start(ready, request, runner, state)
            under_way[ready.item.name] = ready
        take(runner.poll())
    take(runner.close(stopped()))
    if stopped():
        raise Cancelled("stopped by the user; finished captures are kept, and the same command resumes")


def _start(work: Work, request: BatchRequest, runner: Runner, state: BatchState) -> None:
    entry = work.entry
    if entry.state == "waiting":
        entry.attempt += 1
    entry.state, entry.fault, entry.level = "submitted", None, None
    state.write(entry)  # before it is submitted: a batch that dies here submits the same key again
    sets = (*entry.sets, f"usd.measured={entry.measured}") if entry.measured else entry.sets
    runner.start(entry, request.run_request(work.item.capture, work.item.name, sets, work.item.own))


def _settle(work: Work, ended: Ended, request: BatchRequest, state: BatchState, notify: Callable[[str], None]) -> None:
    entry, fault = work.entry, ended.fault
    if fault is None:
        entry.state, entry.level = "unusable" if ended.level == "unusable" else "done", ended.level
        notify(f"{entry.name}: {'done' if ended.level is None else f'done, {ended.level}'}")
    elif fault.kind == "stopped":
        entry.state = "waiting"
    else:
        more = _again(entry, ended, request)
        entry.state = "waiting" if more else "failed"
        entry.fault = fault
        if more:
            entry.earlier = (*entry.earlier, fault)
            work.not_before = time.monotonic() + back_off(len(entry.earlier))
        first = fault.message.strip().splitlines()[0] if fault.message.strip() else fault.kind
        notify(f"{entry.name}: {'trying again' if more else 'FAILED'} ({fault.kind}): {first}")
    state.write(entry)


def _again(entry: Entry, ended: Ended, request: BatchRequest) -> bool:
    """Whether to try once more; a fit that ran out of memory gets half the rays a step first."""
    fault = ended.fault
    if fault is None or not fault.passes or len(entry.earlier) + 1 >= request.attempts:
        return False
    if fault.kind == "memory":
        change = smaller(ended.batch) if ended.batch else None
        if change is None:
            return False
        entry.sets = (*(s for s in entry.sets if not s.startswith("inverse_rendering.batch=")), change)
    return True


class _Page:
    """The page, written now and then while the batch runs and once at its end."""

    def __init__(self, write: Callable[[], None]) -> None:
        self.write, self.at = write, 0.0

    def soon(self) -> None:
        """Something changed."""
        if time.monotonic() - self.at > PAGE_EVERY:
            with contextlib.suppress(OSError):  # a page that can't be written now is written at the end
                self.write()
            self.at = time.monotonic()

    def last(self) -> None:
        """The batch ends, in whatever way."""
        with contextlib.suppress(OSError):
            self.write()


def _not_inside(out: Path, root: Path) -> None:
    if root.is_dir() and (out.resolve() == root.resolve() or root.resolve() in out.resolve().parents):
        raise StageError(
            "the results would land among the captures",
            where="--out",
            value=out,
            limit=f"a folder outside {root}",
            remedy="choose another folder",
        )
