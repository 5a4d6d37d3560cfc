"""What each command of `neuface` does, given its parsed options. Prefect is imported only where it has a server."""

from __future__ import annotations

import argparse
import dataclasses
import json
import webbrowser
from pathlib import Path
from typing import Any

from pipeline.errors import Cancelled, StageError
from workflows.cli.console import Console
from workflows.cli.dry_run import dry_run
from workflows.cli.keys import keys_of
from workflows.cli.options import request_from, with_provenance, with_viewer
from workflows.cli.report import report_request
from workflows.cli.summary import tell
from workflows.cli.view import server_of
from workflows.live.look import REPORT, check_is_run
from workflows.live.publisher import told_live
from workflows.run import output_dirs
from workflows.run.changes import run_as_asked
from workflows.run.estimate import expected
from workflows.run.interrupt import Interrupted, interruptible
from workflows.run.owned import write_owned
from workflows.run.plan import make_plan
from workflows.run.publish import publish
from workflows.run.published import TRUTH
from workflows.run.request import RunRequest
from workflows.run.run_lock import exclusive_run
from workflows.run.session import Session
from workflows.run.verdict import exit_code
from workflows.server import environment

# The demo: enough views and pixels to recognise the face, few enough for minutes on two cores.
DEMO_VIEWS, DEMO_SIZE, DEMO_HOLDOUT = 40, 384, "every:5:2"


def run(request: RunRequest, console: Console) -> dict[str, Any]:
    """Plan, then run the stages: here, or as a flow of the Prefect server that PREFECT_API_URL names.

    Returns what run.json holds.

    Raises:
        StageError: a stage can't go on. UsageError: the request is wrong. Cancelled: Ctrl-C or another signal.
        Interrupted: the same, when everything was published.
    """
    plan, watch = make_plan(request), Session(console)
    console.expect({e.step.stage: e.seconds for e in expected(plan)}, request.budget)
    if environment.has_server():
        environment.defaults()
        from workflows.flows import run_with_session

        try:
            return run_with_session(request, watch)
        except Exception as e:
            raise environment.unanswered(e) or e from e
    with (
        keys_of(watch.steering, console) as keys,
        interruptible(watch.stop, console.note, keys.restore) as caught,
        exclusive_run(plan.store.root, plan.out, watch.stopped, console.note),
        told_live(plan, watch) as told,
    ):
        plan, done = run_as_asked(plan, told)
        record = publish(plan, done, told.observer.note, told.asked_to_stop)
    if caught.number is not None:  # it came when the results were being put in place
        console.note(f"the results are in {plan.out}, complete")
        raise Interrupted(caught.number)
    return record


# ------------------------------------------------------------------ commands
def run_command(options: argparse.Namespace, console: Console) -> int:
    """neuface run"""
    if options.json:
        console.to_json()
    request = request_from(options, RunRequest)
    request = request.model_copy(update={"config": with_viewer(options, with_provenance(options, request.config))})
    if options.dry_run:
        dry_run(make_plan(request), console)
        return 0
    try:
        record = run(request, console)
    except Cancelled:
        console.close()
        console.note(f"stopped; {how_to_resume(request)}")
        raise
    tell(record, Path(options.out), console)
    return exit_code(record)


def how_to_resume(request: RunRequest) -> str:
    """What to do after a stop. --from-stage once more would throw the new checkpoint away, as it did the old result."""
    if request.from_stage is not None:
        return f"to resume, run it again without --from-stage: with it, {request.from_stage} begins anew"
    return "run the same command again to resume"


def demo_command(options: argparse.Namespace, console: Console) -> int:
    """neuface demo"""
    if options.json:
        console.to_json()
    from pipeline.demo.capture import write_demo_capture

    out, capture = Path(options.out), Path(options.out) / "capture"
    request = RunRequest(
        capture=str(capture),
        out=str(out),
        preset=options.preset,
        holdout=DEMO_HOLDOUT,
        name="demo_head",
        device=options.device,
        store=options.store,
    )
    with output_dirs.writable(out, request.store_path):
        console.started("demo photos", 0, 0)
        try:
            write_demo_capture(
                capture,
                views=options.views,
                size=options.size,
                progress=lambda done, total, what: console.progress(done, total, what),
            )
        except FileExistsError as e:
            raise StageError(
                "the folder for the demo's photos holds something else",
                where=capture,
                value=e,
                limit="this demo's capture, or nothing",
                remedy="choose another folder with --out",
            ) from e
        console.close()
        record = run(request, console)
    truth = _against_truth(out, capture, record, request, console) if "asset" in record else []
    tell(record, out, console, truth)
    return exit_code(record)


def _against_truth(
    out: Path, capture: Path, record: dict[str, Any], request: RunRequest, console: Console
) -> list[str]:
    """Lines: how the result compares with what the demo was made of. Figures and a picture go into OUT."""
    from pipeline.capture_artifacts import Capture
    from pipeline.store import Store
    from workflows.evaluation.demo import measure

    found = Store(request.store_path).load("capture", record["stages"]["capture"]["key"], Capture)
    if found is None:
        return []
    figures = measure(out, capture, found.artifact)
    _write(out, "truth.json", json.dumps(dataclasses.asdict(figures), indent=1), console)
    return [*figures.lines(), *_material_against_truth(out, capture, record, found.artifact, console)]


