"""`neuface bench machine`: what this machine can do, and how far each stage of a run is from the least time that it
could take there."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline.errors import UsageError, stage_error_from_os_error
from pipeline.store import read_object
from workflows.bench.captures import commit
from workflows.bench.floor_counts import counts_of
from workflows.bench.floors import STAGES, Work
from workflows.bench.machine_rates import Rates, measured
from workflows.cli.console import Console
from workflows.run import host_info
from workflows.run.output_dirs import make_folder

FILE = "machine.json"
SHOWN: dict[str, tuple[str, float, str]] = {  # what a rate is, its unit, the unit's name
    "matrix": ("matrix products, float32", 1e9, "GFLOP/s"),
    "scalar": ("arithmetic of a compiled loop of bilinear samples", 1e9, "GFLOP/s"),
    "vector": ("arithmetic of a compiled loop that vectorises", 1e9, "GFLOP/s"),
    "memory": ("memory, copy", 1e9, "GB/s"),
    "read": ("disk, read", 1e6, "MB/s"),
    "write": ("disk, write", 1e6, "MB/s"),
    "hashed": ("SHA-256", 1e6, "MB/s"),
    "jpeg": ("JPEG decoded", 1e6, "MP/s"),
    "png": ("PNG decoded", 1e6, "MP/s"),
    "exr": ("EXR of 16-bit floats decoded", 1e6, "MP/s"),
    "png_written": ("PNG written", 1e6, "MP/s"),
    "exr_written": ("EXR of 16-bit floats written", 1e6, "MP/s"),
    "rays": ("Embree, 80,000 triangles", 1e6, "million rays/s"),
}
WHY: dict[str, str] = {  # by profiles in docs/benchmarks.md and by the code
    "capture": "one photo after the other on one core: some twenty passes of numpy and two networks over each",
    "poses": "photos are decoded again, features and matches go photo after photo; solved cameras wait for the mapper",
    "masks": "photos are decoded twice; components and matting by passes at full size; of people, GrabCut",
    "inverse_rendering": "hundreds of small torch operations a step; smoothing and stereo pass over memory beside the "
    "steps. Depth maps alone are near their floor",
    "surface": "marching cubes block after block; components, handles and normals by numpy on one core",
    "template": "rounds of nearest places, solver and repairs of folds, with numpy on one core between them",
    "uv": "decimation, subdivision by sparse products, charts and packing on one core",
    "bake": "sparse systems are factorised on one core (SuperLU) for smoothing and for how gloss varies",
    "usd": "texture coordinates of the dense mesh, writers of USD, glTF and OBJ, and PNG, on one core",
    "report": "FLIP by passes of numpy over each view, and a page of some 18 MB, on one core",
}


def options(sub: argparse.ArgumentParser) -> None:
    """The command line's options."""
    sub.add_argument(
        "--run", dest="finished", metavar="DIR", help="a finished run: its stages against their least time"
    )
    sub.add_argument("--out", metavar="DIR", help=f"folder for {FILE} and machine.md; a {FILE} that is there is not "
                     "measured again (default: printed only)")  # fmt: skip


def run(given: argparse.Namespace, console: Console) -> int:
    """neuface bench machine"""
    out = Path(given.out) if given.out else None
    counts = counts_of(Path(given.finished)) if given.finished else None
    found = kept(out)
    if found is None:
        console.note("measuring the machine")
        if out is not None:
            make_folder(out)
        rates = measured(out or Path.cwd())
        found = {"machine": host_info.machine(), "commit": commit(), "rates": asdict(rates)}
    rates = Rates(**found["rates"])
    lines = report(found)
    if counts is not None:
        work = {name: STAGES[name](counts) for name in counts.seconds if name in STAGES}
        lines += ["", *table(work, counts.seconds, rates)]
    if out is not None:
        try:
            (out / FILE).write_text(json.dumps(found, indent=1) + "\n")
            (out / "machine.md").write_text("\n".join(lines) + "\n")
        except OSError as e:
            raise stage_error_from_os_error(e, out) or e from e
    console.close()
    print("\n".join(lines))
    return 0


