"""How many changes of the code ago each record of docs/benchmarks was made: a figure that is too old must be measured
again.

    python -m benchmarks.record_ages      # a line for each record; exit code 1 if one is too old

A change is a commit that touches the code which the record is about. Counted from the record's commit where the history
has it, else from the begin of its day.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs/benchmarks"
MOST = 200  # changes of the code concerned
FIT = ("stages/inverse_rendering", "pipeline/fields", "pipeline/maths")
RUNS = ("workflows/run", "workflows/batch", "workflows/server", "pipeline/contract.py", "pipeline/store.py")
CONCERNED: dict[str, tuple[str, ...]] = {
    "ablations": FIT,
    "captures": ("stages", "pipeline"),
    "fuzz": ("stages/capture", "pipeline/images.py", "pipeline/picture_size.py", "pipeline/store.py",
             "pipeline/template", "workflows/batch/captures.py", "stages/presets.py"),
    "history": (),  # each of its tables names its own
    "signals": RUNS,
    "signals_batch": RUNS,
    "signals_pool": RUNS,
    "soak": RUNS,
    "speed": FIT,
    "template": ("stages/template", "pipeline/template", "pipeline/registration"),
    "tradeoff": FIT,
}  # fmt: skip
COMMIT, DAY = re.compile(r"commit ([0-9a-f]{7,40})\b"), re.compile(r"\b(20\d\d-\d\d-\d\d)\b")


@dataclass(frozen=True)
class Made:
    """A record, or a row of one. date: YYYY-MM-DD; commit: "" if it is not known; code: what a row is about, where that
    is not the same for the whole record."""

    record: str
    row: str
    date: str
    commit: str = ""
    code: tuple[str, ...] = ()


def made(record: str, content: dict[str, Any]) -> Iterator[Made]:
    """Each part of a record that was made on its own. Those of what is not in the code any more have no age."""
    if content.get("kind") == "kept":
        return
    if "made" in content:  # text
        commit, day = COMMIT.search(content["made"]), DAY.search(content["made"])
        yield Made(record, "", day[1] if day else "", commit[1] if commit else "")
    elif "date" in content:
        code = tuple(content.get("code", ()))
        yield Made(record, "", content["date"], content.get("commit", "").rstrip("+"), code)
    elif "machine" in content:
        yield Made(record, "", content["machine"]["date"], content.get("commit", "").rstrip("+"))
    else:
        for row, inner in content.get("rows", content).items():
            for one in made(record, inner) if isinstance(inner, dict) else ():
                yield Made(record, row, one.date, one.commit, one.code)


def changes(since: Made) -> int | None:
    """Commits on the code concerned since then; None outside of a repository with its history."""
    paths = ["--", *(since.code or CONCERNED[since.record])]
    found = _git("rev-list", "--count", f"{since.commit}..HEAD", *paths) if since.commit else None
    if found is None:
        found = _git("rev-list", "--count", f"--since={since.date} 00:00:00", "HEAD", *paths)
    return None if found is None else int(found)


def has_history() -> bool:
    """Whether this is a repository with all of its commits."""
    return _git("rev-parse", "--is-shallow-repository") == "false"


def all_made() -> list[Made]:
    """Every part of every record."""
    return [m for record in CONCERNED for m in made(record, json.loads((FOLDER / f"{record}.json").read_text()))]


def _git(*words: str) -> str | None:
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, timeout=60)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def main() -> int:
    """Exit code 1 if a record is older than MOST changes."""
    ages = [(m, changes(m)) for m in all_made()]
    for m, age in ages:
        known = "unknown" if age is None else str(age)
        print(f"{known:>8} changes since {m.date} {m.commit:11} {m.record} {m.row}")
    return 1 if any(age is not None and age > MOST for _, age in ages) else 0


if __name__ == "__main__":
    sys.exit(main())
