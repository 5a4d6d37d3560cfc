"""What got better and what worse since a stored table of captures."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.verdict import LEVELS
from workflows.bench.captures_table import FIGURES, Figure, Row, ending


def compare(old: Mapping[str, Row], new: Mapping[str, Row]) -> list[str]:
    """Lines for people: changes beyond the figures' tolerances, capture by capture."""
    lines: list[str] = []
    for name in new:
        if name not in old:
            lines.append(f"{name}: new, {ending(new[name])}")
            continue
        changes = [*_ended(old[name], new[name]), *(c for f in FIGURES if (c := _change(f, old[name], new[name])))]
        lines += [f"{name}: {change}" for change in changes]
    lines += [f"{name}: not in this table" for name in old if name not in new]
    both = sum(n in old for n in new)
    return [f"{both} captures compared; changes within the tolerances are not shown", *(lines or ["no change"])]


def _ended(old: Row, new: Row) -> list[str]:
    """Changes of how the run ended and of its verdict."""
    out = []
    before, after = ending(old), ending(new)
    if before != after:
        out.append(f"exit {before} -> {after}{_said(_rank_of_ending(old) - _rank_of_ending(new))}")
    levels = [r["verdict"]["level"] for r in (old, new)]
    if levels[0] != levels[1]:
        ranks = [LEVELS.index(x) if x in LEVELS else None for x in levels]
        step = 0 if ranks[0] is None or ranks[1] is None else ranks[0] - ranks[1]
        out.append(f"verdict {levels[0]} -> {levels[1]}{_said(step)}")
    return out


def _rank_of_ending(row: Row) -> int:
    return {0: 0, 3: 1}.get(row["ended"]["exit_code"], 2)


def _change(figure: Figure, old: Row, new: Row) -> str | None:
    """ "asset (dB) 20.00 -> 21.00 (+1.00), better", or None within the tolerance."""
    before, after = (r.get("figures", {}).get(figure.name) for r in (old, new))
    title = f"{figure.name} [{figure.title}]"
    if before is None or after is None:
        if before is after:
            return None
        known = figure.form.format(figure.scale * (after if before is None else before))
        return (
            f"{title} not measured before, {known} now" if before is None else f"{title} was {known}, not measured now"
        )
    if _within(figure, before, after):
        return None
    a, b = figure.scale * before, figure.scale * after
    difference = ("+" if b > a else "-") + figure.form.format(abs(b - a))
    return f"{title} {figure.form.format(a)} -> {figure.form.format(b)} ({difference}){_said(figure.better * (b - a))}"


def step_of(figure: Figure, before: float, after: float) -> float:
    """By how much a figure got better, or worse (below 0); 0 within its tolerance."""
    return 0.0 if _within(figure, before, after) else figure.better * (after - before)


def _within(figure: Figure, before: float, after: float) -> bool:
    return abs(after - before) <= max(figure.absolute, figure.relative * abs(before))


def _said(step: float) -> str:
    return "" if step == 0 else ", better" if step > 0 else ", worse"
