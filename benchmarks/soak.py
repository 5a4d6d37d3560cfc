"""A batch on a pool that is disturbed all the time, for docs/benchmarks/soak.md.

    python -m benchmarks.soak FOLDER [--seed 7] [--captures 40] [--kills 12] [--write]

Two workers, and in an order that the seed decides: processes of the workers, of runs and of the batch get SIGKILL,
SIGTERM or SIGHUP; the disk with the results runs full once (a small tmpfs; needs the right to mount); the server is
killed and started again; the wall clock of all processes but the database jumps back an hour and returns (needs a C
compiler). What can't be done here is said on the page. The batch is started again, by the same command, as
docs/operations.md tells its users to.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from benchmarks.kill_batch import GONE
from benchmarks.kill_matrix import MARK, not_ignored, survivors
from benchmarks.kill_pool import stop
from benchmarks.pool import Pool, running, wait_until
from benchmarks.soak_record import PAGE, RECORD, Found, faults_in, page, processor_time, temporary_faults
from tests.support.clock import compiler, jumping_clock
from tests.support.facescape_tree import write_tree
from tests.support.servers import Process, descendants, wait_healthy
from workflows.bench.captures import commit
from workflows.run import host_info

ROOT = Path(__file__).resolve().parents[1]
TOY = ROOT / "tests/support/toy_batch.py"
DISK = 96 << 20  # bytes of the small disk
SPARE = 40_000  # bytes that are free on a full one
SETTINGS = ("--set", "work.steps=6", "--set", "work.pause=0.5")
WORKERS = ("one", "two")
TARGETS, SIGNALS = ("a worker", "a run", "the batch"), ("KILL", "TERM", "HUP")
SPECIALS = ("the disk runs full", "the server is killed", "the clock jumps")
LATEST = 6.0  # seconds after a capture's end at which something happens
BACK, WRONG = 3600, 20.0  # seconds by which the clock is behind, and for which
AGAIN = 3
AWAY = 5.0  # seconds without a server
PATIENCE = 2400.0  # seconds until a soak counts as hanging


@dataclass(frozen=True)
class Event:
    """Something that happens once `at` captures are finished, `delay` seconds later. signal: of a kill."""

    at: int
    delay: float
    what: str
    signal: str = ""


@dataclass
class Soak:
    """A soak under way. again: how often a batch that gave up may still be started again."""

    pool: Pool
    names: list[str]
    draw: random.Random
    workers: list[Process]
    batch: Process
    place: Path
    sign: Path
    can_jump: bool
    again: int = AGAIN
    events: list[tuple[int, str]] = field(default_factory=list)

    @property
    def out(self) -> Path:
        """Results of the batch, on the small disk."""
        return self.place / "out"

    def finished(self) -> int:
        """Captures with a result."""
        return sum((self.out / name / "run.json").is_file() for name in self.names)


def events(seed: int, captures: int, kills: int) -> list[Event]:
    """What happens, in order. Each special event once, between the kills."""
    draw = random.Random(seed)
    whats = [(draw.choice(TARGETS), draw.choice(SIGNALS)) for _ in range(kills)] + [(s, "") for s in SPECIALS]
    last = max(2, captures - 4)  # something must be under way
    found = [Event(draw.randint(1, last), round(draw.uniform(0, LATEST), 1), *what) for what in whats]
    return sorted(found, key=lambda e: (e.at, e.delay))


# ------------------------------------------------------------------ what happens
def happen(soak: Soak, event: Event) -> str:
    """Do it. Returns what was done."""
    if event.what == SPECIALS[0]:
        return fill_disk(soak)
    if event.what == SPECIALS[1]:
        return restart_server(soak)
    if event.what == SPECIALS[2]:
        return jump(soak)
    if event.what == "a run":
        return strike_run(soak, event)
    process = soak.batch if event.what == "the batch" else soak.draw.choice(soak.workers)
    name = "the batch" if process is soak.batch else f"worker {WORKERS[soak.workers.index(process)]}"
    return f"{name}: {strike(process, event.signal)}, started again"


def strike(process: Process, name: str) -> str:
    """Send it the signal, wait for its end, and start it again."""
    child = process.child
    if child is None or child.poll() is not None:
        process.start()
        return f"SIG{name} (it had ended)"
    child.send_signal(signal.Signals[f"SIG{name}"])
    code = child.wait(PATIENCE)
    process.start()
    return f"SIG{name}, exit code {code if code >= 0 else 128 - code}"


def strike_run(soak: Soak, event: Event) -> str:
    """The signal to the process of a run that a worker has at work."""
    found: list[int] = []
    for worker in soak.workers:
        if worker.child is not None:
            found += [p for p in descendants(worker.child.pid) if "prefect" in command_of(p)]
    if not found:
        return f"a run: SIG{event.signal}, but none was under way"
    pid = soak.draw.choice(sorted(found))
    with suppress(ProcessLookupError):
        os.kill(pid, signal.Signals[f"SIG{event.signal}"])
    return f"the process of a run: SIG{event.signal}"


def command_of(pid: int) -> str:
    """Command line of a process; empty if it is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def fill_disk(soak: Soak) -> str:
    """No room until the batch has stopped; then there is room again, and the batch is started again."""
    if not soak.place.is_mount():
        return "not done: the disk is not full, this user may not mount one"
    filler = soak.place / "filler"
    filler.write_bytes(bytes(max(0, shutil.disk_usage(soak.place).free - SPARE)))
    assert soak.batch.child is not None
    code = soak.batch.child.wait(PATIENCE)
    said = "space is left on the disk" in soak.batch.log.read_text(errors="replace")
    filler.unlink()
    soak.batch.start()
    named = "it names the disk" if said else "IT DOES NOT NAME THE DISK"
    return f"the disk is full until the batch has stopped (exit code {code}, {named}), then free; batch started again"


