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
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from workflows import machine
from workflows.bench_rows import budget_of, kept, rows_with, shared_options
from workflows.console import Console
from workflows.tradeoff_plot import plot

ALBEDO_VIEWS = 3


@dataclass(frozen=True, slots=True)
class Knob:
    """A point: its name and the settings of inverse_rendering that differ from the middle."""

    name: str
    settings: dict[str, Any] = field(default_factory=dict)


MIDDLE = Knob("middle")
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
    Knob("Laplace density", {"density": "laplace"}),
    Knob("every sample shaded", {"volumetric": True}),
    Knob("bfloat16", {"precision": "bfloat16"}),
    Knob("no shadows", {"shadows": False}),
    Knob("decided by evidence", {"rank": "auto", "light_order": "auto", "specular": "auto", "calibration": "auto"}),
    Knob("another seed", {"seed": 1}),
)
SCALED = ("steps", "batch")


@dataclass(frozen=True, slots=True)
class Measured:
    """Seconds of the fit's stage, peak memory (MB); dB, -, - over held-out views; mm and dB against the truth if it is
    there (else NaN)."""

    seconds: float
    memory_mb: float
    psnr: float
    ssim: float
    flip: float
    chamfer: float
    albedo: float


def options(sub: argparse.ArgumentParser) -> None:
    """The command line's options."""
    sub.add_argument("capture", metavar="CAPTURE", help="a capture; truth/ in it gives chamfer and albedo errors")
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for tradeoff.json, .md and .svg")
    shared_options(sub, 300, "the middle point")
    sub.add_argument("--cells", type=int, default=192, help="its grid cells (%(default)s)")
    sub.add_argument("--points", default="", metavar="TEXT", help="only points with this text in their name")
    sub.add_argument("--stop-after", type=float, metavar="S", help="begin no further point after S seconds")


def run(given: argparse.Namespace, console: Console) -> int:
    """neuface bench tradeoff"""
    chosen = rows_with(given.points, KNOBS, "--points", "point")
    out = Path(given.out)
    out.mkdir(parents=True, exist_ok=True)
    path, begun = out / "tradeoff.json", time.monotonic()
    budget = budget_of(given, ("steps", "side", "batch", "cells", "holdout"))
    found, earlier = kept(path, budget, "points", Measured)
    about = earlier.get("machine") or machine.machine()
    for number, knob in enumerate(chosen, 1):
        late = given.stop_after is not None and time.monotonic() - begun > given.stop_after
        if knob.name in found or late:
            continue
        console.note(f"point {number} of {len(chosen)}: {knob.name}")
        found[knob.name] = machine.apart(measure, knob, given)
        found = {k.name: found[k.name] for k in KNOBS if k.name in found}
        points = {k: asdict(v) for k, v in found.items()}
        path.write_text(json.dumps({"machine": about, "budget": budget, "points": points}, indent=1) + "\n")
    text = "\n".join(report(about, budget, found))
    (out / "tradeoff.md").write_text(text + "\n")
    if found:
        (out / "tradeoff.svg").write_text(plot({k: (m.seconds, m.psnr) for k, m in found.items()}, front(found)))
    console.close()
    print(text)
    return 0


def settings_of(knob: Knob, given: argparse.Namespace) -> tuple[str, ...]:
    """What `--set` would say: the budget, the whole model, and the knob."""
    values: dict[str, Any] = {
        "steps": given.steps,
        "image_side": given.side,
        "batch": given.batch,
        "grid_cells": given.cells,
        "rank": 3,
        "light_order": 10,
        "specular": "on",
        "relief": "on",
        "resolution": "given",
        "calibration": "off",
    }
    for k, v in knob.settings.items():
        values[k] = round(v * values[k]) if k in SCALED else v
    return (*(f"inverse_rendering.{k}={v}" for k, v in values.items()), "surface.resolution=160")


