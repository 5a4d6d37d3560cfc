"""What becomes of a run whose worker is told to stop, as a third table for docs/benchmarks/signals.md.

    python -m benchmarks.kill_pool FOLDER [--signals INT TERM HUP KILL] [--moments TEXT ...] [--write]

The pool is that of docs/operations.md (benchmarks/pool.py), with a capture of three small photos and toy stages behind
the real one. For each moment a run is submitted with `prefect deployment run`, a worker takes it and holds it at a
named point, and the signal goes to the worker. Within two minutes the run must have ended or been marked as crashed, or
wait for the next worker, which then starts. Then every run that did not complete is submitted again into its folder,
and must give the asset of a run that nothing disturbed and leave nothing behind.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from benchmarks.kill_batch import GONE
from benchmarks.kill_matrix import LAST, MARK, SAME, not_ignored, shown, store, survivors
from benchmarks.pool import ENDED, Pool, running, wait_until
from tests.support.facescape_tree import write_tree
from tests.support.points import Point, hold
from tests.support.servers import Process
from workflows.bench.captures import commit
from workflows.run import host_info
from workflows.run.run_lock import is_held

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "docs/benchmarks/signals_pool.json"
BEGIN, END = "<!-- made by benchmarks/kill_pool.py -->", "<!-- end of the pool -->"
SIGNALS = ("INT", "TERM", "HUP", "KILL")
CAPTURE, STEPS = "1/1_neutral", 6
MARKED = 120.0  # seconds in which the run of a killed worker must be marked
WORKS = 1.0  # seconds until a held process goes on: a worker that waits for its run sees it end
STOPS = 60.0  # seconds in which a worker must stop
PATIENCE = 300.0  # seconds until a run counts as one that never comes to its point
PREFECTS = ("prefect-workspace-attempt-*", "runner_storage", "tmp*prefect")  # that Prefect leaves in TMPDIR itself


@dataclass(frozen=True)
class Moment:
    """When the signal comes: `wait` seconds after the worker's start, when the run has a state, or is held at a
    point."""

    name: str
    wait: float | None = None
    state: str = ""
    point: str = ""


MOMENTS = (
    Moment("0.4 s after the worker's start", wait=0.4),
    Moment("3 s after the worker's start", wait=3.0),
    Moment("the run is taken", state="PENDING"),
    Moment("its imports", point="flow.import"),
    Moment("before its first stage", point="flow.begin"),
    Moment("first stage, begin", point="capture.begin"),
    Moment("first stage, stored", point="capture.end"),
    Moment("second stage, begin", point="work.begin"),
    Moment("second stage, first checkpoint", point="work.checkpoint"),
    Moment("second stage, last checkpoint", point=f"work.checkpoint@{STEPS}"),
    Moment("second stage, stored", point="work.end"),
    Moment("last stage, begin", point="usd.begin"),
    Moment("last stage, stored", point="usd.end"),
    Moment("before results are replaced", point="publish.ready"),
    Moment("results are published", point="publish.done"),
)


@dataclass
class Cell:
    """worker: its exit code as a shell counts it; end: what became of the run; seconds until then."""

    worker: int | None
    end: str
    seconds: float = 0.0
    faults: list[str] = field(default_factory=list)

    def is_fault(self) -> bool:
        """Whether something is wrong with it."""
        return bool(self.faults)

    def __str__(self) -> str:
        if self.faults:
            return "; ".join(self.faults)
        return self.end if self.worker is None else f"{self.worker}; {self.end}, {self.seconds:.0f} s"


@dataclass(frozen=True)
class Column:
    """One signal at all moments. made: how."""

    made: str
    cells: dict[str, Cell]


@dataclass
class Struck:
    """A run whose worker got the signal. at: wall clock of this machine, seconds; picked_up: by the next worker."""

    moment: Moment
    out: Path
    run: str
    cell: Cell
    at: float = 0.0
    picked_up: bool = False

    @property
    def store(self) -> Path:
        """Of this run alone."""
        return self.out / ".store"


# ------------------------------------------------------------------ one moment
def strike(pool: Pool, moment: Moment, name: str, out: Path, number: int) -> Struck:
    """Submit a run, start a worker, and send it the signal at this moment."""
    point = hold(moment.point or "nowhere", pool.folder / f"signs-{uuid.uuid4().hex[:8]}")
    mark, temporary = uuid.uuid4().hex, out.with_name(f"{out.name}-tmp")
    temporary.mkdir(parents=True)
    struck = Struck(moment, out, submit(pool, out), Cell(None, ""))
    worker = pool.worker(f"{name}{number}", **point.environment(), **{MARK: mark}, TMPDIR=str(temporary))
    with worker:
        wait_for_moment(pool, struck, point)
        assert worker.child is not None
        struck.at = time.time()
        worker.child.send_signal(signal.Signals[f"SIG{name}"])
        with suppress(subprocess.TimeoutExpired):
            worker.child.wait(WORKS)
        point.release()
        try:
            code = worker.child.wait(STOPS)
            struck.cell.worker = code if code >= 0 else 128 - code
        except subprocess.TimeoutExpired:
            struck.cell.faults.append(f"the worker lives on after {STOPS:.0f} s")
    struck.cell.faults += left_behind(struck, mark, temporary)
    return struck


def wait_for_moment(pool: Pool, struck: Struck, point: Point) -> None:
    """Until the signal is due. A run that never comes there is told."""
    moment = struck.moment
    if moment.wait is not None:
        time.sleep(moment.wait)
        return

    def there() -> bool:
        return bool(point.reached()) if moment.point else pool.run(struck.run)["state_type"] == moment.state

    if not wait_until(there, PATIENCE):
        raise SystemExit(f"{moment.name} did not come: {pool.run(struck.run)['state']}")


def submit(pool: Pool, out: Path) -> str:
    """A run of the one capture into `out`, with a store of its own."""
    return pool.submit(pool.folder / "tree" / CAPTURE, out, out / ".store", f"work.steps={STEPS}")


def left_behind(struck: Struck, mark: str, temporary: Path) -> Iterator[str]:
    """What a worker and its run must not leave."""
    if not wait_until(lambda: not survivors(mark), GONE):
        yield f"{len(survivors(mark))} processes live on"
    if struck.store.is_dir() and is_held(struck.store, struck.out):
        yield "the lock is held"
    published = [p for p in ("asset", "run.json") if (struck.out / p).exists()]
    if published == ["run.json"]:
        yield "published run.json alone"
    ours = {p for p in temporary.iterdir() if not any(p.match(pattern) for pattern in PREFECTS)}
    if ours:
        yield f"left {', '.join(sorted(p.name for p in ours))}"


# ------------------------------------------------------------------ one signal
def column(pool: Pool, name: str, moments: Sequence[Moment], asset: str) -> Column:
    """One signal at all moments, and what becomes of the runs. asset: hash of an undisturbed run's."""
    base, struck = pool.folder / f"{name}-{uuid.uuid4().hex[:8]}", list[Struck]()
    for number, moment in enumerate(moments):
        one = strike(pool, moment, name, base / str(number), number)
        struck.append(one)
        if pool.run(one.run)["state_type"] == "SCHEDULED":  # now, or the next moment's worker would take it
            pick_up(pool, one)
    cells = dict[str, Cell]()
    for one in struck:
        judge_end(pool, one)
        cells[one.moment.name] = one.cell
        print(f"{name:5} {one.moment.name:32} {one.cell}", flush=True)
    cells[LAST] = again(pool, [s for s in struck if not s.cell.end.startswith(("completed", "picked"))])
    for one in struck:
        cells[LAST].faults += other_bytes(one.out, asset, one.moment.name)
    print(f"{name:5} {LAST:32} {cells[LAST]}", flush=True)
    machine = host_info.describe(host_info.machine())
    return Column(f"{machine}; commit {commit()}; {pool.database}, toy stages of {STEPS} steps", cells)


