"""Makes single wrong changes to the product, and sees whether the tests that must notice each do.

    python -m benchmarks.mutations                 # all of them: a table; exit code 1 if one survives
    python -m benchmarks.mutations --only hull     # those whose file or tests have "hull" in their name
    python -m benchmarks.mutations --write         # all of them, and docs/benchmarks/mutations.md, .json
    python -m benchmarks.mutations --left --write  # those that were not made yet, or were not killed

Each change is made in a copy of the tree, where its tests then run; nothing here is touched. Before that the tests run
once on the unchanged copy: a test that fails there proves nothing. The list is in benchmarks/mutation_list.py.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.mutation import Mutation
from benchmarks.mutation_list import MUTATIONS

ROOT = Path(__file__).resolve().parents[1]
PAGE, RECORD = ROOT / "docs/benchmarks/mutations.md", ROOT / "docs/benchmarks/mutations.json"
NOT_RUN, KILLED = "not made yet", "killed"
PARTS = ("benchmarks", "docker", "docs", "pipeline", "stages", "tests", "workflows")
LIMIT, PATIENCE = 900.0, 5.0  # seconds, and times all tests' own time: what hangs on a change has noticed it
FAILED = 1  # pytest's exit code where tests failed; 2 to 5 say that they did not run


def copied(to: Path) -> Path:
    """The tree without its history. With what was compiled, which is used again: times of files are kept."""
    for part in PARTS:
        shutil.copytree(ROOT / part, to / part, symlinks=True)
    for file in ROOT.iterdir():
        if file.is_file() and file.name != ".git":
            shutil.copy2(file, to)
    return to


def outcome(tree: Path, tests: list[str], limit: float | None = None) -> tuple[int | None, str]:
    """pytest's exit code (None: it did not end) and the last line that says something."""
    # no bytecode is written: a file that is changed twice within a second would else be run as it was
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    try:
        ended = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return None, f"not over after {limit:.0f} s"
    lines = [x for x in ended.stdout.splitlines() if x.strip()]
    said = next((x for x in lines if x.startswith("FAILED")), lines[-1] if lines else ended.stderr[-200:])
    return ended.returncode, said


def fate(tree: Path, mutation: Mutation, limit: float = LIMIT) -> tuple[str, str]:
    """killed, survived or unclear, and why."""
    path = tree / mutation.file
    text, kept = path.read_text(), path.stat()
    if text.count(mutation.before) != 1:
        return "unclear", f"the text stands there {text.count(mutation.before)} times"
    path.write_text(text.replace(mutation.before, mutation.after))
    try:
        code, said = outcome(tree, [mutation.tests], limit)
    finally:
        path.write_text(text)
        os.utime(path, ns=(kept.st_atime_ns, kept.st_mtime_ns))
    if code in (None, FAILED):
        return "killed", said
    return ("survived" if code == 0 else "unclear"), said


def recorded() -> list[str]:
    """What came of each change of the list when it was made last; NOT_RUN where it never was."""
    known: dict[str, str] = json.loads(RECORD.read_text()) if RECORD.is_file() else {}
    return [known.get(m.change, NOT_RUN) for m in MUTATIONS]


def chosen(only: Sequence[str] = ("",), *, left: bool = False) -> list[Mutation]:
    """The changes with one of these texts in the name of their file or tests. left: without those that were killed."""
    named = [m for m in MUTATIONS if any(text in m.file or text in m.tests for text in only)]
    fates = dict(zip(MUTATIONS, recorded(), strict=True))
    return [m for m in named if not left or fates[m] != KILLED]


def page() -> str:
    """The document: a row for each change, in the order of the list."""
    fates = recorded()
    lines = [
        "# Wrong changes that tests notice",
        "",
        "Each row is one wrong change of a line of the product, made in a copy of the tree, and the tests that ran.",
        "`killed`: a test failed, as it should. `survived`: none did. Made by `python -m benchmarks.mutations --write`",
        "from `benchmarks/mutation_list.py`; `tests/docs/test_mutations.py` checks that every text still stands in its",
        "file, and that this page has every change.",
        "",
        f"{fates.count('killed')} of {len(fates)} were killed when they were made last.",
        "",
        "| file | change | tests | |",
        "|---|---|---|---|",
    ]
    for m, fate_of in zip(MUTATIONS, fates, strict=True):
        lines.append(f"| `{m.file}` | {_code(m.before)} -> {_code(m.after)} | `{m.tests}` | {fate_of} |")
    return "\n".join(lines) + "\n"


def _code(text: str) -> str:
    """As code in a cell of a table."""
    return f"`{' '.join(text.split())}`".replace("|", "\\|") if text.strip() else "nothing"


def main(arguments: list[str]) -> int:
    """Run them, print a line each; 1 if one is not killed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument(
        "--only", nargs="+", default=[""], help="texts, one of them in the name of the file or of the tests"
    )
    parser.add_argument("--left", action="store_true", help="only those not recorded as killed")
    parser.add_argument("--write", action="store_true", help=f"write the table of {PAGE.relative_to(ROOT)}")
    options = parser.parse_args(arguments)
    if not chosen(options.only):
        parser.error(f"no change has {options.only!r} in the name of its file or tests")
    asked = chosen(options.only, left=options.left)
    if not asked:
        print("nothing is left: all of them were killed")
        return 0
    with tempfile.TemporaryDirectory(prefix="mutations") as folder:
        tree = copied(Path(folder) / "tree")
        begun = time.monotonic()
        code, said = outcome(tree, sorted({m.tests for m in asked}))
        limit = max(LIMIT, PATIENCE * (time.monotonic() - begun))
        if code != 0:
            print(f"the tests fail without any change: {said}")
            return 2
        fates: list[str] = []
        known = {m.change: f for m, f in zip(MUTATIONS, recorded(), strict=True)}
        for m in asked:
            begun = time.monotonic()
            what, said = fate(tree, m, limit)
            fates.append(what)
            known[m.change] = what
            if options.write:  # at once: a run that is stopped has not worked for nothing
                RECORD.write_text(json.dumps(known, indent=1) + "\n")
                PAGE.write_text(page())
            print(f"{what:9} {time.monotonic() - begun:4.0f} s  {m.change}\n{'':17}{said}", flush=True)
    print(f"{fates.count('killed')} of {len(fates)} killed")
    return 0 if set(fates) <= {"killed"} else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
