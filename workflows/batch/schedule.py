"""`neuface schedule`: hours, cost and disk of a batch on paper, from the stage times of runs that were measured.

A model of what a pool does, event by event: a worker takes a capture and keeps it to its end; it reads the photos and
writes the results over a link that all share; the fit waits for one of the GPUs. The order is first come, first
served. Times vary around the measured ones by `spread`. A capture whose worker is lost repeats the stage that
it was in. The stage times are measured ones of one kind of machine.
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
import random
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import StageError
from stages.registry import FIT
from workflows.cli.console import Console
from workflows.cli.numbers import number, whole, whole_list

HOUR = 3600.0


@dataclass(frozen=True, slots=True)
class Load:
    """One capture. before, fit, after: seconds. read, written: bytes over the shared link. kept: bytes on disk."""

    before: float
    fit: float
    after: float
    read: float = 0.0
    written: float = 0.0
    kept: float = 0.0


@dataclass(frozen=True, slots=True)
class Farm:
    """What works on it. link: bytes a second, shared by all. spread: standard deviation of log time. lost: share of
    stages in which a worker is lost, halfway on average."""

    gpus: int
    workers: int
    link: float = math.inf
    spread: float = 0.0
    lost: float = 0.0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Forecast:
    """hours: from the first start to the last end. busy: share of that time for which each resource was in use."""

    hours: float
    busy: dict[str, float]
    kept: float

    @property
    def bottleneck(self) -> str:
        """The resource that is in use most."""
        return max(self.busy, key=lambda n: self.busy[n])


@dataclass(slots=True)
class _Resource:
    """Places that are taken in the order of the requests. used: seconds times places."""

    places: int
    free: int = 0
    waiting: deque[_Capture] = field(default_factory=deque)
    used: float = 0.0


@dataclass(slots=True)
class _Capture:
    """The steps still to come: (resource, seconds)."""

    steps: Iterator[tuple[str, float]]
    at: tuple[str, float] | None = None


def simulate(load: Load, captures: int, farm: Farm) -> Forecast:
    """Run the farm in simulated time until every capture is done."""
    rng = random.Random(farm.seed)
    resources = {"GPU": _Resource(farm.gpus, farm.gpus), "link": _Resource(1, 1)}
    resources["worker's CPU"] = _Resource(farm.workers, farm.workers)  # never waited for: a worker has its own
    events: list[tuple[float, int, _Capture]] = []
    left, number, now = captures, 0, 0.0

    def begin(capture: _Capture, at: float) -> None:
        """Take up the capture's next step, or the next capture when it has none."""
        nonlocal left, number
        capture.at = next(capture.steps, None)
        while capture.at is None:
            if left == 0:
                return
            left -= 1
            capture.steps = _steps(load, farm, rng)
            capture.at = next(capture.steps, None)
        resource = resources[capture.at[0]]
        if resource.free == 0:
            resource.waiting.append(capture)
            return
        resource.free -= 1
        number += 1
        heapq.heappush(events, (at + capture.at[1], number, capture))

    for _ in range(min(farm.workers, captures)):
        begin(_Capture(iter(())), 0.0)
    while events:
        now, _, capture = heapq.heappop(events)
        assert capture.at is not None
        resource = resources[capture.at[0]]
        resource.used += capture.at[1]
        resource.free += 1
        if resource.waiting:
            waiter = resource.waiting.popleft()
            assert waiter.at is not None
            resource.free -= 1
            number += 1
            heapq.heappush(events, (now + waiter.at[1], number, waiter))
        begin(capture, now)
    busy = {n: r.used / (r.places * now) if now else 0.0 for n, r in resources.items()}
    return Forecast(now / HOUR, busy, captures * load.kept)


def _steps(load: Load, farm: Farm, rng: random.Random) -> Iterator[tuple[str, float]]:
    for resource, seconds in (
        ("link", load.read / farm.link),
        ("worker's CPU", load.before),
        ("GPU", load.fit),
        ("worker's CPU", load.after),
        ("link", load.written / farm.link),
    ):
        if seconds <= 0:
            continue
        while farm.lost and rng.random() < farm.lost:
            yield resource, seconds * rng.random()
        # a log-normal factor of mean 1
        yield resource, seconds * math.exp(rng.gauss(0, farm.spread) - farm.spread**2 / 2) if farm.spread else seconds


