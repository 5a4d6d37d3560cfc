"""What a run does that is told to stop: every signal at every moment, as a table for docs/benchmarks/signals.md.

    python -m benchmarks.kill_matrix FOLDER [--signals INT TERM HUP KILL TWICE] [--stages STAGE ...] [--write]

FOLDER gets a small demo capture, one run that nothing disturbs, and a run for each signal. That run is started again
and again into the same folder, and the signal comes each time at the next moment: during the imports, a share of the
way through each stage, and while results are published. At the end it goes through undisturbed, and must have the bytes
of the first run. Columns of earlier calls with the same FOLDER are kept; `--signals` alone makes their table.
`--write` puts them into docs/benchmarks/signals.json, and makes the page's table of it. `--stages` measures the moments
of these stages alone, in a copy of the first run without their results, for the columns of that file. TWICE is SIGTERM
and, half a second later, SIGTERM again.

A cell has the exit code and the seconds until the process was gone; "done": the moment did not come, the stage
was faster, also when it was made again with the signal sooner. A fault is in words, and makes the exit code 1.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.generated import print_or_write
from pipeline.demo.capture import write_demo_capture
from stages.registry import REGISTRY
from workflows.bench.captures import commit
from workflows.run import host_info
from workflows.run.run_lock import is_held

ROOT = Path(__file__).resolve().parents[1]
PAGE, RECORD = ROOT / "docs/benchmarks/signals.md", ROOT / "docs/benchmarks/signals.json"
BEGIN, END = "<!-- made by benchmarks/kill_matrix.py -->", "<!-- end -->"
SIGNALS = ("INT", "TERM", "HUP", "KILL", "TWICE")
AT_ONCE = {"KILL", "TWICE"}
START_UP = (0.05, 0.15, 0.4, 1.0, 2.0)  # seconds after the start of the process
SHARES = (0.1, 0.6)  # of a stage's seconds
SMALL = tuple(word for setting in (
    "inverse_rendering.steps=40", "inverse_rendering.grid_cells=64", "inverse_rendering.batch=512",
    "uv.target_faces=4000", "bake.size=256", "bake.fit_standard=false", "usd.preview_size=64", "usd.high=false",
    "usd.environment_width=64",
) for word in ("--set", setting)) + ("--holdout", "every:5:2")  # fmt: skip
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}  # other work makes it no slower
VIEWS, SIZE = 16, 96
MARK = "NEUFACE_KILL_MATRIX"
PUBLISHING = "publishing"
RETRIES = 3
LAST, SAME, NOT_COMPARED = "then undisturbed", "the same bytes", "not compared"
TOO_EARLY = "1, Python was starting"
PATIENCE = 1800.0  # seconds until a run counts as hanging
LIMIT = 60.0  # seconds from the first signal to the end
TRACED = "says Traceback"
TRACES = re.compile(r"Traceback|\*\*\* |Exception ignored|Segmentation fault|Aborted")


@dataclass(frozen=True)
class Moment:
    """When a signal comes: `wait` seconds after the start, or after the run came to `stage`.

    later: the stages after it. Partial folders that were there before are of a run that was killed: they do not count.
    """

    name: str
    wait: float
    stage: str = ""
    later: tuple[str, ...] = ()

    def has_come(self, out: Path, old: set[Path]) -> bool:
        """Whether the run is where the wait begins. old: `left_in` before it started."""
        return not self.stage or under_way(out, (self.stage,), old)

    def is_over(self, out: Path, old: set[Path]) -> bool:
        """Whether the run is beyond the stage."""
        return bool(self.stage) and self.stage != PUBLISHING and under_way(out, (*self.later, PUBLISHING), old)

    def sooner(self) -> Moment:
        """The same moment after a third of the wait, for a stage that was faster than when it was measured."""
        return replace(self, wait=self.wait / 3)


@dataclass
class Cell:
    """code: exit code, negative for a signal that the system dealt with; None where the moment did not come."""

    code: int | None
    seconds: float = 0.0
    faults: list[str] = field(default_factory=list)

    def is_fault(self) -> bool:
        """Whether something is wrong with it."""
        return any(f not in (SAME, NOT_COMPARED, TOO_EARLY) for f in self.faults)

    def __str__(self) -> str:
        if self.faults:
            return "; ".join(self.faults)
        if self.code is None:
            return "done"
        return f"{self.code if self.code >= 0 else 128 - self.code}, {self.seconds:.1f} s"


@dataclass(frozen=True)
class Column:
    """One signal at all moments. made: how."""

    made: str
    cells: dict[str, Cell]


def command(folder: Path, out: Path) -> list[str]:
    """One run, as the console script starts it."""
    return [sys.executable, "-m", "workflows.cli", "run", str(folder / "capture"), "--out", str(out), *SMALL]


def start(folder: Path, out: Path, mark: str) -> subprocess.Popen[str]:
    """The run's process, in a group of its own; all that it starts has the mark in its environment."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_API")}
    with (folder / "said.txt").open("w") as said:
        return subprocess.Popen(command(folder, out), stdin=subprocess.DEVNULL, stdout=said, stderr=said, text=True,
                                cwd=ROOT, env={**kept, **ONE_THREAD, "PYTHONPATH": str(ROOT), MARK: mark},
                                start_new_session=True)  # fmt: skip


