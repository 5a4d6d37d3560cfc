"""`neuface bench speed`: rays a second in training, milliseconds a picture, SH evaluations a second, and how time and
memory grow with views, resolution and grid.

The scene is a textured ball made here, so that the figures need no capture and compare between machines. Growth is
fitted as y = a x^b while everything else stays at the middle point.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.contract import peak_memory_mb
from workflows.bench.captures import commit
from workflows.cli.console import Console
from workflows.run import host_info
from workflows.run.calibration_scene import WHOLE, ball_trainer, ball_view
from workflows.run.output_dirs import make_folder

if TYPE_CHECKING:
    from stages.inverse_rendering.fit import Trainer

PICTURE = 1024
SH_DIRECTIONS = 100_000
AXES: dict[str, tuple[int, ...]] = {"views": (12, 24, 48), "side": (128, 256, 512), "cells": (72, 144, 288)}
MIDDLE = {"views": 24, "side": 256, "cells": 144}
PARTS: dict[str, dict[str, Any]] = {
    "the whole model": {},
    "k = 1": {"rank": 1},
    "SH order 3": {"light_order": 3},
    "no lobe": {"specular": "off"},
    "no calibration": {"calibration": "off"},
    "the surface at rest": {"refine_geometry": "off"},
    "nothing but albedo and light": {
        "specular": "off",
        "light_order": 3,
        "calibration": "off",
        "refine_geometry": "off",
    },
}


@dataclass(frozen=True, slots=True)
class Point:
    """One training set-up. start_s: reading its photos into a table and building the model; memory_mb: what that and
    the first steps added to the process."""

    views: int
    side: int
    cells: int
    step_ms: float
    rays_per_s: float
    start_s: float
    memory_mb: float


def options(sub: argparse.ArgumentParser) -> None:
    """The command line's options."""
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for speed.json and speed.md")
    sub.add_argument("--run", dest="asset", metavar="DIR", help="a finished run: also time its exported asset")
    sub.add_argument("--batch", type=int, default=4096, help="rays a step (%(default)s)")
    sub.add_argument("--least", type=float, default=2.0, metavar="S", help="seconds to time each point (%(default)s)")
    sub.add_argument("--device", default="cpu", help="cpu or cuda (%(default)s)")


def run(given: argparse.Namespace, console: Console) -> int:
    """neuface bench speed"""
    from workflows.cli.render import component_in
    from workflows.run.plan import device_for

    out, device = Path(given.out), device_for(given.device)
    if given.asset:
        component_in(Path(given.asset))  # before minutes of measuring
    make_folder(out)
    found: dict[str, Any] = {"machine": host_info.machine(), "commit": commit(), "device": device, "batch": given.batch}
    points: list[Point] = []
    for number, setup in enumerate(setups(), 1):
        console.note(f"training {number} of {len(setups())}: {setup}")
        points.append(host_info.apart(measure, *setup.values(), given.batch, given.least, device))
    found["training"] = [asdict(p) for p in points]
    found["growth"] = laws(points)
    console.note("parts of the model, spherical harmonics, pictures")
    found["parts_ms"] = parts(given, device)
    found["sh"] = harmonics(given.least, device)
    found["picture_ms"] = pictures(given, device)
    (out / "speed.json").write_text(json.dumps(found, indent=1) + "\n")
    text = "\n".join(report(found))
    (out / "speed.md").write_text(text + "\n")
    console.close()
    print(text)
    return 0


def setups() -> list[dict[str, int]]:
    """The middle point, and each axis through it."""
    out = [dict(MIDDLE)]
    for axis, values in AXES.items():
        out += [{**MIDDLE, axis: v} for v in values if v != MIDDLE[axis]]
    return out


# ------------------------------------------------------------------ measuring
def trainer(views: int, side: int, cells: int, batch: int, device: str, part: dict[str, Any] | None = None) -> Trainer:
    """A fit of the ball with the draft's model, whole or without a part."""
    from stages.inverse_rendering.config import Config

    return ball_trainer(views, side, cells, Config(batch=batch, **{**WHOLE, **(part or {})}), device)


def measure(views: int, side: int, cells: int, batch: int, least: float, device: str) -> Point:
    """Train for about `least` seconds, after a few steps of a small fit that load what every fit needs."""
    import pipeline.threads  # noqa: F401  (before torch, as in the command line)

    _steps(trainer(8, 32, 24, 64, device), device)
    before, begun = peak_memory_mb(), time.perf_counter()
    t = trainer(views, side, cells, batch, device)
    begun = time.perf_counter() - begun
    each = host_info.seconds_each(lambda: _steps(t, device), least, 5) / STEPS
    added = peak_memory_mb() - before
    return Point(views, side, cells, round(1e3 * each, 2), round(batch / each), round(begun, 3), round(added, 1))


STEPS = 3


