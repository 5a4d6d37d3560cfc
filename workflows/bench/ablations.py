"""`neuface bench ablations`: the systems that the paper compares, as settings of one code, at one stated budget.

Each row is a run up to the surface with a few settings changed. Rows are kept in the store: a bench that was stopped
goes on, and rows may be made a few at a time. Scores are over held-out views (stages.report.metrics); `aligned` is the
PSNR after one 3 x 3 matrix a view, as the paper measures. LPIPS needs weights that are not shipped: FLIP stands in its
place, and PSNR has the paper's ordering to agree with.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import Artifact, Located
from pipeline.capture_artifacts import Capture, CaptureView
from stages.inverse_rendering.systems import paper_config
from workflows.bench.captures import commit
from workflows.bench.rows import budget_of, kept, plan_of, rows_with, shared_options
from workflows.cli.console import Console
from workflows.run import host_info
from workflows.run.output_dirs import make_folder

F32 = npt.NDArray[np.float32]
Looks = tuple[float, float, float, float]
OURS = "SH + neural bases, k = 3"
AS_IN_THE_PAPER = (  # settings of every row, with the values of preset paper
    "basis_inputs", "calibration", "rank", "light_order", "specular", "refine_geometry", "resolution", "shadows",
    "albedo_sparsity", "uniform_albedo_until", "stereo",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Row:
    """A system. settings: of the stage inverse_rendering. paper: its PSNR and Chamfer distance there, Subject 1."""

    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    paper: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Table:
    """Rows as the paper groups them."""

    title: str
    rows: tuple[Row, ...]


FULL = Row(OURS, {}, (31.25, 0.447))
SEED = Row("another seed", {"seed": 1})
TABLES = (
    Table(
        "Table 2: shading model",
        (
            Row("SH + Phong", {"shading": "phong", "attenuation": "phong"}, (29.31, 0.556)),
            Row("cubemap + Disney BRDF", {"shading": "disney", "light": "cubemap"}, (30.45, 0.524)),
            Row("cubemap + neural bases", {"light": "cubemap"}, (30.82, 0.426)),
            FULL,
        ),
    ),
    Table(
        "Table 3: low-rank prior",
        (
            Row("direct fitting", {"integral": "direct"}, (29.45, 0.553)),
            Row("256-D feature", {"integral": "feature"}, (29.43, 0.544)),
            FULL,
        ),
    ),
    Table(
        "Table A2: calibration, geometry prior, specular loss",
        (
            Row("without calibration", {"calibration": "off"}),
            Row("without geometry prior (a sphere)", {"prior": "sphere"}, (28.11, 0.647)),
            Row("without specular loss", {"specular_energy": 0.0}, (31.03, 0.453)),
            FULL,
        ),
    ),
    Table(
        "Fig. A3: number of bases",
        tuple(FULL if k == 3 else Row(f"k = {k}", {"rank": k}) for k in range(1, 9)),
    ),
    Table(
        "not in the paper: attenuation of the light, and the noise of one seed",
        (
            Row("exact vMF attenuation", {"attenuation": "exact"}),
            SEED,
            FULL,
        ),
    ),
)


@dataclass(frozen=True, slots=True)
class Result:
    """Scores of a row: dB, dB after alignment, -, -, mm (NaN without a true surface), and seconds of the fit."""

    psnr: float
    aligned: float
    ssim: float
    flip: float
    chamfer: float
    seconds: float


def options(sub: argparse.ArgumentParser) -> None:
    """The command line's options."""
    sub.add_argument("capture", metavar="CAPTURE", help="a capture; truth/mesh_gt.ply in it gives Chamfer distances")
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for the tables")
    shared_options(sub, 400, "every fit")
    sub.add_argument("--rows", default="", metavar="TEXT", help="only rows with this text in their name")