def _material_against_truth(
    out: Path, folder: Path, record: dict[str, Any], capture: Any, console: Console
) -> list[str]:
    """Whether the split into diffuse and specular is right; figures and a picture into OUT/truth."""
    import tempfile

    from pipeline.artifacts import FittedFace
    from pipeline.store import Store
    from pipeline.transforms import matrix
    from workflows.cli.render import component_in
    from workflows.evaluation.demo_maps import compare_maps
    from workflows.evaluation.demo_material import compare

    store = Store(Path(record["store"]))
    fitted = store.load("inverse_rendering", record["stages"]["inverse_rendering"]["key"], FittedFace)
    if fitted is None:
        return []
    place = matrix(record["capture_from_asset"])
    with tempfile.TemporaryDirectory(prefix="neuface-truth-") as scratch:
        made = Path(scratch)
        lines = compare(fitted.path(fitted.artifact.field), folder, capture, place, made).lines()
        for path in sorted(made.iterdir()):
            _write(out, f"{TRUTH}/{path.name}", path.read_bytes(), console)
    return [*lines, *compare_maps(component_in(out), folder, capture, place)]


def validate_command(options: argparse.Namespace, console: Console) -> int:
    """neuface validate"""
    from stages.usd.check.validate import checks_run, validate

    if options.json not in (None, "-"):
        output_dirs.check_file(Path(options.json), "--json")
    found = validate(Path(options.asset))
    counts = {level: sum(f.level == level for f in found) for level in ("error", "warning", "info")}
    if options.json:
        content = {"asset": options.asset, "accepted": not counts["error"], "checks": checks_run(), "counts": counts}
        text = json.dumps({**content, "findings": [f.json() for f in found]}, indent=1)
        if options.json == "-":
            print(text)
            return 1 if counts["error"] else 0
        Path(options.json).write_text(text + "\n")
    for finding in found:
        if finding.level != "info" or options.verbose:
            print(finding)
    print(f"{options.asset}: {checks_run()} checks, {counts['error']} faults, {counts['warning']} warnings")
    return 1 if counts["error"] else 0


def render_command(options: argparse.Namespace, console: Console) -> int:
    """neuface render"""
    from workflows.cli.render import RenderRequest, render_pictures

    request = RenderRequest(
        folder=Path(options.folder),
        out=Path(options.out),
        light=options.env,
        cameras=Path(options.cameras) if options.cameras else None,
        views=options.views,
        turntable=options.turntable,
        width=options.width,
        samples=options.samples,
    )
    if options.light or options.field or options.deform:
        from workflows.cli.relight import relit_pictures

        mesh = Path(options.deform) if options.deform else None
        lights = tuple(options.light or ())
        for path, seconds in relit_pictures(request, lights, console.note, quick=options.quick, mesh=mesh):
            print(f"{path} ({seconds:.1f} s)")
        return 0
    for path, seconds in render_pictures(request, console.note):
        print(f"{path} ({seconds:.1f} s)")
    return 0


def report_command(options: argparse.Namespace, console: Console) -> int:
    """neuface report"""
    out = Path(options.folder)
    record = run(report_request(read_record(out), out), console)
    tell(record, out, console)
    return exit_code(record)


def view_command(options: argparse.Namespace, console: Console) -> int:
    """neuface view"""
    folder = Path(options.folder)
    check_is_run(folder)
    server, address = server_of(folder)
    page = (folder / REPORT).resolve()
    without = f"; the page also opens without a server: {page}" if page.is_file() else ""
    print(f"{address}\nfor this machine only, until Ctrl-C{without}", flush=True)
    webbrowser.open(address)
    with server:
        server.serve_forever()
    return 0


def turntable_command(options: argparse.Namespace, console: Console) -> int:
    """neuface turntable"""
    from workflows.cli.turntable import TurntableRequest, write_turntable

    request = TurntableRequest(Path(options.folder), Path(options.out), options.env, options.frames, options.size)
    print(write_turntable(request))
    return 0


def expressions_command(options: argparse.Namespace, console: Console) -> int:
    """neuface expressions"""
    from workflows.cli.expressions import ExpressionsRequest, write_expressions

    request = ExpressionsRequest(Path(options.folder), Path(options.out), tuple(options.only or ()))
    written = list(write_expressions(request, console.note))
    print(f"{written[0].parent}: {len(written)} files")
    return 0


def doctor_command(options: argparse.Namespace, console: Console) -> int:
    """neuface doctor"""
    from workflows.cli.doctor import examine

    found = examine(Path(options.out))
    print("\n".join(str(f) for f in found))
    return 1 if any(f.level == "fault" for f in found) else 0


# ------------------------------------------------------------------ helpers
def _write(out: Path, name: str, content: str | bytes, console: Console) -> None:
    """OUT/NAME; a file of the user's there is renamed, and told."""
    aside = write_owned(out, name, content)
    if aside is not None:
        console.note(f"{out / name} is yours: kept as {out / aside}")


def read_record(out: Path) -> dict[str, Any]:
    """run.json of a folder that a run left.

    Raises:
        StageError: it is not there, or is not what a run writes.
    """
    path = out / "run.json"
    try:
        record = json.loads(path.read_text())
        if not {"request", "store", "stages"} <= record.keys():
            raise ValueError("it lacks request, store or stages")
    except (OSError, ValueError, AttributeError) as e:
        raise StageError(
            "this folder holds no finished run",
            where=path,
            value=e,
            limit="the run.json of a run",
            remedy="name the folder that was given as --out",
        ) from e
    found: dict[str, Any] = record
    return found
