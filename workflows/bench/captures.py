"""`neuface bench captures`: every capture of a folder run with its split, and one table of what came out.

Each capture is a process of its own with a time limit. All share a store, so that the same command resumes where it
was stopped. The table is written after each capture; rows of captures that were not run again stay as they are.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import signal
import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.errors import Cancelled, UsageError
from stages.presets import DEFAULT_PRESET
from workflows.batch.captures import natural
from workflows.bench import captures_find as captures
from workflows.bench.captures_against import compare
from workflows.bench.captures_child import CHILD, Ended, run_child
from workflows.bench.captures_figures import Run, figures_of, read_run, texture_of, verdict_of
from workflows.bench.captures_find import PROJECT, Found
from workflows.bench.captures_table import FIGURES, markdown, shown
from workflows.cli.console import Console

TABLE = PROJECT / "docs" / "benchmarks" / "captures.json"
FORMAT = 1
LIMIT = 40.0  # minutes: a draft takes three to ten on two cores
SKIPPED = "skipped"


def options(sub: argparse.ArgumentParser) -> None:
    """The command line's options."""
    from workflows.cli.options import a_time

    sub.add_argument("--root", metavar="DIR", help="folder of captures (../shared/captures beside the project)")
    sub.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these; other rows stay as they are")
    sub.add_argument("--preset", default=DEFAULT_PRESET, help="of every run (%(default)s)")
    sub.add_argument("--holdout", metavar="RULE", help="for all, in place of each capture's own rule")
    sub.add_argument("--out", default="out/captures", metavar="DIR", help="folder for runs, logs, store (%(default)s)")
    sub.add_argument(
        "--table",
        metavar="FILE",
        help="the table as JSON, with Markdown beside it (docs/benchmarks/"
        "captures.json for the usual captures, preset and splits, else OUT/captures.json)",
    )
    sub.add_argument(
        "--against",
        metavar="FILE",
        help="a table as JSON: print what got better and worse since (the rows that are replaced)",
    )
    sub.add_argument(
        "--limit", type=a_time, default=60 * LIMIT, metavar="TIME", help="for each capture: 90s, 40m (40m)"
    )


def run(given: argparse.Namespace, console: Console, command: Sequence[str] = CHILD) -> int:
    """neuface bench captures"""
    root, out = captures.root_of(given.root), Path(given.out)
    found = captures.find(root, given.only, given.holdout)
    path = table_path(given)
    rows = read_table(path) if path.is_file() else {}
    old = read_table(Path(given.against)) if given.against else dict(rows)
    made = about(root)
    for number, capture in enumerate(found, 1):
        console.note(f"[{number}/{len(found)}] {capture.name}: {capture.skipped or 'held out ' + capture.holdout}")
        rows[capture.name] = row_of(capture, given, out, made, command)
        write_table(path, rows)
        console.note(f"    {summary_line(rows[capture.name])}")
    if not given.only:  # a capture that is no longer there has no row
        names = {c.name for c in found}
        rows = {n: r for n, r in rows.items() if n in names}
        write_table(path, rows)
    console.close()
    print(f"table  {path.with_suffix('.md')}")
    mine = {c.name for c in found}
    asked = old if not given.only else {n: r for n, r in old.items() if n in mine}
    if old:
        print("\n".join(compare(asked, {n: r for n, r in rows.items() if n in mine})))
    return 0


# ------------------------------------------------------------------ a row
def row_of(capture: Found, given: argparse.Namespace, out: Path, made: dict[str, str], command: Sequence[str]) -> Any:
    """Run a capture and measure what came out; whatever fails is in the row."""
    row: dict[str, Any] = {
        "preset": given.preset,
        "holdout": capture.holdout,
        "command": f"neuface run {named(capture, made)} --preset {given.preset} --holdout {capture.holdout}",
        **{k: made[k] for k in ("machine", "commit")},
        "date": datetime.date.today().isoformat(),
    }
    if capture.skipped:
        ended = {"exit_code": None, "how": SKIPPED, "error": capture.skipped, "stage": "", "wall": 0.0}
        return row | {"ended": ended, "verdict": verdict_of(None), "seconds": {}, "figures": {}}
    folder = (out / capture.name).absolute()
    arguments = [
        "run",
        str(capture.capture),
        "--out",
        str(folder),
        "--store",
        str((out / "store").absolute()),
        "--preset",
        given.preset,
        "--holdout",
        capture.holdout,
    ]
    before = _changed(folder / "run.json")
    try:
        with terminable():
            child = run_child(arguments, out / "logs" / f"{capture.name}.log", given.limit, command)
    except KeyboardInterrupt:
        raise Cancelled(f"stopped at {capture.name}; run the same command again to resume there") from None
    written = child.exit_code in (0, 3) and _changed(folder / "run.json") != before
    return (
        row | _ended(child, [capture.folder, folder]) | measured(read_run(folder) if written else None, capture, child)
    )


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM as Ctrl-C, so that the capture's process ends with this one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def measured(run: Run | None, capture: Found, child: Ended) -> dict[str, Any]:
    """Verdict, seconds, figures, materials and labels of a run; a failed measurement is reported and keeps the rest."""
    out: dict[str, Any] = {"verdict": verdict_of(run), "seconds": child.stages, "figures": {}}
    if run is None:
        return out
    from workflows.evaluation import stored_truth

    out["seconds"] = {k: round(float(v), 1) for k, v in run.record.get("timing", {}).items() if k != "total"}
    faults = []
    try:
        out["figures"] = figures_of(run)
        texture, out["materials"] = texture_of(run)
        out["figures"] |= texture
    except Exception as e:  # noqa: BLE001
        faults.append(f"figures: {type(e).__name__}: {e}")
    try:
        true, out["labels"] = stored_truth.measure(run, capture.folder)
        out["figures"] |= true
    except Exception as e:  # noqa: BLE001
        faults.append(f"truth: {type(e).__name__}: {e}")
    whole: dict[str, Any] = finite(out | ({"fault": "; ".join(faults)} if faults else {}))
    return whole


