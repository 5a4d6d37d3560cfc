"""The last words of a run: figures, where the results are, how to look at them, and the verdict."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.store import read_object
from workflows.cli.console import Console
from workflows.run.verdict import exit_code, last_lines

METRICS = "report/metrics.json"
PAGE = "report/index.html"


def tell(record: Mapping[str, Any], out: Path, console: Console, truth: Sequence[str] = ()) -> None:
    """Print the summary of a run on stdout, or tell it as an event. truth: lines on the demo's ground truth.

    record: what run.json of the folder `out` holds.
    """
    console.close()
    if console.events is not None:
        console.result("verdict", **_for_programs(record, out), truth=list(truth))
        return
    for line in summary(record, out, truth):
        print(line)
    sys.stdout.flush()


def summary(record: Mapping[str, Any], out: Path, truth: Sequence[str] = ()) -> list[str]:
    """Lines; the last ones are the verdict and its reasons."""
    lines = [f"{name:7}{path}" for name, path in paths(record, out).items()]
    reused = sum(s["reused"] for s in record["stages"].values())
    lines[-1] += f" ({len(record['stages'])} stages, {reused} reused)"
    if PAGE in _published(record, out):
        lines.append(f"look at it: neuface view {out}")
    if truth:
        lines += ["against the demo's ground truth:", *(f"  {line}" for line in truth)]
    found = figures(record, out)
    return [*lines, *([found] if found else []), *last_lines(record)]


def paths(record: Mapping[str, Any], out: Path) -> dict[str, Path]:
    """Where the asset, the report and the record of the run are; what was not made is left out."""
    found = {"asset": out / record["asset"]} if "asset" in record else {}
    if "pack" in record:
        found["zip"] = out / record["pack"]
    if PAGE in _published(record, out):
        found["report"] = out / PAGE
    return {**found, "run": out / "run.json"}


def held_out(record: Mapping[str, Any], out: Path) -> dict[str, Any]:
    """`holdout` of the report's figures: views, held_out, psnr (dB, of the model), asset_psnr. Empty without a report.

    The views are fitted ones where no view was held out; `held_out` says so.
    """
    if METRICS not in _published(record, out):
        return {}
    content = read_object(out / METRICS).get("holdout")
    return content if isinstance(content, dict) else {}


def figures(record: Mapping[str, Any], out: Path) -> str:
    """The line with the main figures; empty where there are none."""
    found = held_out(record, out)
    named = (("model", found.get("psnr")), ("exported asset", found.get("asset_psnr")))
    parts = [f"{what} {value:.1f} dB" for what, value in named if isinstance(value, int | float)]
    if not parts:
        return ""
    kind = "held-out" if found.get("held_out") else "fitted"
    return f"PSNR of {found.get('views')} {kind} views: {', '.join(parts)}"


def _for_programs(record: Mapping[str, Any], out: Path) -> dict[str, Any]:
    verdict, found = record.get("verdict", {}), held_out(record, out)
    kept = ("views", "held_out", "psnr", "asset_psnr")
    return {
        "level": verdict.get("level"),
        "findings": verdict.get("findings", []),
        "exit_code": exit_code(record),
        "figures": {name: found[name] for name in kept if name in found},
        **{name: str(path) for name, path in paths(record, out).items()},
    }


def _published(record: Mapping[str, Any], out: Path) -> set[str]:
    """Which of the report's files this run published."""
    return {p for p in (METRICS, PAGE) if "report" in record["stages"] and (out / p).is_file()}
