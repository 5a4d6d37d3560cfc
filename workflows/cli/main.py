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
import traceback
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module

from pipeline.errors import Cancelled, NeufaceError, UsageError, stage_error_from_os_error
from workflows.cli.parsing import Parser
from workflows.run.interrupt import Interrupted, as_exceptions, code_of

EXAMPLES = """examples:
  neuface demo                                        a made-up head, start to end, checked against the truth
  neuface run photos/ --out runs/anna                 photos of a head -> asset and report
  neuface check photos/                               are they good enough? seconds, no fit
  neuface run photos/ --out runs/anna --preset draft --holdout every:5:2 --set bake.size=2048
  neuface render runs/anna --env studio.hdr --turntable 24 --out runs/anna/turntable
"""

# Every command: its help, and the module and function that add its options. Loaded when the command is asked for, so
# that `neuface --help` does not load what the commands work with.
COMMANDS: dict[str, tuple[str, str, str]] = {
    "run": ("one capture -> asset and report", "workflows.cli.command_options", "run_options"),
    "check": ("are these photos good enough? no fit, seconds", "workflows.cli.check", "add_options"),
    "demo": (
        "the built-in demo capture -> asset, report, figures against the truth",
        "workflows.cli.command_options",
        "demo_options",
    ),
    "validate": (
        "every check of an asset; exit code 1 on a fault",
        "workflows.cli.command_options",
        "validate_options",
    ),
    "render": (
        "render the exported asset: photos' views, or a turntable",
        "workflows.cli.command_options",
        "render_options",
    ),
    "turntable": (
        "a film of one turn around the exported asset",
        "workflows.cli.command_options",
        "turntable_options",
    ),
    "expressions": (
        "an OBJ for each expression of an asset",
        "workflows.cli.command_options",
        "expressions_options",
    ),
    "compare": ("two runs side by side: figures, settings, views, maps", "workflows.compare.command", "add_options"),
    "report": ("(re)build the report of a run", "workflows.cli.command_options", "report_options"),
    "view": (
        "show a run in this machine's browser, also while it goes on",
        "workflows.cli.command_options",
        "view_options",
    ),
    "bench": ("measurements that repeat", "workflows.bench.commands", "add_commands"),
    "batch": (
        "many captures, each a run of its own; run it again to resume",
        "workflows.batch.commands",
        "batch_options",
    ),
    "serve": ("a server and this machine as its worker, without a pool", "workflows.batch.commands", "serve_options"),
    "store": ("what finished stages take on disk: ls, gc, purge", "workflows.store.commands", "add_commands"),
    "schedule": ("hours, cost and disk of a batch, on paper", "workflows.batch.schedule", "add_options"),
    "settings": ("every setting: meaning, limits, presets", "workflows.cli.settings", "add_options"),
    "doctor": ("is this machine ready?", "workflows.cli.command_options", "doctor_options"),
}


def parser() -> argparse.ArgumentParser:
    """All commands. A command's own options are added when it is the one that is parsed."""
    p = Parser(
        prog="neuface",
        description="Photos of a head in, a relightable USD asset out.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--verbose", action="store_true", help="also show the log of the stages, and tracebacks")
    commands_of = p.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (text, module, function) in COMMANDS.items():
        commands_of.add_parser(name, help=text).fill = partial(_add_options, module, function)
    return p


def _add_options(module: str, function: str, command: argparse.ArgumentParser) -> None:
    getattr(import_module(module), function)(command)


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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; errors that a user can meet are printed without a traceback."""
    options = parser().parse_args(arguments)
    from workflows.cli.console import Console

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
        if known is None:
            raise
        if options.verbose:
            with suppress(OSError):  # as below
                traceback.print_exception(e)
        code = known.exit_code
        console.result("stopped" if isinstance(known, Cancelled) else "error", text=str(known), exit_code=code)
        with suppress(OSError):  # the terminal may be gone
            print(f"error: {known}", file=sys.stderr)
    return code
