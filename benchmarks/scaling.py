"""Processor time and peak memory of the stages against one thing that grows by a factor of eight.

    python -m benchmarks.scaling FOLDER --capture ../shared/captures/head_a --run runs/a [--only photos] [--most 1]

    photos   capture, poses, masks    of made-up captures (benchmarks/many_photos.py) of small photos
    pixels   capture, poses, masks    the same, of few photos
    texels   bake                     of the run's fit, on its mesh, without the fit of a standard material
    faces    surface, uv              of the run's fit, at other lattices; charts of the scan's own mesh

Each point is a process of its own, so that its peak memory is its own. y = a x^b is fitted to each stage's seconds of
processor time, and to the process's peak at the stage's end: memory of the stages before it in the row is in it. Prints
tables, and writes FOLDER/scaling.json after every point; a point that is in it is not measured again.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.many_photos import enlarge
from pipeline.contract import peak_memory_mb
from workflows.run import host_info

FEW, SMALL = 8, 512  # photos where their pixels grow; pixels along a side where their number grows
AXES: dict[str, tuple[tuple[int, ...], tuple[str, ...]]] = {
    "photos": ((4, 8, 16, 32), ("capture", "poses", "masks")),
    "pixels": ((724, 1024, 1448, 2048), ("capture", "poses", "masks")),  # a side: their squares grow by 8
    "texels": ((362, 512, 724, 1024), ("bake",)),  # a side
    "faces": ((91, 128, 181, 256), ("surface", "uv")),  # cells along the lattice: faces are their squares
}
SETTING = {"bake": "size", "surface": "resolution"}
CHANGED: dict[str, dict[str, Any]] = {  # charts of the scan; maps and detail without the fit of a standard material
    "surface": {},
    "uv": {"mesh": "scan"},
    "bake": {"fit_standard": False},
}


@dataclass(frozen=True)
class Point:
    """One measurement. x: photos, pixels of one, texels, or faces. cpu: seconds of processor time of each stage; peak:
    MB of the process at its end; start: MB before the first stage."""

    axis: str
    value: int
    x: float
    cpu: dict[str, float]
    peak: dict[str, float]
    start: float


# ------------------------------------------------------------------ one point, in a process of its own
def measure(axis: str, value: int, folder: Path, capture: Path, finished: Path) -> Point:
    """Make what the point needs, and run its stages."""
    if axis in ("photos", "pixels"):
        return _of_photos(axis, value, folder, capture)
    return _of_fit(axis, value, folder, finished)


def _of_photos(axis: str, value: int, folder: Path, capture: Path) -> Point:
    photos, side = (value, SMALL) if axis == "photos" else (FEW, value)
    made = folder / f"{axis}_{value}"
    if not made.exists():
        enlarge(capture, made, photos, side, side)
    used, start, _ = run({"capture": str(made), "out": str(folder / "out"), "store": str(folder / "store"),
                          "until": AXES[axis][1][-1], "force": True})  # fmt: skip
    shutil.rmtree(made)
    return Point(axis, value, float(photos if axis == "photos" else side * side), used.cpu, used.peak, start)


def _of_fit(axis: str, value: int, folder: Path, finished: Path) -> Point:
    """The stages on what the run's store has, with the settings of that run but one."""
    import pipeline.threads  # noqa: F401
    from pipeline.contract import inputs_from
    from pipeline.store import Store
    from stages.__main__ import before
    from stages.registry import REGISTRY

    record, made = json.loads((finished / "run.json").read_text()), Store(folder / "store")
    store, known = Store(Path(record["store"])), {s.name: s for s in REGISTRY}
    keys = {name: s["key"] for name, s in record["stages"].items()}
    finished_parts = {s.name: store.load(s.name, keys[s.name], s.output) for s in before("bake")}
    assert all(finished_parts.values()), "the run's store is not complete"
    stages, used = AXES[axis][1], Used()
    start, x = peak_memory_mb(), float(value * value)
    for name in stages:
        settings = store.load_run(name, keys[name]).get("config", {})
        assert isinstance(settings, dict)
        config = known[name].config(**settings | CHANGED[name] | ({} if name == "uv" else {SETTING[name]: value}))
        done = used.execute(known[name], inputs_from(known[name], finished_parts), config, made)
        finished_parts[name] = done.located
        x = float(done.located.artifact.faces) if name == "surface" else x
    return Point(axis, value, x, used.cpu, used.peak, start)