def kept(out: Path | None) -> dict[str, Any] | None:
    """What an earlier measurement in this folder left, None without one.

    Raises:
        UsageError: the file is there and no measurement.
    """
    if out is None or not (out / FILE).exists():
        return None
    found = read_object(out / FILE)
    rates = found.get("rates")
    if isinstance(rates, dict) and isinstance(found.get("machine"), dict) and rates.keys() == SHOWN.keys():
        values = list(rates.values())
        if all(isinstance(v, int | float) and v > 0 for v in values):
            return found
    raise UsageError(
        "this file is no measurement of a machine",
        where=out / FILE,
        value="other or damaged content",
        limit=f"what neuface bench machine wrote, with {len(SHOWN)} rates above 0",
        remedy="delete the file, or name another folder",
    )


def report(found: dict[str, Any]) -> list[str]:
    """The machine, Markdown."""
    lines = [f"`neuface bench machine`. Machine: {host_info.describe(found['machine'])}.", ""]
    lines += ["| work, all cores | rate |", "|---|---|"]
    return lines + [
        f"| {what} | {speed(found['rates'][name] / unit)} {of} |" for name, (what, unit, of) in SHOWN.items()
    ]


def speed(value: float) -> str:
    """In three digits, without an exponent."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def table(work: Mapping[str, Work], seconds: Mapping[str, float], rates: Rates) -> list[str]:
    """Each stage's work, its floor, its time and why they differ, Markdown."""
    rows = [HEAD, *rows_of(work, seconds, rates)]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return [lines[0], "|" + "---|" * len(HEAD), *lines[1:]]


def rows_of(work: Mapping[str, Work], seconds: Mapping[str, float], rates: Rates) -> list[list[str]]:
    """The cells of the table, and of its last row for all stages together."""
    floors = {name: one.floor(rates) for name, one in work.items()}
    rows = [
        [name, *cells(one), amount(floors[name]), BOUND[one.bound(rates)], f"{seconds[name]:.1f}",
         ratio(seconds[name], floors[name]), WHY[name]]
        for name, one in work.items()
    ]  # fmt: skip
    taken, least = sum(seconds[name] for name in work), sum(floors.values())
    return [*rows, ["all", "", "", "", "", amount(least), "", f"{taken:.1f}", ratio(taken, least), ""]]


BOUND = {
    "scalar": "look-ups",
    "vector": "vectors",
    "matrix": "matrices",
    "moved": "memory",
    "read": "disk",
    "write": "disk",
    "hashed": "SHA-256",
    "jpeg": "JPEG",
    "png": "PNG",
    "exr": "EXR",
    "png_written": "PNG",
    "exr_written": "EXR",
    "rays": "rays",
}
HEAD = (
    "stage",
    "files read + written (MB)",
    "pixels decoded + written (MP)",
    "look-ups + vectors + matrices (10^9 operations)",
    "rays (10^6)",
    "floor (s)",
    "mostly",
    "now (s)",
    "ratio",
    "why",
)


def cells(one: Work) -> list[str]:
    """Amounts of a stage's work."""
    decoded, written = one.jpeg + one.png + one.exr, one.png_written + one.exr_written
    operations = (one.scalar, one.vector, one.matrix)
    return [
        f"{one.read / 1e6:.0f} + {one.write / 1e6:.0f}",
        f"{decoded / 1e6:.0f} + {written / 1e6:.0f}",
        " + ".join(amount(v / 1e9) for v in operations),
        amount(one.rays / 1e6),
    ]


def amount(value: float) -> str:
    """In two digits at most, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}" if value >= 0.01 else "0"


def ratio(now: float, least: float) -> str:
    """How many times longer: floors are no better known than in one or two digits."""
    return amount(now / least) if least > 0.001 else "-"