# ------------------------------------------------------------------ from measured runs
def load_of(records: Sequence[Path]) -> Load:
    """The mean over the run.json files of measured runs, and over what lies beside them.

    Raises:
        StageError: one of them is not the record of a whole run.
    """
    loads = [_load(p if p.is_file() else p / "run.json") for p in records]
    mean = {n: sum(getattr(x, n) for x in loads) / len(loads) for n in Load.__dataclass_fields__}
    return Load(**mean)


def _load(path: Path) -> Load:
    try:
        record: dict[str, Any] = json.loads(path.read_bytes())
        taken = {n: float(s["seconds"]) for n, s in record["stages"].items()}
        names = list(taken)
        fit = names.index(FIT)
        store = Path(record["store"])
        keys = {n: s["key"] for n, s in record["stages"].items()}
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise StageError(
            "this is not the record of a whole run",
            where=path,
            value=f"{type(e).__name__}: {e}",
            limit=f"a run.json with the seconds of every stage, {FIT} among them",
            remedy="name the --out of a run that was made without a stop",
        ) from e
    stored = sum(_bytes(store / n / k) for n, k in keys.items())
    published = sum(_bytes(path.parent / n) for n in ("asset", "report"))
    return Load(
        before=sum(taken[n] for n in names[:fit]),
        fit=taken[FIT],
        after=sum(taken[n] for n in names[fit + 1 :]),
        read=_bytes(store / "capture" / keys["capture"]),
        written=stored + published,
        kept=stored + published,
    )


def _bytes(folder: Path) -> float:
    return float(sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()))


# ------------------------------------------------------------------ the command
def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `neuface schedule`."""
    parser.add_argument("runs", nargs="+", metavar="RUN", help="--out of measured runs (their mean is taken)")
    parser.add_argument(
        "--captures", type=whole(1, 1_000_000), default=7180, help="359 people with 20 expressions (%(default)s)"
    )
    parser.add_argument("--gpus", type=whole_list(1, 10_000), default="1,8,64", help="farms to compare (%(default)s)")
    parser.add_argument(
        "--workers", type=whole(1, 1000), default=2, help="captures under way for each GPU (%(default)s)"
    )
    parser.add_argument("--fit-seconds", type=number(0), help="of the fit, instead of the measured time: what-if")
    parser.add_argument(
        "--link", type=number(0, above=True), default=1000.0, help="of the storage, MB a second (%(default)s)"
    )
    parser.add_argument("--gpu-hour", type=number(0), default=0.0, help="price of a GPU with its workers, for one hour")
    parser.add_argument("--spread", type=number(0, 3), default=0.2, help="of the times, as a share (%(default)s)")
    parser.add_argument(
        "--lost", type=number(0, 0.9), default=0.01, help="share of stages whose worker is lost (%(default)s)"
    )
    parser.set_defaults(run=schedule_command)


def schedule_command(options: argparse.Namespace, console: Console) -> int:
    """neuface schedule"""
    load = load_of([Path(r) for r in options.runs])
    if options.fit_seconds is not None:
        load = Load(load.before, options.fit_seconds, load.after, load.read, load.written, load.kept)
    print(
        f"one capture: {load.before:.0f} s before the fit, {load.fit:.0f} s fit, {load.after:.0f} s after it; "
        f"reads {load.read / 1e6:.0f} MB, keeps {load.kept / 1e6:.0f} MB"
    )
    for gpus in options.gpus:
        farm = Farm(gpus, gpus * options.workers, options.link * 1e6, options.spread, options.lost)
        f = simulate(load, options.captures, farm)
        use = ", ".join(f"{n} {100 * share:.0f} %" for n, share in f.busy.items())
        cost = f", cost {f.hours * gpus * options.gpu_hour:,.0f}" if options.gpu_hour else ""
        print(
            f"{gpus:4} GPUs, {farm.workers} workers: {f.hours:.1f} h, {f.kept / 1e12:.2f} TB{cost}; in use: {use}; "
            f"bottleneck: {f.bottleneck}"
        )
    return 0
