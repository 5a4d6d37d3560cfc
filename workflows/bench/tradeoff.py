"""`neuface bench tradeoff`: what each knob costs and what it buys, at one stated budget of steps a point.

A point is the middle set-up with one knob turned, run up to the surface in a process of its own, so that its peak
memory is its own. Points already in DIR/tradeoff.json are kept if the budget is the same: the bench may be run in
pieces (--stop-after). The Pareto front holds the points that no other beats in both seconds and PSNR.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from workflows.bench.captures import commit
from workflows.bench.rows import budget_of, kept, rows_with, shared_options
from workflows.bench.tradeoff_measure import Knob, Measured, measure
from workflows.bench.tradeoff_plot import plot
from workflows.cli.console import Console
from workflows.run import host_info
from workflows.run.output_dirs import make_folder

MIDDLE = Knob("middle")
SPLIT = {
    "f0": "F0: correlation",
    "f0_error": "median error",
    "roughness": "roughness: correlation",
    "roughness_error": "median error",
    "light": "light: correlation",
}
PRESETS = tuple(Knob(f"preset {name}", preset=name) for name in ("draft", "studio", "film"))
KNOBS = (
    MIDDLE,
    *(Knob(f"steps x {f:g}", {"steps": f}) for f in (0.5, 2.0, 4.0)),
    *(Knob(f"image {side} px", {"image_side": side}) for side in (128, 512)),
    *(Knob(f"grid {cells}", {"grid_cells": cells}) for cells in (96, 288)),
    *(Knob(f"batch x {f:g}", {"batch": f}) for f in (0.5, 2.0)),
    *(Knob(f"{n} samples a ray", {"samples": n}) for n in (6, 16)),
    *(Knob(f"SH order {n}", {"light_order": n}) for n in (2, 4, 6)),
    *(Knob(f"k = {k}", {"rank": k}) for k in (1, 2, 5)),
    Knob("no specular lobe", {"specular": "off"}),
    Knob("exact attenuation", {"attenuation": "exact"}),
    Knob("Laplace density", {"preset": "comparison", "density": "laplace"}),
    Knob("every sample shaded", {"preset": "comparison", "volumetric": True}),
    Knob("bfloat16", {"precision": "bfloat16"}),
    Knob("no shadows", {"shadows": False}),
    Knob("decided by evidence", {"rank": "auto", "light_order": "auto", "specular": "auto", "calibration": "auto"}),
    Knob("another seed", {"seed": 1}),
)


def options(sub: argparse.ArgumentParser) -> None:
    """The command line's options."""
    sub.add_argument("capture", metavar="CAPTURE", help="a capture; truth/ in it gives chamfer and albedo errors")
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for tradeoff.json, .md and .svg")
    shared_options(sub, 300, "the middle point")
    sub.add_argument("--cells", type=int, default=192, help="its grid cells (%(default)s)")
    sub.add_argument("--points", default="", metavar="TEXT", help="only points with this text in their name")
    sub.add_argument("--presets", default="", metavar="NAMES", help="also whole presets: draft,studio,film")
    sub.add_argument("--stop-after", type=float, metavar="S", help="begin no further point after S seconds")


def run(given: argparse.Namespace, console: Console) -> int:
    """neuface bench tradeoff"""
    chosen = rows_with(given.points, KNOBS, "--points", "point") + presets_named(given.presets)
    out = Path(given.out)
    make_folder(out)
    path, begun = out / "tradeoff.json", time.monotonic()
    budget = budget_of(given, ("steps", "side", "batch", "cells", "holdout"))
    found, earlier = kept(path, budget, "points", Measured)
    about, made_of = earlier.get("machine") or host_info.machine(), earlier.get("commit") or commit()
    for number, knob in enumerate(chosen, 1):
        late = given.stop_after is not None and time.monotonic() - begun > given.stop_after
        if knob.name in found or late:
            continue
        console.note(f"point {number} of {len(chosen)}: {knob.name}")
        found[knob.name] = host_info.apart(measure, knob, given)
        found = {k.name: found[k.name] for k in (*KNOBS, *PRESETS) if k.name in found}
        points = {k: asdict(v) for k, v in found.items()}
        path.write_text(
            json.dumps({"machine": about, "commit": made_of, "budget": budget, "points": points}, indent=1) + "\n"
        )
    text = "\n".join(report(about, budget, found))
    (out / "tradeoff.md").write_text(text + "\n")
    if found:
        (out / "tradeoff.svg").write_text(plot({k: (m.seconds, m.psnr) for k, m in found.items()}, front(found)))
    console.close()
    print(text)
    return 0


def presets_named(text: str) -> list[Knob]:
    """Points of the presets in a list with commas. Raises UsageError at a name that is none."""
    return [rows_with(f"preset {name.strip()}", PRESETS, "--presets", "preset")[0] for name in text.split(",") if text]


def front(found: dict[str, Measured]) -> list[str]:
    """Names on the Pareto front of seconds against PSNR, the quickest first."""
    ordered = sorted(found, key=lambda k: (found[k].seconds, -found[k].psnr))
    best, out = -math.inf, []
    for name in ordered:
        if found[name].psnr > best:
            best = found[name].psnr
            out.append(name)
    return out


# ------------------------------------------------------------------ what people read
def report(about: dict[str, Any], budget: dict[str, Any], found: dict[str, Measured]) -> list[str]:
    """Markdown: a row a point, the front marked."""
    split = [f for f in SPLIT if any(getattr(m, f) is not None for m in found.values())]
    lines = [
        f"`neuface bench tradeoff`, capture {budget['capture']}, held out {budget['holdout']}. Middle: "
        f"{budget['steps']} steps of {budget['batch']} rays, photos of {budget['side']} px, {budget['cells']} cells, "
        f"the whole model; presets as they are. All points are scored at {budget['side']} px.",
        f"Machine: {host_info.describe(about)}.",
        "",
        "| point | s | MB | PSNR (dB) | SSIM | FLIP | chamfer (mm) | albedo (dB) |"
        + "".join(f" {SPLIT[f]} |" for f in split),
        "|---|---|---|---|---|---|---|---|" + "---|" * len(split),
    ]
    ahead = front(found)
    for name, m in found.items():
        row = [f"{m.seconds:.1f}", f"{m.memory_mb:.0f}", f"{m.psnr:.2f}", f"{m.ssim:.4f}", f"{m.flip:.4f}"]
        shown = f"**{name}**" if name in ahead else name
        row += [f"{m.chamfer:.3f}", f"{m.albedo:.1f}"]
        row += ["-" if (value := getattr(m, f)) is None else f"{value:.3f}" for f in split]
        lines.append(f"| {shown} | " + " | ".join(row) + " |")
    lines += ["", "Bold: on the Pareto front of seconds against PSNR."]
    pair = [found[k].psnr for k in (MIDDLE.name, "another seed") if k in found]
    if len(pair) == 2:
        lines.append(
            f"Two seeds differ by {abs(pair[0] - pair[1]):.2f} dB: differences of that size are not significant."
        )
    return lines