def finite(value: Any) -> Any:
    """The same with None for numbers that are not finite, which JSON does not have."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _ended(child: Ended, private: Sequence[Path]) -> dict[str, Any]:
    """How the child ended. private: folders of this machine, of which a table has the last name only."""
    error = child.error
    for path in private:
        error = error.replace(str(path), path.name)
    return {
        "ended": {
            "exit_code": child.exit_code,
            "how": child.how,
            "error": error,
            "stage": child.stage,
            "wall": child.seconds,
        }
    }


def _changed(path: Path) -> int | None:
    """When a file was written last: a run that failed leaves that of an earlier one."""
    return path.stat().st_mtime_ns if path.is_file() else None


def named(capture: Found, made: dict[str, str]) -> str:
    """The capture as a command names it, without this machine's folders."""
    inner = "/" + capture.capture.name if capture.capture != capture.folder else ""
    return f"{made['root']}/{capture.name}{inner}"


def summary_line(row: dict[str, Any]) -> str:
    """A row in a line."""
    ended, by_name = row["ended"], {f.name: f for f in FIGURES}
    if ended["how"] == SKIPPED:
        return SKIPPED
    how = f"exit {ended['exit_code']}" if ended["how"] == "by itself" else ended["how"]
    parts = [how, f"verdict {row['verdict']['level']}", f"{ended['wall']:.0f} s"]
    for name, what in (("asset_psnr", "dB"), ("chamfer_mm", "mm"), ("depth_median_mm", "mm of face depth")):
        if row["figures"].get(name) is not None:
            parts.append(f"{shown(by_name[name], row)} {what}")
    return ", ".join(parts + [x for x in (ended["error"], row.get("fault", "")) if x])


# ------------------------------------------------------------------ the table and what it was made on
def table_path(given: argparse.Namespace) -> Path:
    """Where the table is: the project's own for nothing but what it is about."""
    if given.table:
        return Path(given.table).with_suffix(".json")
    usual = given.root is None and given.holdout is None and given.preset == DEFAULT_PRESET
    return TABLE if usual else Path(given.out) / "captures.json"


def read_table(path: Path) -> dict[str, Any]:
    """Rows by the capture's name. UsageError if the file is no such table."""
    try:
        found = json.loads(path.read_text())
        if found["format"] != FORMAT:
            raise ValueError(f"format {found['format']}")
        return dict(found["rows"])
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise UsageError(
            "the table can't be read",
            where=path,
            value=f"{type(e).__name__}: {e}",
            limit=f"JSON of neuface bench captures, format {FORMAT}",
            remedy="name captures.json of an earlier bench, or move this file away",
        ) from e


def write_table(path: Path, rows: dict[str, Any]) -> None:
    """Both files, each at once: a bench that is stopped leaves the last whole ones."""
    ordered = {n: rows[n] for n in sorted(rows, key=natural)}
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"format": FORMAT, "rows": ordered}, indent=1, allow_nan=False) + "\n"
    for target, content in ((path, text), (path.with_suffix(".md"), markdown(ordered))):
        partial = target.with_name(f".{target.name}.partial")
        partial.write_text(content)
        partial.replace(target)


def about(root: Path) -> dict[str, str]:
    """Machine, commit, and the folder of captures as a command may name it."""
    from workflows.run import host_info

    usual = root == captures.DEFAULT_ROOT.resolve()
    machine = host_info.describe(host_info.machine())
    return {"machine": machine, "commit": commit(), "root": "../shared/captures" if usual else root.name}


def commit() -> str:
    """Short name of the project's commit, with a + where files differ from it; "unknown" outside of a repository."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=PROJECT, capture_output=True, text=True, check=True, timeout=60
        ).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs/benchmarks")
        return git("rev-parse", "--short=10", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"