def pick_up(pool: Pool, one: Struck) -> None:
    """The next worker takes the run that waits."""
    one.picked_up = True
    with pool.worker(f"next-{uuid.uuid4().hex[:6]}") as worker:
        wait_until(lambda: pool.run(one.run)["state_type"] in ENDED, PATIENCE)
        stop(worker)


def stop(worker: Process) -> None:
    """Ask a worker to stop."""
    assert worker.child is not None
    worker.child.terminate()
    with suppress(subprocess.TimeoutExpired):
        worker.child.wait(STOPS)


def judge_end(pool: Pool, one: Struck) -> None:
    """How the run ended, and whether in time. A run that the next worker took needs as long as it works."""
    wait_until(lambda: pool.run(one.run)["state_type"] in ENDED, max(0.0, one.at + MARKED - time.time()))
    seen = pool.run(one.run)
    kind, state = seen["state_type"], seen["state"]
    one.cell.seconds = max(0.0, seconds_of(state["timestamp"]) - one.at)
    one.cell.end = "picked up" if one.picked_up and kind == "COMPLETED" else kind.lower()
    if kind not in ENDED:
        one.cell.faults.append(f"{kind} after {MARKED:.0f} s")
    elif kind == "FAILED" or (kind == "CRASHED" and one.cell.seconds > MARKED):
        one.cell.faults.append(f"{kind.lower()} after {one.cell.seconds:.0f} s: {state['message'] or ''}")


