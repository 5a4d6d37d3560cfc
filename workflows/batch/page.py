"""A batch's table and page: summary.json, summary.csv and index.html, what needs a look first."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from pipeline.store import read_object
from pipeline.verdict import LEVELS
from workflows.batch.captures import natural
from workflows.batch.request import BatchRequest
from workflows.batch.state import ENDED, Entry, Summary
from workflows.batch.turn_picture import FILE as TURN
from workflows.batch.turn_picture import write_turn
from workflows.run.owned import write_owned
from workflows.run.published import LIST
from workflows.run.verdict import level_in

# figure -> where run.json or metrics.json has it
FIGURES: dict[str, tuple[str, ...]] = {
    "psnr": ("metrics", "holdout", "psnr"),
    "ssim": ("metrics", "holdout", "ssim"),
    "asset_psnr": ("metrics", "holdout", "asset_psnr"),
    "faces": ("metrics", "uv", "faces"),
    "stretch": ("metrics", "uv", "stretch"),
    "seconds": ("run", "timing", "total"),
    "peak_memory_mb": ("run", "peak_memory_mb"),
}
ODD = 3.5  # robust z-score from which a figure is called odd (Iglewicz and Hoaglin's limit)
MAD = 0.6745  # quartile of the normal distribution: makes a median of deviations comparable to a standard deviation
ENOUGH = 5  # captures below which outliers are not marked
TABLES = ("summary.json", "summary.csv", "index.html")
AVERAGE, RECORD = "average", "average.json"  # folder in OUT, and what says whose heads it holds (average.py)
TURN_SECONDS = 3.0  # of one writing of the page that may go into new pictures
FIRST_LINE = 300  # characters of a fault that the table shows


@dataclass(slots=True)
class Row:
    """One capture in the table. level: how good its result is; reason: the worst of why. turn: a
    picture that turns. odd: how far the oddest figure
    is from the others'; odd_in: which. measured: of a batch with --neutral, what became of the expression."""

    name: str
    state: str
    attempts: int
    level: str = ""
    reason: str = ""
    fault: str = ""
    figures: dict[str, float] = field(default_factory=dict)
    warnings: int = 0
    odd: float = 0.0
    odd_in: str = ""
    thumbnail: str = ""
    turn: str = ""
    report: str = ""
    measured: str = ""


def write_page(request: BatchRequest, summary: Summary) -> None:
    """Write the three files into OUT/batch. A file of the user's in the way is renamed to NAME.yours-N."""
    out = Path(request.out).absolute()
    _turn_pictures([out / e.name for e in summary.entries if e.state in ENDED])
    rows = ranked([_row(e, out) for e in summary.entries])
    notes = measured_notes(summary)
    for row in rows:
        row.measured = notes.get(row.name, "")
    content = {
        "counts": summary.counts(),
        "held": summary.held.message if summary.held else None,
        "levels": {x: sum(r.level == x for r in rows) for x in reversed(LEVELS)},
        "medians": _medians(rows),
        "captures": [asdict(r) for r in rows],
        "measured": [m.model_dump(mode="json") for m in summary.measured],
        "average": summary.average.model_dump(mode="json") if summary.average is not None else None,
    }
    page = _template().render(**content, rows=rows, names=list(FIGURES), odd=ODD, of_average=AVERAGE, script=_script())
    texts = {"summary.json": json.dumps(content, indent=1), "summary.csv": _csv(rows), "index.html": page}
    older = _of_an_older_batch(request.folder)
    for name, text in texts.items():
        write_owned(request.folder, name, text, lambda path: older)


def _turn_pictures(folders: Sequence[Path]) -> None:
    """Make the pictures that turn where they are missing, for a few seconds: the next writing goes on."""
    begin = time.monotonic()
    for folder in folders:
        if time.monotonic() - begin > TURN_SECONDS:
            return
        if (folder / "asset").is_dir() and (folder / "report").is_dir() and not (folder / TURN).is_file():
            write_turn(folder)


def measured_notes(summary: Summary) -> dict[str, str]:
    """For each capture what became of its expression on the neutral; empty without --neutral."""
    notes: dict[str, str] = {}
    for m in summary.measured:
        notes |= {capture: shape for shape, capture in m.shapes.items()}
        notes |= {capture: f"left out: {why}" for capture, why in m.left_out.items()}
        if m.neutral:
            notes[m.neutral] = f"neutral: {m.reason}" if m.reason else f"neutral, with {len(m.shapes)} measured"
    return notes


