"""`neuface batch` and `neuface serve`."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path

from pipeline.errors import Cancelled, UsageError
from workflows.batch.request import BatchRequest
from workflows.cli.console import Console
from workflows.cli.numbers import whole
from workflows.cli.options import a_time, add_request_options, request_from
from workflows.run.verdict import REFUSED
from workflows.server import environment

ON_A_SERVER = ("deployment", "chunk", "priority", "gpus", "lost_after")


def batch_options(batch: argparse.ArgumentParser) -> None:
    """Those of neuface batch."""
    add_request_options(batch, BatchRequest, without=ON_A_SERVER)
    batch.add_argument("--workers", type=whole(1), default=1, metavar="N", help="captures at a time here (%(default)s)")
    batch.add_argument("--dry-run", action="store_true", help="say what would run, and run nothing")
    server = batch.add_argument_group("on a Prefect server with a pool of workers")
    server.add_argument("--server", action="store_true", help="submit a run for each capture to $PREFECT_API_URL")
    add_request_options(server, BatchRequest, only=ON_A_SERVER)
    batch.set_defaults(run=batch_command)


def serve_options(serve: argparse.ArgumentParser) -> None:
    """Those of neuface serve."""
    serve.add_argument("--host", default="127.0.0.1", help="address of the server's page (%(default)s: this machine)")
    serve.add_argument("--port", type=whole(1, 65535), default=4200, help="(%(default)s)")
    serve.add_argument("--limit", type=whole(1), default=1, metavar="N", help="captures at a time (%(default)s)")
    serve.add_argument("--home", default="~/.neuface", metavar="DIR", help="the server's records (%(default)s)")
    serve.add_argument(
        "--root",
        action="append",
        default=[],
        metavar="DIR",
        help="folder that runs may read and write; repeatable ($NEUFACE_ROOTS, else the current folder)",
    )
    serve.add_argument("--server-only", action="store_true", help="the server alone, for the workers of a pool")
    serve.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="further host name or address by which the server may be called; repeatable, the first is its page's",
    )
    serve.add_argument(
        "--lost-after",
        type=a_time,
        default=60.0,
        metavar="TIME",
        help="time without a sign of life after which a run is marked as crashed (60s; at least 30s)",
    )
    serve.set_defaults(run=serve_command)


def batch_command(options: argparse.Namespace, console: Console) -> int:
    """neuface batch. Exit code 1 if a capture failed, else 3 if a result is unusable (with --strict: only usable)."""
    from workflows.batch.loop import run_batch

    request = request_from(options, BatchRequest)
    if options.dry_run:
        from workflows.batch.preview import preview

        print("\n".join(preview(request)))
        return 0
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

            runner = Processes(request, slots=options.workers)
            with interruptible(stop, console.note, runner.kill):
                summary = run_batch(request, runner, stopped=stop.is_set, notify=console.note)
    except Cancelled:
        console.note("stopped; run the same command again to resume")
        raise
    for state, count in summary.counts().items():
        print(f"{state:10} {count}")
    if summary.held is not None:
        print(f"stopped early: {summary.held.message}")
    print(f"page       {request.folder / 'index.html'}")
    return 1 if summary.failed else REFUSED if summary.refused(request.strict) else 0


def serve_command(options: argparse.Namespace, console: Console) -> int:
    """neuface serve"""
    from workflows.server.deployments import Address, serve, serve_alone
    from workflows.server.life import BEAT

    if options.lost_after < 3 * BEAT:
        raise UsageError(
            "runs would be lost while they live",
            where="--lost-after",
            value=f"{options.lost_after:g} s",
            limit=f"at least {3 * BEAT:.0f} s: a run gives a sign of life every {BEAT:.0f} s",
            remedy="give it more time",
        )
    home = Path(options.home).expanduser()
    address = Address(options.host, options.port, home, tuple(options.allow_host), options.lost_after)
    if options.server_only:
        return serve_alone(address, console.note)
    return serve(address, options.limit, console.note, options.root)
