"""What a batch of this machine does that is told to stop, as a second table for docs/benchmarks/signals.md.

    python -m benchmarks.kill_batch FOLDER [--signals INT TERM HUP KILL TWICE] [--write]

As benchmarks/kill_matrix.py for one run, whose cells these are. The batch has two captures of three small photos, and
toy stages behind the real capture (tests/support/toy_batch.py). No clock decides where a capture is: its process is
held at a named point, and the signal goes to the batch; then the capture goes on. While it starts up it is `neuface`
itself, up to the stage capture, in a folder of its own: the toy's program imports more before it can heed a signal. The
batch is started again and again into the same folder; at the end it goes through undisturbed, and each asset must have
the bytes of a batch that nothing disturbed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from benchmarks.kill_matrix import (
    AT_ONCE,
    LAST,
    MARK,
    ONE_THREAD,
    PATIENCE,
    SAME,
    SIGNALS,
    START_UP,
    TRACES,
    Cell,
    Column,
    column_in,
    not_ignored,
    shown,
    store,
    struck,
    survivors,
    table,
    too_early,
)
from tests.support.facescape_tree import write_tree
from tests.support.points import Point, hold
from workflows.bench.captures import commit
from workflows.run import host_info
from workflows.run.run_lock import is_held

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "docs/benchmarks/signals_batch.json"
BEGIN, END = "<!-- made by benchmarks/kill_batch.py -->", "<!-- end of the batch -->"
TOY = ROOT / "tests/support/toy_batch.py"
CAPTURES = ("1/1_neutral", "2/1_neutral")
STEPS = 60  # of the toy stage: each start of the batch takes up to two further
STEPPED = ("--set", f"work.steps={STEPS}")
STAGES = ("capture", "work", "usd")
CHECKPOINT = "work.checkpoint@2"
LET_GO = 0.2  # seconds from the signal until the held capture goes on: a point that is no checkpoint heeds no signal
GONE = 5.0  # seconds in which the captures' processes must follow a batch that was killed


@dataclass(frozen=True)
class Moment:
    """When a signal comes: `wait` seconds after the start, or when a capture's process is held at a point. finished:
    this person's capture is finished before."""

    name: str
    wait: float | None = None
    point: str = ""
    finished: str = ""


MOMENTS = (
    *(Moment(f"{wait:g} s after the start", wait) for wait in START_UP),
    Moment("first capture, before its first stage", point="child.begin"),
    Moment("first capture, first stage, begin", point="capture.begin"),
    Moment("first capture, first stage, stored", point="capture.end"),
    Moment("first capture, second stage, begin", point="work.begin"),
    Moment("first capture, at a checkpoint", point=CHECKPOINT),
    Moment("first capture, second stage, stored", point="work.end"),
    Moment("first capture, last stage, begin", point="usd.begin"),
    Moment("first capture, last stage, stored", point="usd.end"),
    Moment("first capture, before results are replaced", point="publish.ready"),
    Moment("first capture, results are published", point="publish.done"),
    Moment("second capture, at a checkpoint", point=CHECKPOINT, finished="1"),
    Moment("second capture, before results are replaced", point="publish.ready", finished="1"),
)