class Used:
    """What stages took. cpu: processor seconds of each; peak: MB of the process at its end."""

    def __init__(self) -> None:
        self.cpu: dict[str, float] = {}
        self.peak: dict[str, float] = {}

    def execute(self, stage: Any, *given: Any, **more: Any) -> Any:
        """As pipeline.contract.execute."""
        from pipeline.contract import execute

        before = processor_seconds()
        done = execute(stage, *given, **more)
        assert not done.reused, stage.name
        self.cpu[stage.name] = round(processor_seconds() - before, 2)
        self.peak[stage.name] = peak_memory_mb()
        return done


def run(request: dict[str, Any]) -> tuple[Used, float, dict[str, Any]]:
    """What the stages of a run took, the MB before, and what was done."""
    import pipeline.threads  # noqa: F401
    from workflows.run.plan import make_plan
    from workflows.run.request import RunRequest
    from workflows.run.runner import run_stages

    plan, used = make_plan(RunRequest(**request)), Used()
    start = peak_memory_mb()
    return used, start, {d.stage: d for d in run_stages(plan, execute_stage=used.execute)}


def processor_seconds() -> float:
    """Of this process and its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


# ------------------------------------------------------------------ laws
def laws(points: Sequence[Point]) -> list[list[str]]:
    """Rows: axis, stage, from .. to, seconds there, b of the seconds, MB there, b of the memory."""
    rows = []
    for axis, (_, stages) in AXES.items():
        line = sorted((p for p in points if p.axis == axis), key=lambda p: p.x)
        for stage in stages if len(line) > 1 else ():
            x, cpu = [p.x for p in line], [p.cpu[stage] for p in line]
            memory = [p.peak[stage] for p in line]
            rows.append([axis, stage, f"{short(x[0])} to {short(x[-1])}", f"{cpu[0]:.1f} to {cpu[-1]:.1f}", law(x, cpu),
                         f"{memory[0]:.0f} to {memory[-1]:.0f}", law(x, memory)])  # fmt: skip
    return rows


def law(x: list[float], y: list[float]) -> str:
    """The exponent with its standard error."""
    _, b, error = host_info.power_law(x, y)
    return f"{b:.2f} +- {error:.2f}"


def short(x: float) -> str:
    """A number of photos, pixels, texels or faces."""
    return f"{x / 1e6:.2g} million" if x >= 1e6 else f"{x:,.0f}"


HEAD = ["against", "stage", "from .. to", "processor s", "exponent", "peak MB", "exponent"]


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for what is made, and scaling.json")
    parser.add_argument("--capture", type=Path, required=True, help="a FaceScape folder with photos")
    parser.add_argument("--run", dest="finished", type=Path, required=True, help="a finished run, for texels and faces")
    parser.add_argument("--only", choices=list(AXES), help="one axis")
    parser.add_argument("--most", type=int, default=100, help="end after so many new points; the next call goes on")
    given = parser.parse_args(arguments)
    given.folder.mkdir(parents=True, exist_ok=True)
    path = given.folder / "scaling.json"
    points = [Point(**p) for p in json.loads(path.read_text())["points"]] if path.is_file() else []
    axes, known = [given.only] if given.only else list(AXES), {(p.axis, p.value) for p in points}
    for axis, value in [(a, v) for a in axes for v in AXES[a][0] if (a, v) not in known][: given.most]:
        work = given.folder / "work"
        shutil.rmtree(work, ignore_errors=True)
        points.append(host_info.apart(measure, axis, value, work, given.capture, given.finished))
        shutil.rmtree(work, ignore_errors=True)
        found = {"machine": host_info.apart(host_info.machine), "points": [asdict(p) for p in points]}
        path.write_text(json.dumps(found, indent=1) + "\n")
        print(points[-1], flush=True)
    for row in [HEAD, ["---"] * len(HEAD), *laws(points)]:
        print("| " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