def parts(given: argparse.Namespace, device: str) -> dict[str, float]:
    """Milliseconds of a step at the middle point without parts of the model: what their absence saves."""
    out = {}
    for name, part in PARTS.items():
        t = trainer(**MIDDLE, batch=given.batch, device=device, part=part)
        out[name] = round(1e3 * host_info.seconds_each(lambda t=t: _steps(t, device), given.least, 5) / STEPS, 2)  # type: ignore[misc]
    return out


def _steps(t: Trainer, device: str) -> None:
    for _ in range(STEPS):
        t.advance()
    _wait(device)


def _wait(device: str) -> None:
    if device == "cuda":
        import torch

        torch.cuda.synchronize()


def laws(points: list[Point]) -> dict[str, dict[str, float]]:
    """Exponents b of y ~ x^b along each axis, for the time of a step, of the start, and for memory."""
    out: dict[str, dict[str, float]] = {}
    for axis in AXES:
        others = [a for a in AXES if a != axis]
        line = [p for p in points if all(getattr(p, o) == MIDDLE[o] for o in others)]
        x = [float(getattr(p, axis)) for p in line]
        out[axis] = {
            y: round(host_info.growth(x, [float(getattr(p, y)) for p in line])[1], 2)
            for y in ("step_ms", "start_s", "memory_mb")
        }
    return out


def harmonics(least: float, device: str) -> dict[str, float]:
    """Evaluations a second of a light of order 10 in a direction, all three colours, alone and with gradients."""
    import torch

    from pipeline.maths import sh

    generator = torch.Generator().manual_seed(0)
    d = torch.nn.functional.normalize(torch.randn(SH_DIRECTIONS, 3, generator=generator), dim=-1).to(device)
    c = torch.randn(sh.count(sh.ORDER), 3, generator=generator).to(device)

    def forward() -> None:
        sh.band_radiance(c, d)
        _wait(device)

    def both() -> None:
        light, way = c.clone().requires_grad_(True), d.clone().requires_grad_(True)
        sh.band_radiance(light, way).sum().backward()
        _wait(device)

    return {
        "forward_per_s": round(SH_DIRECTIONS / host_info.seconds_each(forward, least)),
        "with_gradients_per_s": round(SH_DIRECTIONS / host_info.seconds_each(both, least)),
    }


def pictures(given: argparse.Namespace, device: str) -> dict[str, float]:
    """Milliseconds of a picture of 1024 x 1024 pixels: the fitted field, and the exported asset if one is named."""
    from stages.inverse_rendering.ray_sampling import image_rays
    from stages.inverse_rendering.render import render_rays

    t = trainer(8, 64, MIDDLE["cells"], given.batch, device)
    rays = image_rays(ball_view(0, 8, PICTURE), 1, device)
    out = {"field": 1e3 * host_info.seconds_each(lambda: render_rays(t.model, rays, t.settings.samples), 0.0, 1)}
    if given.asset:
        from stages.usd.render.exported import load_exported, read_cameras
        from stages.usd.render.render import Renderer
        from workflows.cli.render import component_in

        root = component_in(Path(given.asset))
        start = time.perf_counter()
        renderer = Renderer(load_exported(root))
        out["asset_opening"] = 1e3 * (time.perf_counter() - start)
        view = next(iter(read_cameras(root.parent / "lookdev.usda").values()))[0].scaled(PICTURE)
        out["asset"] = 1e3 * host_info.seconds_each(lambda: renderer.render(view, samples=0), given.least)
    return {k: round(v, 1) for k, v in out.items()}


# ------------------------------------------------------------------ what people read
def report(found: dict[str, Any]) -> list[str]:
    """Markdown."""
    lines = [
        f"`neuface bench speed`, {found['device']}, batches of {found['batch']} rays.",
        f"Machine: {host_info.describe(found['machine'])}.",
        "",
        "| views | side (px) | grid cells | ms a step | rays/s | start (s) | memory added (MB) |",
        "|---|---|---|---|---|---|---|",
    ]
    for p in found["training"]:
        row = [p["views"], p["side"], p["cells"], p["step_ms"], f"{p['rays_per_s']:,}", f"{p['start_s']:.2f}"]
        lines.append("| " + " | ".join(map(str, [*row, f"{p['memory_mb']:.0f}"])) + " |")
    lines += ["", "Growth, exponent b of x^b:", "", "| with | a step | the start | memory |", "|---|---|---|---|"]
    for axis, b in found["growth"].items():
        lines.append(f"| {axis} | {b['step_ms']} | {b['start_s']} | {b['memory_mb']} |")
    whole = next(iter(found["parts_ms"].values()))
    lines += ["", "| model, at the middle point | ms a step | saved |", "|---|---|---|"]
    lines += [f"| {k} | {v} | {1 - v / whole:.0%} |" for k, v in found["parts_ms"].items()]
    s = found["sh"]
    lines += [
        "",
        f"SH of order 10, three colours: {s['forward_per_s']:,} evaluations/s, {s['with_gradients_per_s']:,} with "
        "gradients. A picture of 1024 x 1024 pixels: "
        + ", ".join(f"{k.replace('_', ' ')} {v:,.0f} ms" for k, v in found["picture_ms"].items())
        + ".",
    ]
    return lines