def start(
    folder: Path, out: Path, mark: str, point: Point | None, *more: str, program: Sequence[str] = (str(TOY),)
) -> subprocess.Popen[str]:
    """The batch's process, in a group of its own; all that it starts has the mark in its environment."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_API") and k != "NEUFACE_STORE"}
    environment = {**kept, **ONE_THREAD, "PYTHONPATH": str(ROOT), MARK: mark, **(point.environment() if point else {})}
    command = [sys.executable, *program, "batch", str(folder / "tree"), "--out", str(out), *more]
    with (folder / "said.txt").open("w") as said:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, text=True, cwd=ROOT,
                                env=environment, start_new_session=True)  # fmt: skip


def run_through(folder: Path, out: Path, *more: str) -> dict[str, str]:
    """Let a batch go to its end. The hash of each asset, by its capture."""
    process = start(folder, out, uuid.uuid4().hex, None, *STEPPED, *more)
    code = process.wait(PATIENCE)
    if code not in (0, 3):
        raise SystemExit(f"the batch failed with exit code {code}: {(folder / 'said.txt').read_text()}")
    return {c: json.loads(f.read_text())["asset_hash"] for c in CAPTURES if (f := out / c / "run.json").is_file()}


def left_in(out: Path) -> set[Path]:
    """Folders of results that are being made."""
    return {p for pattern in (".store/*/*.partial-*", "*/*/.*.partial-*") for p in out.glob(pattern)}


def strike(folder: Path, out: Path, moment: Moment, name: str) -> Cell:
    """One batch that gets the signal at this moment, and what it left."""
    mark, before = uuid.uuid4().hex, {*left_in(out), *left_in(out.with_name(f"{out.name}-start"))}
    if moment.wait is None:
        point = hold(moment.point, folder / f"signs-{mark[:8]}")
        process = start(folder, out, mark, point, *STEPPED)
    else:
        point, out = None, out.with_name(f"{out.name}-start")
        process = start(folder, out, mark, None, "--until", "capture", program=("-m", "workflows.cli"))
    end = time.monotonic() + PATIENCE
    while point is not None and not point.reached() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.005)
    with suppress(subprocess.TimeoutExpired):
        process.wait(moment.wait or 0.05)
    if process.poll() is not None:
        return Cell(None)
    if point is not None:
        threading.Timer(LET_GO, point.release).start()
    cell = struck(process, name)
    cell.faults += _faults(folder, out, name, mark, before)
    return too_early(cell, (folder / "said.txt").read_text(errors="replace"))


def _faults(folder: Path, out: Path, name: str, mark: str, before: set[Path]) -> Iterator[str]:
    said = [folder / "said.txt", *(out / "batch/logs").glob("*.log")]
    found = [m[0].strip() for f in said if (m := TRACES.search(f.read_text(errors="replace")))]
    if found:
        yield f"says {found[0]}"
    end = time.monotonic() + GONE
    while ((left := survivors(mark)) or _is_locked(out)) and time.monotonic() < end:
        time.sleep(0.05)  # the kernel closes a dying process's files after it has lost its environment
    if left:
        yield f"{len(left)} processes live on"
    if _is_locked(out):
        yield "a lock is held"
    for capture in CAPTURES:
        published = [p for p in ("asset", "report", "run.json") if (out / capture / p).exists()]
        if published and "run.json" not in published:
            yield f"published {', '.join(published)} alone"
    if name not in AT_ONCE and (partial := left_in(out) - before):
        yield f"left {len(partial)} partial folders"


def _is_locked(out: Path) -> bool:
    """Whether the batch or a capture is."""
    return any(is_held(out / ".store", held) for held in (out / "batch", *(out / c for c in CAPTURES)))


def forget(out: Path, moment: Moment) -> None:
    """Remove the results that a capture must be without to come to a point. Toys are fast: a capture that was let go
    may have finished before it heard of the batch's signal."""
    first = "work" if moment.finished else moment.point.partition(".")[0]
    stages = STAGES[STAGES.index(first) :] if first in STAGES else STAGES[-1:]
    for path in (*(out / ".store" / s for s in stages), *(out / c for c in CAPTURES)):
        shutil.rmtree(path, ignore_errors=True)


def column(folder: Path, name: str, whole: dict[str, str]) -> Column:
    """One signal at all moments, and whether the batch that is left alone afterwards has the same bytes."""
    out, cells = folder / f"{name}-{uuid.uuid4().hex[:8]}", dict[str, Cell]()
    for moment in MOMENTS:
        if moment.point:
            forget(out, moment)
        if moment.finished:
            run_through(folder, out, "--subjects", moment.finished)
        cells[moment.name] = strike(folder, out, moment, name)
        print(f"{name:5} {moment.name:32} {cells[moment.name]}", flush=True)
    cells[LAST] = Cell(0, 0.0, [SAME if run_through(folder, out) == whole else "OTHER BYTES"])
    print(f"{name:5} {LAST:32} {cells[LAST]}", flush=True)
    machine = host_info.describe(host_info.machine())
    return Column(f"{machine}; commit {commit()}; {len(CAPTURES)} captures, toy stages of {STEPS} steps", cells)


def recorded() -> dict[str, Column]:
    """The columns of the page, by the signal's name."""
    return {name: column_in(c) for name, c in json.loads(RECORD.read_text()).items()} if RECORD.is_file() else {}


def part(columns: dict[str, Column]) -> str:
    """The table between its own marks."""
    return "\n".join([BEGIN, *table(columns).splitlines()[1:-1], END])


def main(arguments: Sequence[str]) -> int:
    """Exit code 1 if any cell is a fault."""
    p = argparse.ArgumentParser()
    p.add_argument("folder", type=Path)
    p.add_argument("--signals", nargs="*", choices=SIGNALS, default=list(SIGNALS))
    p.add_argument("--write", action="store_true")
    given = p.parse_args(arguments)
    folder = given.folder.absolute()
    not_ignored()
    if not (folder / "tree").is_dir():
        write_tree(folder / "tree", dict.fromkeys(CAPTURES, True))
    whole = run_through(folder, folder / "whole")
    found = recorded() if given.write else {}
    for name in given.signals:
        found[name] = column(folder, name, whole)
        if given.write:  # at once: a call that is stopped has not worked for nothing
            found = store(RECORD, found, SIGNALS)
    return shown(found, part(found), write=given.write)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