def seconds_of(timestamp: str) -> float:
    """Of a server's time of day."""
    return datetime.fromisoformat(timestamp.replace("Z", "+00:00")).timestamp()


def again(pool: Pool, left: Sequence[Struck]) -> Cell:
    """Submit these again; one undisturbed worker does them all."""
    cell = Cell(None, SAME)
    runs = [submit(pool, one.out) for one in left]
    with pool.worker(f"last-{uuid.uuid4().hex[:6]}") as worker:
        if not wait_until(lambda: all(pool.run(r)["state_type"] in ENDED for r in runs), PATIENCE * max(1, len(runs))):
            cell.faults.append("did not end")
        stop(worker)
    return cell


def other_bytes(out: Path, asset: str, name: str) -> Iterator[str]:
    """What a run that was at last left alone must not leave, nor make otherwise."""
    record = out / "run.json"
    if not record.is_file():
        yield f"{name}: no result"
    elif json.loads(record.read_text())["asset_hash"] != asset:
        yield f"{name}: OTHER BYTES"
    kinds = ("*.partial-*", "*.scratch", "*.old-*")
    if left := [p for kind in kinds for p in (*out.glob(f".{kind}"), *(out / ".store").glob(f"*/{kind}"))]:
        yield f"{name}: left {', '.join(p.name for p in left)}"


# ------------------------------------------------------------------ the page
def recorded() -> dict[str, Column]:
    """The columns of the page, by the signal's name."""
    return {name: column_in(c) for name, c in json.loads(RECORD.read_text()).items()} if RECORD.is_file() else {}


def column_in(content: dict[str, Any]) -> Column:
    """A column as its JSON has it."""
    return Column(content["made"], {moment: Cell(**c) for moment, c in content["cells"].items()})


def part(columns: dict[str, Column]) -> str:
    """The table between its marks."""
    rows = [f"| moment | {' | '.join(f'SIG{n}' for n in columns)} |", "|---" * (len(columns) + 1) + "|"]
    for moment in [*(m.name for m in MOMENTS), LAST]:
        rows.append(f"| {moment} | {' | '.join(str(c.cells.get(moment, '-')) for c in columns.values())} |")
    return "\n".join([BEGIN, *rows, "", *(f"- SIG{n}: {c.made}" for n, c in columns.items()), END])


def main(arguments: Sequence[str]) -> int:
    """Exit code 1 if any cell is a fault."""
    p = argparse.ArgumentParser()
    p.add_argument("folder", type=Path)
    p.add_argument("--signals", nargs="*", choices=SIGNALS, default=list(SIGNALS))
    p.add_argument("--moments", nargs="*", default=[""], help="texts, one of them in the moment's name")
    p.add_argument("--write", action="store_true")
    given = p.parse_args(arguments)
    folder = given.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    not_ignored()
    if not (folder / "tree").is_dir():
        write_tree(folder / "tree", {CAPTURE: True})
    moments = [m for m in MOMENTS if any(text in m.name for text in given.moments)]
    found = recorded() if given.write else {}
    with running(folder, f"pool-{os.getpid()}") as pool:
        whole = folder / f"whole-{uuid.uuid4().hex[:8]}"
        again(pool, [Struck(MOMENTS[0], whole, "", Cell(None, ""))])
        asset = json.loads((whole / "run.json").read_text())["asset_hash"]
        for name in given.signals:
            found[name] = column(pool, name, moments, asset)
            if given.write:  # at once: a call that is stopped has not worked for nothing
                found = store(RECORD, found, SIGNALS)
    return shown(found, part(found), write=given.write)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
