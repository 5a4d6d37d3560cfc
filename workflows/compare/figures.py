"""Figures, checks and settings of two runs, and what got better or worse.

Limits of noise are those of `neuface bench captures` (captures_table.FIGURES): two runs of one commit on one machine
differ by less. A figure without a limit is shown and not judged.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pipeline.verdict import LEVELS
from workflows.bench.captures_against import step_of
from workflows.bench.captures_figures import figures_of
from workflows.bench.captures_table import FIGURES, Figure
from workflows.compare.runs import Side

UNJUDGED = (  # (name in metrics.json, title, form): how much two equal runs differ here was not measured
    ("holdout.asset_ssim", "SSIM of the asset", "{:.4f}"),
    ("holdout.asset_flip", "FLIP of the asset (0 is equal)", "{:.4f}"),
    ("holdout.asset_mask_iou", "IoU of the silhouettes, asset", "{:.4f}"),
    ("holdout.by_label.asset_psnr.face", "face, asset (dB)", "{:.2f}"),
    ("holdout.by_label.asset_psnr.eyes", "eyes, asset (dB)", "{:.2f}"),
    ("holdout.by_label.asset_psnr.hair", "hair, asset (dB)", "{:.2f}"),
    ("uv.faces", "triangles", "{:,.0f}"),
    ("uv.stretch", "stretch of the charts", "{:.2f}"),
    ("uv.deviation_rms_mm", "textured mesh to dense mesh, RMS (mm)", "{:.3f}"),
    ("maps.size", "texels along a side of the maps", "{:,.0f}"),
    ("maps.texel_mm", "edge of a texel (mm)", "{:.2f}"),
    ("maps.detail_support", "share of texels with detail from photos", "{:.3f}"),
)
TITLES = {  # of figures that the table of captures names by their place in it
    "placed": "photos with a camera",
    "psnr": "PSNR of the model (dB)",
    "psnr_matched": "the same in the photos' colours (dB)",
    "asset_psnr": "PSNR of the asset (dB)",
    "asset_psnr_matched": "the same in the photos' colours (dB)",
    "mask_median": "masks, median IoU with the hull",
    "mask_worst": "masks, lowest IoU with the hull",
    "unseen": "texels that no photo saw (%)",
    "fragments": "charts that are fragments",
    "face_share": "texels of the face (%)",
    "seconds": "time of all stages (s)",
    "memory_mb": "peak memory (MB)",
}
SAID = ("better", "worse", "within noise", "not judged")


@dataclass(frozen=True, slots=True)
class Difference:
    """A figure of both runs, as text. said: better, worse, within noise, or not judged (also where one is missing)."""

    name: str
    title: str
    means: str
    a: str
    b: str
    change: str
    said: str


@dataclass(frozen=True, slots=True)
class Changed:
    """A check whose level differs between the runs; a level is "-" where the run has no such check."""

    stage: str
    check: str
    a: str
    b: str
    said_a: str
    said_b: str
    step: int  # above 0: B is better


def differences(a: Side, b: Side) -> list[Difference]:
    """All figures that at least one run has: those with limits first."""
    ours, theirs = figures_of(a.run), figures_of(b.run)
    shared = _over_common_views(a, b)
    out = [_difference(f, ours.get(f.name), theirs.get(f.name)) for f in FIGURES]
    out += [_difference(f, *values) for f, values in shared]
    for path, title, form in UNJUDGED:
        plain = Figure(path, title, "", form=form)
        out.append(_difference(plain, *(_number(at(s.metrics, path)) for s in (a, b)), judged=False))
    return [d for d in out if (d.a, d.b) != ("-", "-")]


def _over_common_views(a: Side, b: Side) -> list[tuple[Figure, tuple[float, float]]]:
    """Mean PSNR over the photos that both runs score, where they do not score the same ones."""
    pairs = scored_views(a, b)
    counts = [len(at(s.metrics, "holdout.per_view") or {}) for s in (a, b)]
    if not pairs or counts == [len(pairs)] * 2:
        return []
    known = next(f for f in FIGURES if f.name == "asset_psnr")
    title = f"asset, the {len(pairs)} views of both (dB)"
    figure = Figure("asset_psnr_common", title, "PSNR over photos that both score", 1, known.absolute)
    return [(figure, tuple(float(np.mean([p[i] for p in pairs.values()])) for i in (0, 1)))]  # type: ignore[list-item]


def scored_views(a: Side, b: Side) -> dict[str, tuple[float, float]]:
    """PSNR of the asset in A and in B by the photo's name, for photos that both score."""
    from workflows.compare.runs import common_photos

    ours, theirs = (at(s.metrics, "holdout.per_view") or {} for s in (a, b))
    out: dict[str, tuple[float, float]] = {}
    for x, y in common_photos(a, b):
        one = _number(at(ours, f"{x.get('index')}.asset_psnr"))
        two = _number(at(theirs, f"{y.get('index')}.asset_psnr"))
        if one is not None and two is not None:
            out[str(x.get("name"))] = (one, two)
    return out


