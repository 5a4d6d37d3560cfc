"""The command line `neuface`.

Exit codes: 0 done and the result is good or usable, 1 failed, 2 wrong usage, 3 the result is unusable (with --strict:
or only usable). Stopped with finished stages kept: 130 (Ctrl-C), 143 (SIGTERM), 129 (SIGHUP).
"""

if __name__ == "__main__":  # signals first: the imports take seconds
    from workflows.run.interrupt import from_the_start  # isort: skip

    from_the_start()

import pipeline.threads  # noqa: F401  isort: skip  (before anything that loads torch)

import argparse
import logging
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress

from pipeline.errors import Cancelled, NeufaceError, UsageError, stage_error_from_os_error
from workflows.batch import commands as batch_commands
from workflows.batch import schedule
from workflows.bench import commands as bench_commands
from workflows.cli import check, commands, settings
from workflows.cli.console import Console
from workflows.cli.options import add_request_options
from workflows.cli.parsing import Parser
from workflows.compare import command as compare
from workflows.run.interrupt import Interrupted, as_exceptions, code_of
from workflows.run.request import RunRequest
from workflows.store import commands as store_commands

EXAMPLES = """examples:
  neuface demo                                        a made-up head, start to end, checked against the truth
  neuface run photos/ --out runs/anna                 photos of a head -> asset and report
  neuface check photos/                               are they good enough? seconds, no fit
  neuface run photos/ --out runs/anna --preset draft --holdout every:5:2 --set bake.size=2048
  neuface render runs/anna --env studio.hdr --turntable 24 --out runs/anna/turntable
"""

JSON_HELP = "one JSON object per line on standard output: stages, progress, warnings, verdict"
ENV_HELP = "captured, key, overcast, sunset, or a lat-long .hdr or .exr"


def parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    p = Parser(
        prog="neuface",
        description="Photos of a head in, a relightable USD asset out.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--verbose", action="store_true", help="also show the log of the stages, and tracebacks")
    commands_of = p.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _run_options(commands_of.add_parser("run", help="one capture -> asset and report"))
    check.add_options(commands_of.add_parser("check", help="are these photos good enough? no fit, seconds"))
    demo = commands_of.add_parser("demo", help="the built-in demo capture -> asset, report, figures against the truth")
    demo.add_argument("--out", default="out/demo", metavar="DIR", help="folder for the results (%(default)s)")
    demo.add_argument("--views", type=_at_least(8), default=commands.DEMO_VIEWS, help="photos to render (%(default)s)")
    demo.add_argument("--size", type=_at_least(64), default=commands.DEMO_SIZE, help="pixels a side (%(default)s)")
    add_request_options(demo, RunRequest, only=("preset", "device", "store"))
    demo.add_argument("--json", action="store_true", help=JSON_HELP)
    demo.set_defaults(run=commands.demo_command)
    validate = commands_of.add_parser("validate", help="every check of an asset; exit code 1 on a fault")
    validate.add_argument("asset", metavar="ASSET.usd", help=".usd, .usda, .usdc or .usdz")
    validate.add_argument("--json", metavar="FILE", help="write every finding as JSON; - for standard output")
    validate.set_defaults(run=commands.validate_command)
    _render_options(commands_of.add_parser("render", help="render the exported asset: photos' views, or a turntable"))
    _turntable_options(commands_of.add_parser("turntable", help="a film of one turn around the exported asset"))
    _expressions_options(commands_of.add_parser("expressions", help="an OBJ for each expression of an asset"))
    for name, text, run in (
        ("report", "(re)build the report of a run", commands.report_command),
        ("view", "serve the report of a run to this machine's browser", commands.view_command),
    ):
        sub = commands_of.add_parser(name, help=text)
        sub.add_argument("folder", metavar="DIR", help="the --out of that run")
        sub.set_defaults(run=run)
    compare.add_options(commands_of.add_parser("compare", help="two runs side by side: figures, settings, views, maps"))
    bench_commands.add_commands(commands_of.add_parser("bench", help="measurements that repeat"))
    batch_commands.add_commands(commands_of)
    store_commands.add_commands(
        commands_of.add_parser("store", help="what finished stages take on disk: ls, gc, purge")
    )
    schedule.add_options(commands_of.add_parser("schedule", help="hours, cost and disk of a batch, on paper"))
    settings.add_options(commands_of.add_parser("settings", help="every setting: meaning, limits, presets"))
    doctor = commands_of.add_parser("doctor", help="is this machine ready?")
    doctor.add_argument("--out", default=".", metavar="DIR", help="where results would go (%(default)s)")
    doctor.set_defaults(run=commands.doctor_command)
    return p


def _run_options(run: argparse.ArgumentParser) -> None:
    add_request_options(run, RunRequest, without=("fit_slots",))
    run.add_argument("--author", help="who made the capture; recorded in the asset")
    run.add_argument("--license", help="licence of the capture; recorded in the asset")
    run.add_argument("--subject-consent", metavar="TEXT", help="what the subject agreed to; recorded in the asset")
    run.add_argument("--no-viewer", action="store_true", help="no 3D view in the report")
    run.add_argument("--dry-run", action="store_true", help="print the plan: what would run, and why; then stop")
    run.add_argument("--json", action="store_true", help=JSON_HELP)
    run.set_defaults(run=commands.run_command)