def moments(seconds: dict[str, float]) -> Iterator[Moment]:
    """In the order in which a run comes to them. seconds: of each stage, undisturbed."""
    for wait in START_UP:
        yield Moment(f"{wait:g} s after the start", wait)
    names = [s.name for s in REGISTRY]
    for number, stage in enumerate(names):
        for share in SHARES:
            yield Moment(f"{stage}, {share:.0%}", share * seconds[stage], stage, tuple(names[number + 1 :]))
    yield Moment(PUBLISHING, 0.0, PUBLISHING)


def under_way(out: Path, stages: Sequence[str], old: set[Path]) -> bool:
    """Whether one of the stages is being made, or results are published. old: folders that do not count."""
    folders = left_in(out) - old
    publishes = any(p.parent == out and p.name.startswith(".asset.") for p in folders)
    return (PUBLISHING in stages and publishes) or any(p.parent.name in stages for p in folders if p.parent != out)


def forget(out: Path, stages: Sequence[str]) -> None:
    """Remove finished results, so that the next run makes them again."""
    for stage in stages:
        shutil.rmtree(out / ".store" / stage, ignore_errors=True)


def strike_in_time(folder: Path, out: Path, moment: Moment, name: str) -> Cell:
    """`strike`; where the stage was over before the moment, the stage is made again and the signal comes sooner."""
    cell = strike(folder, out, moment, name)
    for _ in range(RETRIES):
        if cell.code is not None or not moment.later:
            break
        forget(out, (moment.stage, *moment.later))
        moment = moment.sooner()
        cell = strike(folder, out, moment, name)
    return cell


def strike(folder: Path, out: Path, moment: Moment, name: str) -> Cell:
    """One run that gets the signal at this moment, and what it left."""
    mark = uuid.uuid4().hex
    before = (out / "run.json").is_file(), left_in(out)
    process = start(folder, out, mark)
    end = time.monotonic() + PATIENCE
    old = before[1]
    while not (moment.has_come(out, old) or moment.is_over(out, old)) and process.poll() is None:
        if time.monotonic() > end:
            break
        time.sleep(0.005)
    if not moment.is_over(out, old):
        with suppress(subprocess.TimeoutExpired):
            process.wait(moment.wait)
    if process.poll() is not None or moment.is_over(out, old):
        process.kill()
        process.wait()
        return Cell(None)
    cell = struck(process, name)
    cell.faults += _faults(folder, out, name, mark, before)
    return too_early(cell, (folder / "said.txt").read_text(errors="replace"))