def measure(knob: Knob, given: argparse.Namespace) -> Measured:
    """Run a point up to the surface, or take it from the store, and score it."""
    import pipeline.threads  # noqa: F401  (before torch, as in the command line)
    from workflows.bench_ablations import chamfer, scores_of
    from workflows.plan import RunRequest, make_plan
    from workflows.runner import run_here, run_plan

    plan = make_plan(
        RunRequest(
            capture=given.capture,
            out=given.out,
            store=given.store,
            holdout=given.holdout,
            device=given.device,
            until="surface",
            sets=settings_of(knob, given),
        )
    )
    done = {d.stage: d for d in run_plan(plan, run_here(plan))}
    found: dict[str, Any] = {name: d.located for name, d in done.items()}
    fit = done["inverse_rendering"].run
    views = [scores_of(v, found) for v in found["capture"].artifact.views if v.holdout]
    mean = np.nanmean(np.array(views, np.float64), axis=0) if views else np.full(4, np.nan)
    folder = Path(given.capture)
    return Measured(
        float(fit["seconds"]),
        float(fit["peak_memory_mb"]),
        float(mean[0]),
        float(mean[2]),
        float(mean[3]),
        chamfer(found, folder),
        albedo_error(found, folder),
    )


def albedo_error(found: dict[str, Any], folder: Path) -> float:
    """PSNR (dB, sRGB) of the fitted albedo against truth/albedo in some held-out views, after one gain for all
    channels, over pixels where both are; NaN without a truth."""
    import torch

    from pipeline.colour import srgb_from_linear
    from pipeline.fields.face import load_model
    from pipeline.images import read_exr
    from stages.inverse_rendering.gather import camera_only
    from stages.inverse_rendering.sightings import surface_points
    from stages.inverse_rendering.views import Rays, image_rays

    fitted = found["inverse_rendering"]
    model = load_model(fitted.path(fitted.artifact.field))
    cameras = {c.index: c for c in found["poses"].artifact.cameras}
    mine, true = [], []
    for held in fitted.artifact.held_out[:: max(len(fitted.artifact.held_out) // ALBEDO_VIEWS, 1)]:
        path = folder / "truth" / "albedo" / f"{held.index}.exr"
        if not path.is_file():
            continue
        picture = read_exr(path)[0][..., :3]
        camera = cameras[held.index]
        rays = image_rays(camera_only(camera), camera.width // picture.shape[1], "cpu")
        flat = torch.from_numpy(np.ascontiguousarray(picture.reshape(-1, 3)))
        for i in torch.nonzero(flat.sum(1) > 0.02).squeeze(-1).split(65_536):
            x, hit = _met(model, Rays(rays.o[i], rays.d[i]), surface_points)
            with torch.no_grad():
                mine.append(model.spatial(x)[0])
            true.append(flat[i][hit])
    if not mine:
        return float("nan")
    a, b = torch.cat(mine), torch.cat(true)
    a = a * ((a * b).sum() / (a * a).sum())
    error = float(((srgb_from_linear(a.clamp(0, 1)) - srgb_from_linear(b.clamp(0, 1))) ** 2).mean())
    return -10 * math.log10(max(error, 1e-10))


def _met(model: Any, rays: Any, points: Any) -> tuple[Any, Any]:
    """Where rays meet the surface, and which of them do."""
    from pipeline.maths.tracing import box_interval

    near, far = box_interval(rays.o, rays.d, *model.geometry.box())
    _, hit, _ = model.geometry.trace(rays.o, rays.d, near, far)
    return points(model.geometry, rays)[0], hit & (far > near)


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
    lines = [
        f"`neuface bench tradeoff`, capture {budget['capture']}, held out {budget['holdout']}. Middle: "
        f"{budget['steps']} steps of {budget['batch']} rays, photos of {budget['side']} px, {budget['cells']} cells, "
        "the whole model.",
        f"Machine: {machine.told(about)}.",
        "",
        "| point | s | MB | PSNR (dB) | SSIM | FLIP | chamfer (mm) | albedo (dB) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    ahead = front(found)
    for name, m in found.items():
        row = [f"{m.seconds:.1f}", f"{m.memory_mb:.0f}", f"{m.psnr:.2f}", f"{m.ssim:.4f}", f"{m.flip:.4f}"]
        shown = f"**{name}**" if name in ahead else name
        lines.append(f"| {shown} | " + " | ".join([*row, f"{m.chamfer:.3f}", f"{m.albedo:.1f}"]) + " |")
    lines += ["", "Bold: on the Pareto front of seconds against PSNR."]
    pair = [found[k].psnr for k in (MIDDLE.name, "another seed") if k in found]
    if len(pair) == 2:
        lines.append(f"Two seeds differ by {abs(pair[0] - pair[1]):.2f} dB: differences of that size say nothing.")
    return lines