def run(given: argparse.Namespace, console: Console) -> int:
    """neuface bench ablations"""
    chosen = rows_with(given.rows, unique(TABLES), "--rows", "row")
    out = Path(given.out)
    make_folder(out)
    path = out / "ablations.json"
    budget = budget_of(given, ("steps", "side", "batch", "holdout"))
    results, _ = kept(path, budget, "rows", Result)
    about = made_by(f"neuface bench ablations ../shared/captures/{budget['capture']} --out DIR")
    for number, row in enumerate(chosen, 1):
        console.note(f"row {number} of {len(chosen)}: {row.name}")
        results[row.name] = measure(row, given, console)
        rows = {k: asdict(v) for k, v in results.items()}
        path.write_text(json.dumps({**about, "budget": budget, "rows": rows}, indent=1) + "\n")
    text = "\n".join(report(budget, results))
    (out / "ablations.md").write_text(text + "\n")
    console.close()
    print(text)
    return 0


def made_by(command: str) -> dict[str, str]:
    """By which command, of which commit, when and on what machine."""
    machine = host_info.machine()
    return {"command": command, "commit": commit(), "date": machine["date"], "machine": host_info.describe(machine)}


def unique(tables: Iterable[Table]) -> list[Row]:
    """Every row once, in order."""
    return list({r.name: r for t in tables for r in t.rows}.values())


def settings_of(row: Row, given: argparse.Namespace) -> tuple[str, ...]:
    """Settings as for `--set`: the budget, the paper's model where the fast one adds to it, the row's own."""
    paper = paper_config().presets["paper"]
    base = {
        "preset": "comparison",
        "steps": given.steps,
        "image_side": given.side,
        "batch": given.batch,
        "grid_cells": 192,
        **{name: paper[name] for name in AS_IN_THE_PAPER},
        "light_from": "uniform_albedo",
        "levels": 3,
    }
    values = {f"inverse_rendering.{k}": v for k, v in {**base, **row.settings}.items()}
    return tuple(f"{k}={v}" for k, v in {**values, "surface.resolution": 160}.items())


def measure(row: Row, given: argparse.Namespace, console: Console) -> Result:
    """Run a row, or take it from the store, and score it."""
    from workflows.run.runner import run_stages
    from workflows.run.session import Session

    plan = plan_of(given, settings_of(row, given))
    done = {d.stage: d for d in run_stages(plan, Session(console))}
    found: dict[str, Located[Any]] = {name: d.located for name, d in done.items()}
    views = [scores_of(v, found) for v in found["capture"].artifact.views if v.holdout]
    mean = np.nanmean(np.array(views, np.float64), axis=0) if views else np.full(4, np.nan)
    seconds = float(done["inverse_rendering"].run["seconds"])
    psnr, aligned, ssim, flip = (float(m) for m in mean)
    return Result(psnr, aligned, ssim, flip, chamfer(found, Path(given.capture)), seconds)


def scores_of(view: CaptureView, found: dict[str, Located[Any]]) -> Looks:
    """Of one held-out view, as the fit predicted it."""
    from pipeline.images import read_exr

    fitted = found["inverse_rendering"]
    held = next(h for h in fitted.artifact.held_out if h.index == view.index)
    return compared(read_exr(fitted.path(held.exr))[0], held.scale, view, found)