def too_early(cell: Cell, said: str) -> Cell:
    """The cell; where Python itself was still starting, which answers SIGINT with exit code 1 and a traceback before it
    comes to the program's first line, with that as its only word."""
    ours = any(f"{ROOT}/{part}/" in said for part in ("workflows", "stages", "pipeline", "tests"))
    if cell.code == 1 and "KeyboardInterrupt" in said and not ours and set(cell.faults) <= {"exit code 1", TRACED}:
        cell.faults = [TOO_EARLY]
    return cell


def struck(process: subprocess.Popen[str], name: str) -> Cell:
    """A process that gets the signal: how it ended, with its faults of exit code and time."""
    begun = time.monotonic()
    number = signal.SIGTERM if name == "TWICE" else signal.Signals[f"SIG{name}"]
    process.send_signal(number)
    if name == "TWICE":
        time.sleep(0.5)
        process.send_signal(number)
    cell = Cell(process.wait(PATIENCE), time.monotonic() - begun)
    cell.faults += ending_faults(cell, number)
    return cell


def ending_faults(cell: Cell, number: signal.Signals) -> Iterator[str]:
    """What is wrong with the exit code and the time of a process that got this signal."""
    assert cell.code is not None
    code = cell.code if cell.code >= 0 else 128 - cell.code
    if code != 128 + number:
        yield f"exit code {code}"
    if cell.seconds > LIMIT:
        yield f"{cell.seconds:.0f} s until the end"


def _faults(folder: Path, out: Path, name: str, mark: str, before: tuple[bool, set[Path]]) -> Iterator[str]:
    found = TRACES.search((folder / "said.txt").read_text(errors="replace"))
    if found:
        yield f"says {found[0].strip()}"
    time.sleep(0.1)  # the kernel ends children after their parent
    if left := survivors(mark):
        yield f"{len(left)} processes live on"
    if out.is_dir() and is_held(out / ".store", out):
        yield "the lock is held"
    published = [p for p in ("asset", "report", "run.json") if (out / p).exists()]
    if not before[0] and len(published) not in (0, 3):
        yield f"published {', '.join(published)} alone"
    if name not in AT_ONCE and (left := left_in(out) - before[1]):
        yield f"left {len(left)} partial folders"


def left_in(out: Path) -> set[Path]:
    """Folders of results that are being made."""
    return {*(out / ".store").glob("*/*.partial-*"), *out.glob(".*.partial-*")}


def survivors(mark: str) -> list[int]:
    """Processes with this mark in their environment that still run."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={mark}".encode() in (entry / "environ").read_bytes():
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def not_ignored() -> None:
    """Children get the default action of every signal, also where this process was started to ignore one (`nohup`): an
    ignored signal is inherited, and a run respects it. A handler of this process is not inherited."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)


def run_through(folder: Path, out: Path) -> dict[str, object]:
    """Let a run go to its end. Returns its run.json."""
    process = start(folder, out, uuid.uuid4().hex)
    code = process.wait(PATIENCE)
    if code not in (0, 3):
        raise SystemExit(f"the run failed with exit code {code}: {(folder / 'said.txt').read_text()}")
    record: dict[str, object] = json.loads((out / "run.json").read_text())
    return record


def column(folder: Path, name: str, whole: dict[str, object], stages: Sequence[str] = ()) -> None:
    """One signal at all moments, or at those of some stages, and whether the run that is left alone afterwards has the
    same bytes."""
    out = folder / f"{name}-{uuid.uuid4().hex[:8]}"
    timing = {n: float(s) for n, s in whole["timing"].items()}  # type: ignore[attr-defined]
    cells: dict[str, Cell] = {}
    chosen = [m for m in moments(timing) if not stages or m.stage in stages]
    if stages:
        shutil.copytree(folder / "whole", out)
        forget(out, (chosen[0].stage, *chosen[0].later))
    for moment in chosen:
        cells[moment.name] = strike_in_time(folder, out, moment, name)
        print(f"{name:5} {moment.name:28} {cells[moment.name]}", flush=True)
    same = run_through(folder, out)["asset_hash"] == whole["asset_hash"]
    cells[LAST] = Cell(0, 0.0, [SAME if same else "OTHER BYTES"])
    (folder / f"{name}.json").write_text(json.dumps(asdict(Column(made(), cells)), indent=1) + "\n")


