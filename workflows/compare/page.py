"""The comparison as one HTML page, as lines of text, and as JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from typing import Any, TypeVar

from jinja2 import Environment, StrictUndefined, Template

from pipeline.errors import NeufaceError
from workflows.compare import figures, maps, surface, views
from workflows.compare.figures import Changed, Difference
from workflows.compare.pictures import Row, signed_bar
from workflows.compare.runs import Side, about_captures, common_photos

T = TypeVar("T")
U = TypeVar("U")
MARKS = {"better": "▲ better", "worse": "▼ worse", "within noise": "= within noise", "not judged": ""}


@dataclass(slots=True)
class Comparison:
    """Everything that is shown. notes: what is not, and why."""

    a: Side
    b: Side
    differences: list[Difference] = field(default_factory=list)
    checks: list[Changed] = field(default_factory=list)
    settings: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    views: list[Row] = field(default_factory=list)
    maps: list[Row] = field(default_factory=list)
    sides: list[Row] = field(default_factory=list)
    placed: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def compare(a: Side, b: Side) -> Comparison:
    """Compare two runs. A part that can't be read is left out with a note, and the others are made."""
    out = Comparison(a, b, notes=[*a.notes, *b.notes, *about_captures(a, b)])
    out.differences = _part(out, "the figures", lambda: figures.differences(a, b), [])
    out.checks = _part(out, "the checks", lambda: figures.changed_checks(a, b), [])
    out.settings = _part(out, "the settings", lambda: figures.different_settings(a, b), {})
    out.views = _part(out, "the views", lambda: list(views.rows(a, b)), [])
    common = bool(common_photos(a, b))
    match: surface.Matched | str = _part(
        out, "the surfaces' match", lambda: surface.matched(a, b) if common else "", ""
    )
    if not isinstance(match, str):
        out.placed = {"scale of B over A, by the cameras": match.scale, "cameras apart (mm, RMS)": 1000 * match.off}
    elif match:
        out.notes.append(match)
    out.maps = _part(out, "the maps", lambda: list(maps.rows(a, b, match)), [])
    out.sides = _part(out, "the previews", lambda: views.sides(a, b), [])
    if not out.views and common:
        out.notes.append("no photo was rendered in both runs, so that no view is shown (--holdout, usd.render_views)")
    return out


def _part(out: Comparison, what: str, make: Callable[[], T | U], nothing: U) -> T | U:
    """What `make` gives; if a file that it reads is damaged or of another shape, nothing and a note."""
    try:
        return make()
    except (NeufaceError, OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, RuntimeError) as e:
        out.notes.append(f"{what} can't be shown: {type(e).__name__}: {str(e).splitlines()[0] if str(e) else ''}")
        return nothing


def html(found: Comparison) -> str:
    """The page; it loads nothing and runs no script."""
    from stages.report.pictures import ERROR_RANGE, data_uri, scale_bar, scale_colours

    bars = {
        "error": data_uri(scale_bar(), 256, lossless=True),
        "signed": data_uri(signed_bar(), 256, lossless=True),
        "value": data_uri(scale_colours()[None].repeat(10, 0), 256, lossless=True),
    }
    return _template().render(
        c=found,
        levels=[figures.level(s) for s in (found.a, found.b)],
        reasons=[figures.reasons(s) for s in (found.a, found.b)],
        kind=views.kind_of(found.a, found.b),
        bars=bars,
        error_top=ERROR_RANGE,
        nearer=views.NEARER,
        marks=MARKS,
    )


def lines(found: Comparison) -> Iterable[str]:
    """For the terminal: what got better, what worse, what was set otherwise."""
    for side in (found.a, found.b):
        yield f"{side.name}  {side.out}: {figures.level(side)}"
    counts = {said: [d for d in found.differences if d.said == said] for said in figures.SAID}
    for said in ("worse", "better"):
        yield from (f"{said}: {d.title} {d.a} -> {d.b} ({d.change})" for d in counts[said])
    yield f"{len(counts['within noise'])} figures within noise, {len(counts['not judged'])} not judged"
    for c in found.checks:
        said = "better" if c.step > 0 else "worse" if c.step < 0 else "changed"
        yield f"{said}: check {c.stage} {c.check} {c.a} -> {c.b}"
    for name, (x, y) in found.settings.items():
        yield f"setting: {name} {_short(x)} -> {_short(y)}"
    yield from (f"note: {n}" for n in found.notes)


def as_json(found: Comparison) -> dict[str, Any]:
    """For programs."""
    return {
        "runs": {s.name: {"out": str(s.out), "verdict": figures.level(s)} for s in (found.a, found.b)},
        "figures": figures.as_tables(found.differences),
        "checks": figures.as_tables(found.checks),
        "settings": {n: {"A": x, "B": y} for n, (x, y) in found.settings.items()},
        "views": [r.title for r in found.views],
        "maps": {r.title: r.note for r in found.maps},
        "placed": found.placed,
        "notes": found.notes,
    }


def _short(value: object) -> str:
    text = "-" if value is None else " ".join(map(str, value)) if isinstance(value, list) else str(value)
    text = text or "none"
    return text if len(text) <= 80 else f"{text[:77]}..."


@lru_cache
def _template() -> Template:
    source = (files("workflows") / "templates" / "compare.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["words"] = lambda text: str(text).replace("_", " ")
    environment.filters["short"] = _short
    environment.filters["sentence"] = lambda text: f"{text.rstrip('.')}." if text else ""
    return environment.from_string(source)