def compared(rendered: F32, scale: int, view: CaptureView, found: dict[str, Located[Any]]) -> Looks:
    """PSNR, aligned PSNR, SSIM and FLIP of a render, `scale` times smaller than the view's photo."""
    from pipeline.images import read_alpha, read_linear, shrink
    from stages.report import metrics

    mask_of = {m.index: m for m in found["masks"].artifact.masks}[view.index]
    photo, mask = read_linear(found["capture"].path(view.image)), read_alpha(found["masks"].path(mask_of.mask))
    h, w = (n // scale * scale for n in photo.shape[:2])
    photo, mask = shrink(photo[:h, :w], scale), shrink(mask[:h, :w], scale)
    s = metrics.score(rendered, photo, mask)
    return s.psnr, aligned_psnr(rendered[..., :3], photo, mask), s.ssim, float("nan") if s.flip is None else s.flip


def aligned_psnr(rendered: F32, photo: F32, mask: F32) -> float:
    """PSNR over the subject after the 3 x 3 matrix on encoded colours that fits best. [NeuFace section B]"""
    from stages.report import metrics

    inside = mask > 0.5
    a, b = (np.asarray(metrics.encoded(x[inside]), np.float64) for x in (rendered, photo))
    matrix, *_ = np.linalg.lstsq(a, b, rcond=None)
    return metrics.psnr((a @ matrix).clip(0, 1).astype(np.float32), b.astype(np.float32))


def chamfer(found: dict[str, Located[Any]], capture: Path) -> float:
    """Mean of both mean distances between surface and truth, mm, where at least three fitted views see them."""
    truth_path = capture / "truth" / "mesh_gt.ply"
    if not truth_path.is_file():
        return float("nan")
    import trimesh

    from pipeline import meshes
    from pipeline.transforms import apply, matrix
    from workflows.evaluation.demo import seen_by
    from workflows.evaluation.geometry import distances

    surface = found["surface"]
    own = meshes.load(surface.path(surface.artifact.mesh))
    to_capture = matrix(found["poses"].artifact.capture_from_asset)
    mine = trimesh.Trimesh(apply(to_capture, own.vertices.astype(np.float64)), own.faces, process=False)
    true = trimesh.load(truth_path, process=False)
    views = [v for v in _capture(found["capture"]).views if not v.holdout]
    there = distances(true, seen_by(mine, views))
    back = distances(mine, seen_by(true, views))
    return float(500 * (there.mean() + back.mean()))


def _capture(located: Located[Artifact]) -> Capture:
    assert isinstance(located.artifact, Capture)
    return located.artifact


# ------------------------------------------------------------------ what people read
def report(budget: dict[str, Any], results: dict[str, Result]) -> list[str]:
    """Markdown: a table for each of the paper's, each with the ordering that was found."""
    lines = [
        f"Budget of every row: {budget['steps']} steps of {budget['batch']} rays, photos of {budget['side']} px, "
        f"capture {budget['capture']}, held out {budget['holdout']}.",
    ]
    if FULL.name in results and SEED.name in results:
        noise = abs(results[FULL.name].psnr - results[SEED.name].psnr)
        lines.append(
            f"Two seeds of the same system differ by {noise:.2f} dB: differences of that size are not significant."
        )
    for table in TABLES:
        rows = [r for r in table.rows if r.name in results]
        if not rows:
            continue
        lines += [
            "",
            f"**{table.title}**",
            "",
            "| system | PSNR | PSNR aligned | SSIM | FLIP | Chamfer (mm) | s | paper: PSNR, Chamfer |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for r in rows:
            m = results[r.name]
            paper = f"{r.paper[0]:.2f}, {r.paper[1]:.3f}" if r.paper else "-"
            lines.append(
                f"| {r.name} | {m.psnr:.2f} | {m.aligned:.2f} | {m.ssim:.4f} | {m.flip:.4f} | {m.chamfer:.3f} | "
                f"{m.seconds:.0f} | {paper} |"
            )
        lines += ["", ordering(rows, results)]
    return lines


def ordering(rows: list[Row], results: dict[str, Result]) -> str:
    """Best first by PSNR, and in how many pairs that agrees with the paper."""
    best = sorted(rows, key=lambda r: -results[r.name].psnr)
    text = "Found: " + " > ".join(r.name for r in best) + "."
    stated = [r for r in rows if r.paper is not None]
    pairs = [(a, b) for i, a in enumerate(stated) for b in stated[i + 1 :]]
    if not pairs:
        return text
    same = sum(
        (results[a.name].psnr > results[b.name].psnr) == (a.paper[0] > b.paper[0])
        for a, b in pairs
        if a.paper is not None and b.paper is not None
    )
    return f"{text} Agrees with the paper's order in {same} of {len(pairs)} pairs."
