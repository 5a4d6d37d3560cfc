"""`neuface batch` and `neuface serve`."""

from __future__ import annotations

import argparse
import os
import re
import threading
from pathlib import Path
from typing import Any

from pipeline.errors import Cancelled
from stages.presets import DEFAULT_PRESET
from workflows.batch.request import DEPLOYMENT, PRIORITIES, BatchRequest
from workflows.cli.console import Console
from workflows.run.verdict import REFUSED
from workflows.server import environment

UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


def seconds(text: str) -> float:
    """ "90s", "30m", "2h", "7d" or a plain number of seconds."""
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,6})?)([smhd]?)", text.strip())
    if match is None or float(match[1]) <= 0:
        raise ValueError(f"{text!r} is no time: a number above 0 and s, m, h or d, such as 90s or 2h")
    return float(match[1]) * UNITS[match[2] or "s"]


def a_time(text: str) -> float:
    """As argparse wants it."""
    try:
        return seconds(text)
    except ValueError as e:
        raise argparse.ArgumentTypeError(str(e)) from e


def add_commands(commands_of: Any) -> None:
    """Their options."""
    batch = commands_of.add_parser("batch", help="many captures, each a run of its own; goes on after anything")
    batch.add_argument("root", metavar="ROOT", help="FaceScape tree ID/EXPRESSION/params.json, or a .csv or .json list")
    batch.add_argument("--out", required=True, metavar="DIR", help="folder for the results; DIR/batch/index.html")
    batch.add_argument("--subjects", metavar="LIST", help="only these: 1-40 or 1,7,20-29")
    batch.add_argument("--expressions", metavar="LIST", help="only these numbers: 1,2")
    batch.add_argument("--preset", default=DEFAULT_PRESET, help="draft, studio, film; or paper (%(default)s)")
    batch.add_argument("--holdout", metavar="RULE", help="views kept from the fit, as in neuface run")
    batch.add_argument("--seed", type=int, default=0, help="of every random draw (%(default)s)")
    batch.add_argument("--until", metavar="S", help="stop after this stage")
    batch.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE", help="one setting; repeatable")
    batch.add_argument("--config", metavar="FILE", help="settings from a .toml or .json file")
    batch.add_argument("--device", default="auto", help="auto, cpu or cuda (%(default)s)")
    batch.add_argument(
        "--store", metavar="DIR", default=os.environ.get("NEUFACE_STORE"), help="finished stages (DIR/.store)"
    )
    batch.add_argument("--stage-limit", type=a_time, default="6h", metavar="TIME", help="for one stage (%(default)s)")
    batch.add_argument("--attempts", type=int, default=3, help="tries where the fault may pass (%(default)s)")
    batch.add_argument("--workers", type=int, default=1, metavar="N", help="captures at a time here (%(default)s)")
    add_verdict_options(batch)
    server = batch.add_argument_group("on a Prefect server with a pool of workers")
    server.add_argument("--server", action="store_true", help="submit a run for each capture to $PREFECT_API_URL")
    server.add_argument("--deployment", default=DEPLOYMENT, metavar="F/N", help="of one capture (%(default)s)")
    server.add_argument("--chunk", type=int, default=50, help="unfinished runs on the server at a time (%(default)s)")
    server.add_argument("--priority", choices=PRIORITIES, help="work queue of the pool")
    server.add_argument("--gpus", type=int, metavar="N", help="fits at a time in the whole pool")
    server.add_argument("--lost-after", type=a_time, default="60s", metavar="TIME", help="a dead run (%(default)s)")
    batch.set_defaults(run=batch_command)
    serve = commands_of.add_parser("serve", help="a server and this machine as its worker, without a pool")
    serve.add_argument("--host", default="127.0.0.1", help="address of the server's page (%(default)s: this machine)")
    serve.add_argument("--port", type=int, default=4200, help="(%(default)s)")
    serve.add_argument("--limit", type=int, default=1, metavar="N", help="captures at a time (%(default)s)")
    serve.add_argument("--home", default="~/.neuface", metavar="DIR", help="the server's records (%(default)s)")
    serve.add_argument(
        "--root",
        action="append",
        default=[],
        metavar="DIR",
        help="folder that runs may read and write; repeatable ($NEUFACE_ROOTS, else the current folder)",
    )
    serve.set_defaults(run=serve_command)


def add_verdict_options(command: argparse.ArgumentParser) -> None:
    """--force and --strict, of a run and of a batch."""
    command.add_argument("--force", action="store_true", help="go on to the fit although what comes first is unusable")
    command.add_argument("--strict", action="store_true", help="exit code 3 for a result that is only usable, too")


def batch_command(options: argparse.Namespace, console: Console) -> int:
    """neuface batch. Exit code 1 if a capture failed, else 3 if a result is unusable (with --strict: only usable)."""
    from workflows.batch.loop import run_batch

    request = request_from(options)
    stop = threading.Event()
    try:
        if options.server:
            environment.defaults()
            from workflows.batch.pool import Pool
            from workflows.run.interrupt import interruptible

            with interruptible(stop, console.note):
                summary = run_batch(request, Pool(request), stopped=stop.is_set, notify=console.note)
        else:
            from workflows.batch.local import Processes
            from workflows.run.interrupt import interruptible

            runner = Processes(request, slots=max(1, options.workers))
            with interruptible(stop, console.note, runner.kill):
                summary = run_batch(request, runner, stopped=stop.is_set, notify=console.note)
    except Cancelled:
        console.note("stopped; the same command goes on where this one left off")
        raise
    for state, count in summary.counts().items():
        print(f"{state:10} {count}")
    if summary.held is not None:
        print(f"stopped early: {summary.held.message}")
    print(f"page       {request.folder / 'index.html'}")
    return 1 if summary.failed else REFUSED if summary.refused(request.strict) else 0


def request_from(options: argparse.Namespace) -> BatchRequest:
    """The request that the options make.

    Raises:
        UsageError: a value outside its limits.
    """
    from pydantic import ValidationError

    from pipeline.errors import UsageError
    from stages.presets import read_config_file

    given = {n: getattr(options, n) for n in BatchRequest.model_fields if hasattr(options, n)}
    given["config"] = read_config_file(Path(options.config)) if options.config else {}
    try:
        return BatchRequest(**given, sets=tuple(options.set))
    except ValidationError as e:
        first = e.errors()[0]
        name = str(first["loc"][0])
        raise UsageError(
            "an option is outside its limits",
            where=f"--{name.replace('_', '-')}",
            value=repr(first["input"]),
            limit=first["msg"],
            remedy=f"change it: {BatchRequest.model_fields[name].description}",
        ) from e


def serve_command(options: argparse.Namespace, console: Console) -> int:
    """neuface serve"""
    from workflows.server.deployments import serve

    home = Path(options.home).expanduser()
    return serve(options.host, options.port, options.limit, home, console.note, options.root)