def restart_server(soak: Soak) -> str:
    """SIGKILL to the server, and some seconds without it."""
    soak.pool.server.kill()
    time.sleep(AWAY)
    soak.pool.server.start()
    begun = time.monotonic()
    wait_healthy(soak.pool.url, PATIENCE)
    took = time.monotonic() - begun
    return f"the server: SIGKILL, {AWAY:.0f} s later started again; it answers after {took:.0f} s more"


def jump(soak: Soak) -> str:
    """The wall clock is an hour behind for a while."""
    if not soak.can_jump:
        return "not done: the clock does not jump, no C compiler"
    soak.sign.write_text("")
    time.sleep(WRONG)
    soak.sign.unlink()
    return f"the wall clock jumps back by {BACK / 3600:.0f} h, and {WRONG:.0f} s later forward again"


# ------------------------------------------------------------------ the soak
@contextmanager
def small_disk(place: Path) -> Iterator[None]:
    """A tmpfs, where this user may mount one."""
    place.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(place)]
    mounted = subprocess.run(words, capture_output=True).returncode == 0
    try:
        yield
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(place)], check=True)


def undisturbed(folder: Path, names: Sequence[str], environment: dict[str, str]) -> dict[str, str]:
    """Hash of each capture's asset in a batch of this machine that nothing disturbs."""
    command = [sys.executable, str(TOY), "batch", str(folder / "tree"), "--out", str(folder / "alone"), *SETTINGS]
    kept = {k: v for k, v in environment.items() if not k.startswith("PREFECT_API")}
    subprocess.run(command, env=kept, check=True, capture_output=True)
    return {n: json.loads((folder / "alone" / n / "run.json").read_text())["asset_hash"] for n in names}


def disturb(soak: Soak, planned: Sequence[Event]) -> int:
    """Let everything happen. Returns the exit code of the batch at its end."""
    for event in planned:
        if not wait_until(lambda at=event.at: kept(soak).finished() >= at, PATIENCE):  # type: ignore[misc]
            break
        time.sleep(event.delay)
        note(soak, happen(soak, event))
    wait_until(lambda: kept(soak).finished() == len(soak.names) and ended(soak.batch), PATIENCE)
    return -1 if soak.batch.child is None or soak.batch.child.poll() is None else soak.batch.child.returncode


