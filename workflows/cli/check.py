"""`neuface check CAPTURE`: are these photos good enough? The stages before the fit, without it; for use on set.

Photos that came with cameras are judged with their cameras and masks. Photos without are judged by themselves, which
takes seconds; `--solve` solves cameras and masks too, which takes minutes.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pipeline.contract import Done
from pipeline.errors import StageError
from pipeline.verdict import Finding, Verdict
from workflows.cli.console import Console
from workflows.cli.options import add_request_options
from workflows.run import output_dirs
from workflows.run.early import early_stages
from workflows.run.interrupt import interruptible
from workflows.run.plan import make_plan
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages
from workflows.run.session import Session
from workflows.run.verdict import REFUSED, headline, verdict_of_done

NEXT = {
    "good": "go on: neuface run {capture} --out DIR",
    "usable": "it can be used as it is (neuface run {capture} --out DIR); the remedies above make it better",
    "unusable": "apply the remedies above first; with these photos neuface run ends before the fit, unless --force",
}
NOT_SOLVED = "only the photos were judged: cameras and masks are not known yet; --solve finds and judges them (minutes)"


def add_options(check: argparse.ArgumentParser) -> None:
    """Its options."""
    check.add_argument("capture", metavar="CAPTURE", help="as for neuface run")
    check.add_argument("--solve", action="store_true", help="photos without cameras: solve and judge them; minutes")
    check.add_argument("--json", metavar="FILE", help="write the verdict and every finding; - for standard output")
    check.add_argument("--store", metavar="DIR", help="keep what is found for neuface run --store DIR; none by default")
    add_request_options(check, RunRequest, only=("preset", "sets"))
    check.set_defaults(run=check_command)


def check_command(options: argparse.Namespace, console: Console) -> int:
    """neuface check. Exit code 3 if the photos, their cameras or masks are unusable, 1 if they can't be judged."""
    if options.json not in (None, "-"):
        output_dirs.check_file(Path(options.json), "--json")
    done: list[Done[Any]] = []
    fault: StageError | None = None
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="neuface-check-")))
        store = Path(options.store).absolute() if options.store else scratch / ".store"
        stack.enter_context(output_dirs.writable(scratch, store))
        watch = Session(console)
        stack.enter_context(interruptible(watch.stop, console.note))
        for until in _untils(early_stages()):
            if until is None:
                break
            request = RunRequest(
                capture=options.capture,
                out=str(scratch),
                store=str(store),
                until=until,
                preset=options.preset,
                sets=tuple(options.sets),
                force=True,
            )
            try:
                done = run_stages(make_plan(request), watch)
            except StageError as e:
                if not done:
                    raise
                fault = e
                break
            if not (options.solve or _has_cameras(done)):
                break
    console.close()
    verdict, solved = verdict_of_done(done), len(done) > 1 or fault is not None
    if options.json != "-":
        print("\n".join(table(verdict)))
    if fault is None:
        _write_json(options.json, verdict, solved, None)
        if options.json != "-":
            print("\n".join(last_words(verdict, options.capture, solved)))
        return REFUSED if verdict.level == "unusable" else 0
    _write_json(options.json, verdict, solved, fault)
    raise fault


def _untils(early: Sequence[str]) -> list[str | None]:
    """First only the photos; then, where it makes sense, all stages before the fit."""
    return [early[0], *([early[-1]] if len(early) > 1 else [])] if early else [None]


def _has_cameras(done: Sequence[Done[Any]]) -> bool:
    views = getattr(done[0].located.artifact, "views", ())
    return any(getattr(v, "camera", None) is not None for v in views)


def table(verdict: Verdict) -> list[str]:
    """Lines: each check with its level, figure and limit; below those that are not good, what to do."""
    rows = [(stage, f) for stage, f in verdict.in_order()]
    if not rows:
        return ["nothing was judged"]
    cells = [("stage", "check", "level", "found", "good")]
    cells += [(stage, f.check.replace("_", " "), f.level, figure(f), f.limit) for stage, f in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(4)]
    lines = ["  ".join([*(c.ljust(w) for c, w in zip(row, widths, strict=False)), row[4]]).rstrip() for row in cells]
    out = [lines[0]]
    for line, (_, finding) in zip(lines[1:], rows, strict=True):
        out.append(line)
        if finding.level != "good":
            out.append(f"    {finding.sentence}")
    return out


def figure(finding: Finding) -> str:
    """The measured value with its unit."""
    value = "not known" if finding.value is None else f"{finding.value:.4g}"
    return f"{value} {finding.unit}".strip()


def last_words(verdict: Verdict, capture: str, solved: bool) -> list[str]:
    """The verdict and what to do next: the last line."""
    what_next = NEXT[verdict.level].format(capture=capture)
    lines = [] if solved else [NOT_SOLVED]
    return [*lines, f"{headline(verdict.level, verdict.stages)}. Next: {what_next}"]


def _write_json(target: str | None, verdict: Verdict, solved: bool, fault: StageError | None) -> None:
    if target is None:
        return
    content = {**verdict.record(every=True), "solved": solved, "error": None if fault is None else str(fault)}
    text = json.dumps(content, indent=1)
    if target == "-":
        print(text)
    else:
        Path(target).write_text(text + "\n")