def _difference(figure: Figure, a: float | None, b: float | None, *, judged: bool = True) -> Difference:
    x, y = ("-" if v is None else figure.form.format(figure.scale * v) for v in (a, b))
    means, title = figure.means.replace("`", ""), TITLES.get(figure.name, figure.title)
    if a is None or b is None:
        return Difference(figure.name, title, means, x, y, "", "not judged")
    step = figure.scale * (b - a)
    change = ("+" if step >= 0 else "-") + figure.form.format(abs(step))
    if not judged or figure.better == 0:
        return Difference(figure.name, title, means, x, y, change, "not judged")
    way = step_of(figure, a, b)
    said = "within noise" if way == 0 else "better" if way > 0 else "worse"
    return Difference(figure.name, title, means, x, y, change, said)


# ------------------------------------------------------------------ verdicts
def level(side: Side) -> str:
    """Of a run's verdict; "none" where it has none."""
    found = side.record.get("verdict")
    return str(found.get("level", "none")) if isinstance(found, dict) else "none"


def reasons(side: Side) -> list[dict[str, str]]:
    """What is not good, the worst first: stage, check, level, said, remedy."""
    kept = ("stage", "check", "level", "said", "remedy")
    return [{k: str(f.get(k, "")) for k in kept} for f in _findings(side) if f.get("level") != "good"]


def changed_checks(a: Side, b: Side) -> list[Changed]:
    """Checks whose level differs, what got worse first."""
    ours, theirs = _by_check(a), _by_check(b)
    out = []
    for key in dict.fromkeys([*ours, *theirs]):
        x, y = ours.get(key), theirs.get(key)
        levels = [str(f.get("level")) if f else "-" for f in (x, y)]
        if levels[0] == levels[1] or (None in (x, y) and "good" in levels):
            continue
        ranks = [LEVELS.index(v) if v in LEVELS else None for v in levels]  # good first: a lower rank is better
        step = 0 if ranks[0] is None or ranks[1] is None else ranks[0] - ranks[1]
        said_a, said_b = (str(f.get("said", "")) if f else "" for f in (x, y))
        out.append(Changed(*key, levels[0], levels[1], said_a, said_b, step))
    return sorted(out, key=lambda c: c.step)


def _findings(side: Side) -> list[dict[str, Any]]:
    """All checks where the report has them, else those of run.json, which are not good."""
    found = at(side.metrics, "verdict.findings") or at(side.record, "verdict.findings") or []
    every = [f for f in found if isinstance(f, dict)] if isinstance(found, list) else []
    return sorted(every, key=lambda f: -LEVELS.index(f["level"]) if f.get("level") in LEVELS else 0)


def _by_check(side: Side) -> dict[tuple[str, str], dict[str, Any]]:
    return {(str(f.get("stage", "")), str(f.get("check", ""))): f for f in _findings(side)}


# ------------------------------------------------------------------ settings
def different_settings(a: Side, b: Side) -> dict[str, tuple[Any, Any]]:
    """Settings whose values differ: name -> (A's, B's); None where a run does not have it. Without the stages' own
    records, the options of the two commands."""
    ours, theirs = a.settings(), b.settings()
    stages = {n.partition(".")[0] for n in ours} & {n.partition(".")[0] for n in theirs}
    out = {
        n: (ours.get(n), theirs.get(n))
        for n in dict.fromkeys([*ours, *theirs])
        if n.partition(".")[0] in stages and ours.get(n) != theirs.get(n)
    }
    asked, versions = (tuple(_table(s.record.get(n)) for s in (a, b)) for n in ("request", "versions"))
    both = [n for n in asked[0] if n in asked[1] and n not in ("out", "store", "from_stage")]
    out |= {f"asked for: {n}": (asked[0][n], asked[1][n]) for n in both if asked[0][n] != asked[1][n]}
    if all(versions):
        pairs = {n: (versions[0].get(n), versions[1].get(n)) for n in dict.fromkeys([*versions[0], *versions[1]])}
        out |= {f"version of {n}": pair for n, pair in pairs.items() if pair[0] != pair[1]}
    return out


def _table(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def at(content: Any, path: str) -> Any:
    """The value at a path of names with dots; None where there is none."""
    for part in path.split("."):
        content = content.get(part) if isinstance(content, Mapping) else None
    return content


def _number(value: object) -> float | None:
    good = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
    return float(value) if good else None  # type: ignore[arg-type]


def as_tables(found: Iterable[Any]) -> list[dict[str, Any]]:
    """Dataclasses as plain objects, for JSON."""
    return [asdict(x) for x in found]
