"""Runs the fuzz tests with many cases, and writes how many each reader got for docs/benchmarks/fuzz.md.

    python -m benchmarks.fuzz_counts                          # every test of tests/fuzz, 10,000 cases a reader
    python -m benchmarks.fuzz_counts --only cameras --write   # tests with "cameras" in their file or name; the page

One pytest process for each test function. Each result is written at once, so that a run that is stopped is not lost;
rows of tests that were not asked for are kept.
"""

from __future__ import annotations

import argparse
import ast
import base64
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from xml.etree import ElementTree

from tests.support.fuzzing import READ, REFUSED
from workflows.bench.captures import commit
from workflows.run import host_info

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "tests" / "fuzz"
PAGE, RECORD = ROOT / "docs/benchmarks/fuzz.md", ROOT / "docs/benchmarks/fuzz.json"
CASES = 10_000  # a reader; a reader that two tests damage gets half of them from each
LIMIT = 1800.0  # seconds of one test function
STATISTICS, PASSED = "hypothesis-statistics-", re.compile(r"(\d+) passing, (\d+) failing")


@dataclass(frozen=True)
class Row:
    """One test. cases: damaged files that were tried; read, refused: answers of the readers, several to a case."""

    cases: int
    read: int
    refused: int
    seconds: float
    failed: bool
    date: str
    commit: str


def functions() -> list[str]:
    """Every fuzz test as FILE::NAME, without its parameters, in the order of the files."""
    found = []
    for path in sorted(TESTS.glob("test_*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef) and any("given" in ast.unparse(d) for d in node.decorator_list):
                found.append(f"tests/fuzz/{path.name}::{node.name}")
    return found


def run(function: str, cases: int) -> dict[str, Row]:
    """The rows of one test function, by the test's name with its parameters."""
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        junit = Path(folder) / "junit.xml"
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "NEUFACE_FUZZ": str(cases)}
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={junit}", function]
        ended = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LIMIT)
        if ended.returncode not in (0, 1) or not junit.is_file():
            raise SystemExit(f"{function} did not run: {ended.stdout[-2000:]}{ended.stderr[-2000:]}")
        if ended.returncode:
            print(ended.stdout[-6000:], flush=True)
        return dict(rows_of(ElementTree.parse(junit).getroot(), host_info.machine()["date"], commit()))


def rows_of(junit: ElementTree.Element, date: str, made_by: str) -> Iterator[tuple[str, Row]]:
    """FILE::NAME[PARAMETERS] and row of each test in pytest's JUnit file, which has Hypothesis' own count of cases."""
    counted = {}
    for entry in junit.iter("property"):
        if (name := entry.get("name", "")).startswith(STATISTICS):
            found = PASSED.findall(base64.b64decode(entry.get("value", "")).decode())
            counted[name.removeprefix(STATISTICS)] = sum(int(n) for pair in found for n in pair)
    for test in junit.iter("testcase"):
        name = f"{test.get('classname', '').replace('.', '/')}.py::{test.get('name')}"
        told = {p.get("name"): int(p.get("value", "0")) for p in test.iter("property")}
        failed = any(test.find(kind) is not None for kind in ("failure", "error"))
        yield name, Row(counted.get(name, 0), told.get(READ, 0), told.get(REFUSED, 0),
                        round(float(test.get("time", "0")), 1), failed, date, made_by)  # fmt: skip


def recorded() -> dict[str, Row]:
    """The rows of earlier runs, of tests that still exist."""
    known = json.loads(RECORD.read_text()) if RECORD.is_file() else {}
    present = set(functions())
    return {name: Row(**row) for name, row in known.items() if name.partition("[")[0] in present}


def page() -> str:
    """The document: a row for each test that ran, and the names of those that did not."""
    rows = recorded()
    missing = [f for f in functions() if not any(name.partition("[")[0] == f for name in rows)]
    lines = [
        "# Damaged files",
        "",
        "Each row is a test of `tests/fuzz`: small whole files of one kind are damaged, and their reader must read",
        "them or refuse them with a named error, in two seconds of processor time and little memory. *cases*: damaged",
        "files, as Hypothesis counts them. *read*, *refused*: the readers' answers (a photo is asked for its size, its",
        "colours and its import, so that a case has up to three). A failure would be in the last column. Made by",
        "",
        "    python -m benchmarks.fuzz_counts --write",
        "",
        "10,000 cases a reader; one that two tests damage gets half of them from each. HEIC and raw photos get a",
        "tenth, because each is read in a process of its own, which takes 0.2 s.",
        "",
        f"{sum(r.cases for r in rows.values()):,} cases in {len(rows)} tests, "
        f"{sum(r.failed for r in rows.values())} failed. Seconds are of a machine with other work.",
        "",
        "| test | cases | read | refused | seconds | commit | |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| `{name.removeprefix('tests/fuzz/test_fuzz_')}` | {r.cases:,} | {r.read:,} | {r.refused:,} "
        f"| {r.seconds:.0f} | {r.commit} | {_word(r)} |"
        for name, r in sorted(rows.items())
    ]
    if missing:
        lines += ["", "Not run with this many cases yet: " + ", ".join(f"`{m.partition('::')[2]}`" for m in missing)]
    return "\n".join(lines) + "\n"


def _word(row: Row) -> str:
    return "FAILED" if row.failed else "no fault"


def main(arguments: Sequence[str]) -> int:
    """Exit code 1 if a test failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--cases", type=int, default=CASES, help="damaged files a reader")
    parser.add_argument("--only", nargs="+", default=[""], help="texts, one of them in the name of the file or test")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.relative_to(ROOT)} and its JSON")
    given = parser.parse_args(arguments)
    chosen = [f for f in functions() if any(text in f for text in given.only)]
    if not chosen:
        parser.error(f"no fuzz test has {given.only!r} in its name")
    failed = False
    for function in chosen:
        rows = run(function, given.cases)
        for name, row in rows.items():
            failed |= row.failed
            print(f"{_word(row):9}{row.cases:7,} cases {row.seconds:6.0f} s  {name}", flush=True)
        if given.write:
            kept = {n: r for n, r in recorded().items() if n.partition("[")[0] != function}
            RECORD.write_text(json.dumps({n: asdict(r) for n, r in sorted({**kept, **rows}.items())}, indent=1) + "\n")
            PAGE.write_text(page())
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