def captures_in(out: Path) -> tuple[str, ...]:
    """Names of the captures whose heads are in OUT/average."""
    names = read_object(out / AVERAGE / RECORD).get("captures", ())
    return tuple(str(n) for n in names) if isinstance(names, list) else ()


def _of_an_older_batch(folder: Path) -> bool:
    """Whether the tables in a folder are of a version that did not list its files: three of them, and no list."""
    return not (folder / LIST).exists() and all((folder / name).is_file() for name in TABLES)


def ranked(rows: Sequence[Row]) -> list[Row]:
    """Failed ones first, then by verdict from the worst, then the oddest, then by name."""
    _find_odd(rows)
    return sorted(rows, key=lambda r: (_rank(r), -r.odd if r.odd >= ODD else 0, natural(r.name)))


def _rank(row: Row) -> int:
    """0 for failed captures, 1 for unusable results, 2 for usable ones, 3 for the rest."""
    return 0 if row.state == "failed" else {"unusable": 1, "usable": 2}.get(row.level, 3)


def _find_odd(rows: Sequence[Row]) -> None:
    """Robust z-score of each figure: distance from the median over the median distance."""
    for name in FIGURES:
        values = [r.figures[name] for r in rows if name in r.figures]
        if len(values) < ENOUGH:
            continue
        middle = statistics.median(values)
        spread = statistics.median(abs(v - middle) for v in values)
        scale = max(spread, 1e-2 * abs(middle), 1e-12)  # where all are alike, a few hundredths are no outlier yet
        for row in rows:
            score = MAD * abs(row.figures[name] - middle) / scale if name in row.figures else 0.0
            if score > row.odd:
                row.odd, row.odd_in = round(score, 2), name


def _medians(rows: Sequence[Row]) -> dict[str, float]:
    found = {n: [r.figures[n] for r in rows if n in r.figures] for n in FIGURES}
    return {n: statistics.median(values) for n, values in found.items() if values}


def _row(entry: Entry, out: Path) -> Row:
    row = Row(entry.name, entry.state, entry.attempt)
    if entry.fault is not None:
        row.fault = entry.fault.message
    if entry.state not in ENDED:
        return row
    folder, link = out / entry.name, f"../{quote(entry.name)}"
    run, metrics = read_object(folder / "run.json"), read_object(folder / "report" / "metrics.json")
    stages = run.get("stages", {})
    run["peak_memory_mb"] = max((s.get("peak_memory_mb") or 0 for s in stages.values()), default=None)
    troubles = run.get("verdict", {}).get("findings", ())
    row.level, row.reason = entry.level or level_in(run) or "", str(troubles[0].get("said", "")) if troubles else ""
    row.warnings = sum(len(s.get("warnings", ())) for s in stages.values())
    row.figures = {
        n: v for n, path in FIGURES.items() if (v := _at({"run": run, "metrics": metrics}, path)) is not None
    }
    if (folder / "asset/thumbnails/default.png").is_file():
        row.thumbnail = f"{link}/asset/thumbnails/default.png"
    if (folder / TURN).is_file():
        row.turn = f"{link}/{TURN}"
    if (folder / "report/index.html").is_file():
        row.report = f"{link}/report/index.html"
    return row


def _at(content: Mapping[str, Any], path: Sequence[str]) -> float | None:
    value: Any = content
    for part in path:
        value = value.get(part) if isinstance(value, Mapping) else None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _csv(rows: Sequence[Row]) -> str:
    stream = io.StringIO()
    table = csv.writer(stream)
    table.writerow(
        ["name", "state", "verdict", "attempts", *FIGURES, "warnings", "odd", "odd_in", "reason", "fault", "measured"]
    )
    for r in rows:
        figures = [f"{r.figures[n]:.6g}" if n in r.figures else "" for n in FIGURES]
        fault = " ".join(r.fault.split())[:FIRST_LINE]
        reason = " ".join(r.reason.split())[:FIRST_LINE]
        table.writerow(
            [
                r.name,
                r.state,
                r.level,
                r.attempts,
                *figures,
                r.warnings,
                r.odd,
                r.odd_in,
                reason,
                fault,
                " ".join(r.measured.split()),
            ]
        )
    return stream.getvalue()


@lru_cache
def _script() -> dict[str, str]:
    """The page's only script, and its hash for the security policy."""
    text = (files("workflows") / "templates" / "batch.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return {"text": Markup(text), "hash": f"sha256-{digest}"}


@lru_cache
def _template() -> Template:
    source = (files("workflows") / "templates" / "batch.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["figure"] = _figure
    return environment.from_string(source)


def _figure(value: float) -> str:
    """Four digits, and whole numbers in full."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
