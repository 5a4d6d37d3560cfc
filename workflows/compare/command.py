"""The command `neuface compare`: its options, and what it writes."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from workflows.cli.console import Console
from workflows.run.owned import write_owned

PAGE, FIGURES = "index.html", "compare.json"


def add_options(sub: argparse.ArgumentParser) -> None:
    """The options of the command."""
    sub.add_argument("a", metavar="A", help="the --out of a run")
    sub.add_argument("b", metavar="B", help="the --out of the run that is compared with it")
    sub.add_argument("--out", default="compare", metavar="DIR", help=f"folder for {PAGE} and {FIGURES} (%(default)s)")
    sub.add_argument("--json", action="store_true", help="print what compare.json holds instead of lines")
    sub.set_defaults(run=run)


def run(options: argparse.Namespace, console: Console) -> int:
    """neuface compare"""
    from workflows.compare.page import as_json, compare, html, lines
    from workflows.compare.runs import read_sides

    a, b = read_sides(Path(options.a), Path(options.b))
    found = compare(a, b)
    out, content = Path(options.out), json.dumps(as_json(found), indent=1)
    for name, text in ((PAGE, html(found)), (FIGURES, content + "\n")):
        aside = write_owned(out, name, text)
        if aside is not None:
            console.note(f"{out / name} is yours: kept as {out / aside}")
    print(content if options.json else "\n".join([*lines(found), f"page: {out / PAGE}"]))
    return 0