def kept(soak: Soak) -> Soak:
    """Start again what ended by itself: workers, as systemd does, and a batch that gave up, as its user does."""
    for name, worker in zip(WORKERS, soak.workers, strict=True):
        if ended(worker):
            worker.start()
            note(soak, f"worker {name} had ended by itself: started again")
    if ended(soak.batch) and soak.batch.child is not None and soak.batch.child.returncode != 0 and soak.again:
        soak.again -= 1
        note(soak, f"the batch had ended with exit code {soak.batch.child.returncode}: started again")
        soak.batch.start()
    return soak


def note(soak: Soak, said: str) -> None:
    """Write down what happened, with the captures finished by now."""
    soak.events.append((soak.finished(), said))
    print(f"{soak.finished():3} {said}", flush=True)


def ended(process: Process) -> bool:
    """Whether it is not running."""
    return process.child is None or process.child.poll() is not None


def soaked(folder: Path, seed: int, captures: int, kills: int) -> Found:
    """The whole."""
    begun, mark = time.monotonic(), uuid.uuid4().hex
    names = [f"{n}/1_neutral" for n in range(1, captures + 1)]
    write_tree(folder / "tree", dict.fromkeys(names, True))
    (temporary := folder / "tmp").mkdir()
    place, sign, stored = folder / "disk", folder / "jump", folder / "stored"
    more = {"NEUFACE_STORED": str(stored), "TMPDIR": str(temporary)}
    clock = jumping_clock(folder, sign, BACK) if compiler() else {}
    with processor_time(mark) as used, small_disk(place):
        with running(folder, mark, **clock) as pool:
            batch = Process({**pool.environment, **more}, folder / "batch.log", folder, sys.executable, TOY, "batch",
                            folder / "tree", "--out", place / "out", "--server", "--lost-after", "30s",
                            "--attempts", "9", *SETTINGS)  # fmt: skip
            workers = [pool.worker(name, **more) for name in WORKERS]
            soak = Soak(pool, names, random.Random(seed + 1), workers, batch, place, sign, bool(clock))
            with workers[0], workers[1], batch:
                code = disturb(soak, events(seed, captures, kills))
                runs = [(run["name"].partition(" #")[0], run["state_type"]) for run in pool.runs()]
                for worker in workers:
                    stop(worker)
        seconds = time.monotonic() - begun
        wanted = undisturbed(folder, names, {**pool.environment, **more, "NEUFACE_STORED": "", MARK: "other"})
        lines = stored.read_text().splitlines()
        faults = [f"the batch ended with exit code {code}"] if code else []
        faults += faults_in(soak.out, names, lines, runs, wanted)
        state = json.loads((soak.out / "batch/summary.json").read_text())["captures"]
    wait_until(lambda: not survivors(mark), GONE)
    faults += [f"process {p} lives on: {command_of(p)}" for p in survivors(mark)] + [*temporary_faults(temporary)]
    machine = host_info.describe(host_info.machine())
    return Found(f"{machine}; commit {commit()}; {pool.database}", seed, captures, soak.events,
                 dict(Counter(kind for _, kind in runs)), dict(Counter(str(c["attempts"]) for c in state)), len(lines),
                 round(seconds, 1), round(sum(used.values()) / 60, 1), faults)  # fmt: skip


def main(arguments: Sequence[str]) -> int:
    """Exit code 1 if something is lost, twice, damaged or left."""
    p = argparse.ArgumentParser()
    p.add_argument("folder", type=Path, help="a new folder")
    p.add_argument("--seed", type=int, default=7)
    p.add_argument("--captures", type=int, default=40)
    p.add_argument("--kills", type=int, default=12)
    p.add_argument("--write", action="store_true")
    given = p.parse_args(arguments)
    not_ignored()
    given.folder.mkdir(parents=True)
    found = soaked(given.folder.absolute(), given.seed, given.captures, given.kills)
    if given.write:
        RECORD.write_text(json.dumps(asdict(found), indent=1) + "\n")
        PAGE.write_text(page(found))
    print(page(found))
    return 1 if found.faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