def _render_options(render: argparse.ArgumentParser) -> None:
    render.add_argument("folder", metavar="DIR", help="the --out of a run, or its asset folder")
    render.add_argument("--out", required=True, metavar="OUT", help="folder for the pictures")
    render.add_argument("--env", default="captured", help=f"{ENV_HELP} (%(default)s)")
    render.add_argument(
        "--light", action="append", metavar="X,Y,Z[,R,G,B]",
        help="by the reflectance field of a light stage: a lamp at this place, metres in the capture's world, of this "
        "radiant intensity (1,1,1); several add up",
    )  # fmt: skip
    render.add_argument("--field", action="store_true", help="by the reflectance field, also without --light")
    render.add_argument(
        "--deform", metavar="FILE", help="by the reflectance field on this mesh: its rest.obj with moved vertices"
    )
    render.add_argument("--quick", action="store_true", help="with --field and --env: fewer lamps for the environment")
    render.add_argument("--cameras", metavar="FILE", help="params.json of a capture; default: the captured cameras")
    render.add_argument("--views", metavar="LIST", help="indices such as 2,7; default: the held-out ones, else all")
    render.add_argument("--turntable", type=_at_least(1), metavar="N", help="N views around the head instead")
    render.add_argument("--width", type=_at_least(16), metavar="W", help="pixels; default: the camera's own")
    render.add_argument("--samples", type=int, choices=range(5), default=0, help="rays along a pixel's side")
    render.set_defaults(run=commands.render_command)


def _turntable_options(turntable: argparse.ArgumentParser) -> None:
    turntable.add_argument("folder", metavar="DIR", help="the --out of a run, or its asset folder")
    turntable.add_argument("--out", required=True, metavar="FILE", help="film.mp4 or film.webp")
    turntable.add_argument("--env", default="captured", help=f"{ENV_HELP} (%(default)s)")
    turntable.add_argument("--frames", type=_at_least(1), default=120, help="pictures of the turn (%(default)s)")
    turntable.add_argument("--size", type=_at_least(16), default=1080, help="pixels along each side (%(default)s)")
    turntable.set_defaults(run=commands.turntable_command)


def _expressions_options(expressions: argparse.ArgumentParser) -> None:
    expressions.add_argument("folder", metavar="DIR", help="the --out of a run, or its asset folder")
    expressions.add_argument("--out", required=True, metavar="OUT", help="folder for the files")
    expressions.add_argument("--only", action="append", metavar="NAME", help="this expression; may be repeated")
    expressions.set_defaults(run=commands.expressions_command)


def _unicode(options: argparse.Namespace) -> None:
    """Raises UsageError where a path or a text is not UTF-8: no manifest, USD file or page could name it."""
    flags = {"out": "--out", "store": "--store", "name": "--name", "config": "--config", "sets": "--set"}
    for option, value in vars(options).items():
        for text in value if isinstance(value, list) else [value]:
            if isinstance(text, str) and text != text.encode("utf-8", "replace").decode():
                raise UsageError(
                    "a name is not UTF-8",
                    where=flags.get(option, option),
                    value=ascii(text),
                    limit="text and paths in UTF-8",
                    remedy="rename the file or folder, or write the text in UTF-8",
                )


class _at_least:  # noqa: N801  (used like a function)
    """An integer with a lower limit, as argparse wants it."""

    def __init__(self, limit: int) -> None:
        self.limit = limit

    def __call__(self, text: str) -> int:
        if not text.isdecimal() or int(text) < self.limit:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {self.limit}")
        return int(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; errors that a user can meet are printed without a traceback."""
    options = parser().parse_args(arguments)
    level = logging.INFO if options.verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(name)s: %(message)s", stream=sys.stderr)
    console = Console()
    try:
        _unicode(options)
        with as_exceptions() as caught:
            code: int = options.run(options, console)
            sys.stdout.flush()
        if caught.number is not None:  # and a library caught the exception
            raise Interrupted(caught.number)
    except Interrupted as e:
        code = code_of(e.number)
        with suppress(OSError):
            console.close()
            console.result("stopped", exit_code=code)
            print("stopped", file=sys.stderr)
    except BrokenPipeError:  # whoever read stdout is gone, as in `neuface settings | head`
        code = code_of(signal.SIGPIPE)
        with suppress(OSError):  # what is still unwritten goes nowhere, without a word at the exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as e:
        console.close()
        known = (
            e if isinstance(e, NeufaceError) else stage_error_from_os_error(e, "") if isinstance(e, OSError) else None
        )
        if known is None or options.verbose:
            raise
        code = known.exit_code
        console.result("stopped" if isinstance(known, Cancelled) else "error", text=str(known), exit_code=code)
        with suppress(OSError):  # the terminal may be gone
            print(f"error: {known}", file=sys.stderr)
    return code
