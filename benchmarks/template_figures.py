"""Measures an asset made from the head template against the limits that it was made for; docs/benchmarks/template.md.

    python -m benchmarks.template_figures RUN --capture CAPTURE [--scan RUN] [--other RUN CAPTURE] [--write]

RUN: folder of `neuface run CAPTURE --set uv.mesh=template` (or both), its store in place. --scan: of the same command
with `--set uv.mesh=scan`, whose fit is the same: asset against asset. CAPTURE: its folder with `truth/`, if it has one.
--other: run and capture of another rendered person, for what has to be the same place on both. --write keeps the row
under the capture's name in docs/benchmarks/template.json and makes the page again; rows of other captures stay.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import template_measures as measures
from benchmarks.hm08.arkit import NAMES
from benchmarks.template_measures import Made, Person
from pipeline import meshes
from workflows.bench.captures import commit, finite
from workflows.bench.captures_figures import Run, read_run
from workflows.evaluation import stored_truth

ROOT = Path(__file__).resolve().parents[1]
RECORD, PAGE = ROOT / "docs/benchmarks/template.json", ROOT / "docs/benchmarks/template.md"
Figures = dict[str, float | None]


@dataclass(frozen=True)
class Limit:
    """A figure of the page: what it is, its limit, and whether more is better. of: figure that is added to the limit
    (the scan's)."""

    what: str
    limit: float | None
    more: bool = False
    of: str = ""
    form: str = "{:.3g}"

    def bound(self, figures: Figures) -> float | None:
        """The limit of these figures; None without one."""
        if self.limit is None:
            return None
        base = figures.get(self.of) if self.of else 0.0
        return None if base is None else base + self.limit

    def met(self, figures: Figures, name: str) -> bool | None:
        """Whether it holds; None if it can't be said."""
        value, bound = figures.get(name), self.bound(figures)
        if value is None or bound is None:
            return None
        return value >= bound if self.more else value <= bound


LIMITS: dict[str, Limit] = {
    "surface_mm": Limit("displaced head from the fitted surface, seen skin, median (mm)", 0.10),
    "surface_95_mm": Limit("the same, 95 % (mm)", 0.5),
    "truth_mm": Limit("asset and true surface, mean of both ways (mm); scan + .03", 0.03, of="scan_truth_mm"),
    "skin_mm": Limit("true skin from the asset, median (mm); scan + .1", 0.1, of="scan_skin_mm"),
    "face_depth_mm": Limit("depth of the face, median (mm); scan + .1", 0.1, of="scan_face_depth_mm"),
    "psnr": Limit("held-out photos, asset (dB); scan - .3", -0.3, more=True, of="scan_psnr", form="{:.2f}"),
    "face_share": Limit("share of the face in its tile", 0.45, more=True),
    "off_upright": Limit("face off upright in the texture (degrees)", 2.0, form="{:.2f}"),
    "quads_share": Limit("share of quads in the control cage", 1.0, more=True),
    "crossings": Limit("edges of the face that pass through it", 0),
    "landmarks_mm": Limit("landmarks carried from the other person, median (mm)", 1.5),
    "landmarks_most_mm": Limit("the same, largest (mm)", None),
    "pupils_mm": Limit("pupils, the worse one (mm)", 1.5),
    "scale_off": Limit("scale from the photos alone, share off", 0.03),
    "uv_off": Limit("landmarks' texture coordinates on both persons, median (share of the tile)", 0.01),
    "uv_most_off": Limit("the same, largest", None),
    "usd_shapes": Limit("ARKit's expressions in USD", 52, more=True),
    "glb_shapes": Limit("the same in glb", 52, more=True),
    "template_cpu_s": Limit("processor time of the template stage (s)", 30),
}


def measured(
    run: Run, capture: Path, scan: Run | None, other: tuple[Run, Path] | None, say: Callable[[str], None]
) -> Figures:
    """All figures that the run, its capture's truth and the other runs allow."""
    made = measures.made_of(run)
    found: Figures = {}
    for what, figures in (
        ("files and layout", lambda: layout(made)),
        ("surface", lambda: surface(made)),
        ("truth", lambda: truth(run, capture, "")),
        ("scan", lambda: {} if scan is None else truth(scan, capture, "scan_")),
        ("landmarks", lambda: person(made, capture, other)),
        ("time", lambda: {"template_cpu_s": measures.processor_seconds(run)}),
    ):
        say(what)
        found |= figures()
    return {k: None if v is None else round(float(v), 5) for k, v in finite(found).items()}


def layout(made: Made) -> Figures:
    """Texture, cage and expressions."""
    asset = made.run.out / made.run.record["asset"]
    quads, others = measures.quads_of(asset)
    return {
        "face_share": measures.face_share(made),
        "off_upright": measures.off_upright(made),
        "quads_share": quads / max(quads + others, 1),
        "crossings": measures.crossings(made),
        "usd_shapes": len(set(NAMES) & set(measures.shapes_in_usd(asset))),
        "glb_shapes": len(set(NAMES) & set(measures.shapes_in_glb(asset.with_suffix(".glb")))),
    }


def surface(made: Made) -> Figures:
    """Distances from the fitted surface."""
    run = made.run
    dense = meshes.load(run.path("surface", run.manifest("surface")["mesh"]))
    middle, most = measures.from_surface(made, dense, measures.cameras_of(run))
    return {"surface_mm": middle, "surface_95_mm": most}


def truth(run: Run, capture: Path, prefix: str) -> Figures:
    """Held-out photos and the true surface."""
    held = run.metrics.get("holdout", {})
    known, _ = stored_truth.measure(run, capture)
    names = {"truth_mm": "chamfer_mm", "skin_mm": "skin_median_mm", "face_depth_mm": "depth_median_mm"}
    found = {k: known[v] for k, v in names.items() if known.get(v) is not None}
    psnr = held.get("asset_psnr") if held.get("held_out") else None
    return {f"{prefix}{k}": v for k, v in (found | {"psnr": psnr}).items()}


def person(made: Made, capture: Path, other: tuple[Run, Path] | None) -> Figures:
    """Landmarks, pupils and scale of a rendered person; nothing for other captures."""
    folder = capture / "truth"
    if not (folder / "landmarks.json").is_file():
        return {}
    one = measures.person_of(made, folder)
    pupils = measures.pupil_errors(one)
    found: Figures = {"pupils_mm": max(pupils.values()) if len(pupils) == 2 else None}
    if not made.run.manifest("poses").get("metric"):
        found["scale_off"] = abs(1 / one.scale - 1)
    if other is None:
        return found
    second: Person = measures.person_of(measures.made_of(other[0]), other[1] / "truth")
    carried = list(measures.carried_landmarks(one, second).values())
    apart = list(measures.uv_differences(one, second).values())
    return found | {
        "landmarks_mm": float(np.median(carried)), "landmarks_most_mm": max(carried),
        "uv_off": float(np.median(apart)), "uv_most_off": max(apart),
    }  # fmt: skip


# ------------------------------------------------------------------ the page
def page(rows: dict[str, Any]) -> str:
    """The document."""
    names = sorted(rows)
    lines = [
        "# The head template: figures",
        "",
        "Assets made from the head template (`uv.mesh=template`), drafts, each against its limit. *scan*: the asset of",
        "the same fit made from the scan. Lengths by exact distances to triangles, on skin that three fitted photos",
        "see. Rendered persons (`person_*`) are made from the template's own mesh and flatter it: their shape says",
        "little, their landmarks, pupils and scale are what they are for. Figures that miss their limit are **bold**.",
        "What each means: [stages/template.md](../stages/template.md). Made by",
        "",
        "    python -m benchmarks.template_figures RUN --capture CAPTURE --scan RUN --write",
        "",
        "| figure | limit | " + " | ".join(names) + " |",
        "|---|---|" + "---|" * len(names),
    ]
    for key, limit in LIMITS.items():
        cells = [_cell(key, limit, rows[n]["figures"]) for n in names]
        if any(cells):
            lines.append(f"| {limit.what} | {_bound(limit)} | " + " | ".join(cells) + " |")
    made = ", ".join(f"{n}: {rows[n]['date']}, {rows[n]['commit']}" for n in names)
    return "\n".join([*lines, "", f"Made: {made}."]) + "\n"


def _bound(limit: Limit) -> str:
    if limit.limit is None or limit.of:
        return ""
    return f"{'>=' if limit.more else '<='} {limit.limit:g}"


def _cell(key: str, limit: Limit, figures: Figures) -> str:
    value, bound = figures.get(key), limit.bound(figures)
    if value is None:
        return ""
    text = limit.form.format(value)
    if limit.of and bound is not None:
        text += f" ({limit.form.format(figures[limit.of])})"
    return f"**{text}**" if limit.met(figures, key) is False else text


def recorded() -> dict[str, Any]:
    """The rows by capture."""
    return dict(json.loads(RECORD.read_text())) if RECORD.is_file() else {}


def main(arguments: Sequence[str]) -> int:
    """Exit code 1 if a figure misses its limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("run", type=Path)
    parser.add_argument("--capture", type=Path, required=True)
    parser.add_argument("--scan", type=Path, help="the run with uv.mesh=scan")
    parser.add_argument("--other", type=Path, nargs=2, metavar=("RUN", "CAPTURE"), help="another rendered person")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.relative_to(ROOT)} and its JSON")
    given = parser.parse_args(arguments)
    run, scan = read_run(given.run), None if given.scan is None else read_run(given.scan)
    other = None if given.other is None else read_run(given.other[0])
    if run is None or (given.scan and scan is None) or (given.other and other is None):
        parser.error("each run is a folder with run.json")
    figures = measured(
        run, given.capture, scan, None if other is None else (other, given.other[1]), lambda what: print(what, "...")
    )
    for key, limit in LIMITS.items():
        if cell := _cell(key, limit, figures):
            print(f"{cell.strip('*'):>18}  {'MISSED' if cell.startswith('*') else 'ok':7}{limit.what} {_bound(limit)}")
    if given.write:
        row = {"figures": figures, "commit": commit(), "date": datetime.date.today().isoformat()}
        rows = dict(sorted({**recorded(), given.capture.name: row}.items()))
        RECORD.write_text(json.dumps(rows, indent=1) + "\n")
        PAGE.write_text(page(rows))
    return int(any(limit.met(figures, key) is False for key, limit in LIMITS.items()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
