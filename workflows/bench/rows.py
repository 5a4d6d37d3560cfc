"""What the benches that fit a capture row after row share: options, which rows, and what an earlier run left."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from pipeline.errors import UsageError
from stages.presets import DEFAULT_PRESET
from workflows.run.plan import Plan, make_plan
from workflows.run.request import RunRequest


class Named(Protocol):
    """A row."""

    @property
    def name(self) -> str: ...


N = TypeVar("N", bound=Named)
R = TypeVar("R")


def shared_options(sub: argparse.ArgumentParser, steps: int, what: str) -> None:
    """The command line's options that mean the same in each. what: whose budget it is."""
    sub.add_argument("--store", metavar="DIR", help="folder of finished stages (OUT/.store)")
    sub.add_argument("--holdout", default="every:5:2", metavar="RULE", help="as in neuface run (%(default)s)")
    sub.add_argument("--steps", type=int, default=steps, help=f"of {what} (%(default)s)")
    sub.add_argument("--side", type=int, default=256, help="pixels of the photos' longest side (%(default)s)")
    sub.add_argument("--batch", type=int, default=2048, help="rays a step (%(default)s)")
    sub.add_argument("--device", default="cpu", help="auto, cpu or cuda (%(default)s)")


def rows_with(text: str, rows: Sequence[N], option: str, what: str) -> list[N]:
    """Rows with a text in their name. Raises UsageError if there is none."""
    chosen = [r for r in rows if text in r.name]
    if not chosen:
        raise UsageError(
            f"no {what} has this text in its name",
            where=option,
            value=text,
            limit="a part of one of: " + "; ".join(r.name for r in rows),
            remedy=f"leave {option} out for all",
        )
    return chosen


def plan_of(given: argparse.Namespace, sets: Sequence[str], preset: str = DEFAULT_PRESET) -> Plan:
    """A row's run, up to the surface."""
    return make_plan(
        RunRequest(
            capture=given.capture,
            out=given.out,
            store=given.store,
            holdout=given.holdout,
            device=given.device,
            until="surface",
            sets=tuple(sets),
            preset=preset,
        )
    )


def budget_of(given: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """What all rows have to share to be compared."""
    return {**{n: getattr(given, n) for n in names}, "capture": Path(given.capture).name}


def kept(path: Path, budget: dict[str, Any], key: str, make: Callable[..., R]) -> tuple[dict[str, R], dict[str, Any]]:
    """Rows under `key` that an earlier bench at the same budget left, and all of its file; nothing if the budget was
    another, or the file can't be read."""
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        return ({k: make(**v) for k, v in found[key].items()}, found) if found["budget"] == budget else ({}, {})
    except (OSError, ValueError, KeyError, TypeError):
        return {}, {}
