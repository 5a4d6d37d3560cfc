"""Options of the commands in commands.py. Loaded for the command that was asked for, and for no other."""

from __future__ import annotations

import argparse

from workflows.cli import commands
from workflows.cli.numbers import whole
from workflows.cli.options import add_request_options
from workflows.run.request import RunRequest

JSON_HELP = "one JSON object per line on standard output: stages, progress, warnings, verdict"
ENV_HELP = "captured, key, overcast, sunset, or a lat-long .hdr or .exr"


def run_options(run: argparse.ArgumentParser) -> None:
    """neuface run"""
    add_request_options(run, RunRequest, without=("fit_slots",))
    run.add_argument("--author", help="who made the capture; recorded in the asset")
    run.add_argument("--license", help="licence of the capture; recorded in the asset")
    run.add_argument("--subject-consent", metavar="TEXT", help="what the subject agreed to; recorded in the asset")
    run.add_argument("--no-viewer", action="store_true", help="no 3D view in the report")
    run.add_argument("--dry-run", action="store_true", help="print the plan: what would run, and why; then stop")
    run.add_argument("--json", action="store_true", help=JSON_HELP)
    run.set_defaults(run=commands.run_command)


def demo_options(demo: argparse.ArgumentParser) -> None:
    """neuface demo"""
    demo.add_argument("--out", default="out/demo", metavar="DIR", help="folder for the results (%(default)s)")
    demo.add_argument("--views", type=whole(8), default=commands.DEMO_VIEWS, help="photos to render (%(default)s)")
    demo.add_argument("--size", type=whole(64), default=commands.DEMO_SIZE, help="pixels a side (%(default)s)")
    add_request_options(demo, RunRequest, only=("preset", "device", "store"))
    demo.add_argument("--json", action="store_true", help=JSON_HELP)
    demo.set_defaults(run=commands.demo_command)


def validate_options(validate: argparse.ArgumentParser) -> None:
    """neuface validate"""
    validate.add_argument("asset", metavar="ASSET.usd", help=".usd, .usda, .usdc or .usdz")
    validate.add_argument("--json", metavar="FILE", help="write every finding as JSON; - for standard output")
    validate.set_defaults(run=commands.validate_command)


def render_options(render: argparse.ArgumentParser) -> None:
    """neuface render"""
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
    render.add_argument("--turntable", type=whole(1), metavar="N", help="N views around the head instead")
    render.add_argument("--width", type=whole(16), metavar="W", help="pixels; default: the camera's own")
    render.add_argument("--samples", type=int, choices=range(5), default=0, help="rays along a pixel's side")
    render.set_defaults(run=commands.render_command)


def turntable_options(turntable: argparse.ArgumentParser) -> None:
    """neuface turntable"""
    turntable.add_argument("folder", metavar="DIR", help="the --out of a run, or its asset folder")
    turntable.add_argument("--out", required=True, metavar="FILE", help="film.mp4 or film.webp")
    turntable.add_argument("--env", default="captured", help=f"{ENV_HELP} (%(default)s)")
    turntable.add_argument("--frames", type=whole(1), default=120, help="pictures of the turn (%(default)s)")
    turntable.add_argument("--size", type=whole(16), default=1080, help="pixels along each side (%(default)s)")
    turntable.set_defaults(run=commands.turntable_command)


def expressions_options(expressions: argparse.ArgumentParser) -> None:
    """neuface expressions"""
    expressions.add_argument("folder", metavar="DIR", help="the --out of a run, or its asset folder")
    expressions.add_argument("--out", required=True, metavar="OUT", help="folder for the files")
    expressions.add_argument("--only", action="append", metavar="NAME", help="this expression; may be repeated")
    expressions.set_defaults(run=commands.expressions_command)


def report_options(report: argparse.ArgumentParser) -> None:
    """neuface report"""
    report.add_argument("folder", metavar="DIR", help="the --out of that run")
    report.set_defaults(run=commands.report_command)


def view_options(view: argparse.ArgumentParser) -> None:
    """neuface view"""
    view.add_argument("folder", metavar="DIR", help="the --out of that run")
    view.set_defaults(run=commands.view_command)


def doctor_options(doctor: argparse.ArgumentParser) -> None:
    """neuface doctor"""
    doctor.add_argument("--out", default=".", metavar="DIR", help="where results would go (%(default)s)")
    doctor.set_defaults(run=commands.doctor_command)