def made() -> str:
    """On what machine, of which commit, with which capture and settings."""
    machine = host_info.describe(host_info.machine())
    return f"{machine}; commit {commit()}; {VIEWS} photos of {SIZE} px, one thread, `{' '.join(SMALL)}`"


def added(old: Column, new: Column, stages: Sequence[str]) -> Column:
    """A column with the cells of some stages that were measured later. Its last row stays that of all moments."""
    last = new.cells[LAST]
    cells = {k: c for k, c in new.cells.items() if k != LAST or c.is_fault()}
    note = new.made.partition(f"; {VIEWS} photos")[0].replace("commit ", "")
    return Column(f"{old.made}; {', '.join(stages)} later: {note}, then {last}", {**old.cells, **cells})


def column_in(content: dict[str, Any]) -> Column:
    """A column as its JSON has it."""
    return Column(content["made"], {moment: Cell(**c) for moment, c in content["cells"].items()})


def recorded() -> dict[str, Column]:
    """The columns of the page, by the signal's name."""
    return {name: column_in(c) for name, c in json.loads(RECORD.read_text()).items()}


def store(record: Path, found: Mapping[str, Any], signals: Sequence[str]) -> dict[str, Any]:
    """Write columns, dataclasses by the signal's name, in the order of `signals`, in which they are returned."""
    kept = {n: found[n] for n in signals if n in found}
    record.write_text(json.dumps({n: asdict(c) for n, c in kept.items()}, indent=1) + "\n")
    return kept


def shown(found: Mapping[str, Any], part: str, *, write: bool) -> int:
    """Print the table of columns, or write it into the page; the exit code: 1 with a fault in a cell."""
    print_or_write(["--write"] if write else [], PAGE, part)
    return 1 if any(cell.is_fault() for c in found.values() for cell in c.cells.values()) else 0


def table(columns: dict[str, Column]) -> str:
    """Markdown: a row for each moment, a column for each signal; below, how each column was made."""
    heads = [n if n == "TWICE" else f"SIG{n}" for n in columns]
    rows = [f"| moment | {' | '.join(heads)} |", "|---" * (len(columns) + 1) + "|"]
    longest = max(columns.values(), key=lambda c: len(c.cells))
    for moment in longest.cells:
        rows.append(f"| {moment} | {' | '.join(str(c.cells.get(moment, '-')) for c in columns.values())} |")
    notes = [f"- {head}: {c.made}" for head, c in zip(heads, columns.values(), strict=True)]
    return "\n".join([BEGIN, *rows, "", *notes, END])


def main(arguments: Sequence[str]) -> int:
    """Exit code 1 if any cell is a fault."""
    p = argparse.ArgumentParser()
    p.add_argument("folder", type=Path)
    p.add_argument("--signals", nargs="*", choices=SIGNALS, default=list(SIGNALS))
    p.add_argument("--stages", nargs="*", choices=[s.name for s in REGISTRY], default=[])
    p.add_argument("--write", action="store_true")
    given = p.parse_args(arguments)
    folder = given.folder.absolute()
    not_ignored()
    write_demo_capture(folder / "capture", views=VIEWS, size=SIZE)
    if given.signals:
        whole = run_through(folder, folder / "whole")
        for name in given.signals:
            column(folder, name, whole, given.stages)
    files = {n: folder / f"{n}.json" for n in SIGNALS}
    found = {n: column_in(json.loads(f.read_text())) for n, f in files.items() if f.is_file()}
    if given.stages:
        found = {n: added(recorded()[n], found[n], given.stages) for n in given.signals}
    if given.write:
        found = store(RECORD, {**recorded(), **found}, SIGNALS)
    return shown(found, table(found), write=given.write)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
