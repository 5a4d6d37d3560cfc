"""docs/equations.md and the code agree in both directions."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TAG = re.compile(r"\[NeuFace eq\. (\d+)")
ROW = re.compile(r"^\| \[NeuFace eq\. (\d+)\] \|.*?\| `([\w.]+)` \| `([\w/.]+)::(\w+)` \|$", re.M)


def rows() -> list[tuple[str, str, str, str]]:
    found = ROW.findall((ROOT / "docs/equations.md").read_text())
    assert len(found) >= 15
    return found


def tags_in_code() -> set[str]:
    files = [p for d in ("pipeline", "stages") for p in (ROOT / d).rglob("*.py")]
    return {t for p in files for t in TAG.findall(p.read_text())}


def test_every_tag_in_the_code_has_a_row() -> None:
    assert tags_in_code() <= {r[0] for r in rows()}


def test_every_equation_of_the_paper_has_a_row() -> None:
    """(1) to (24) in the paper, (25) to (28) in its supplement."""
    assert {r[0] for r in rows()} == {str(n) for n in range(1, 29)}


def test_every_row_names_a_function_that_carries_its_tag() -> None:
    for number, dotted, _, _ in rows():
        module_name, _, name = dotted.rpartition(".")
        thing = getattr(importlib.import_module(module_name), name)
        file = Path(importlib.import_module(module_name).__file__ or "").read_text()
        assert f"[NeuFace eq. {number}]" in (thing.__doc__ or "") or f"[NeuFace eq. {number}" in file, dotted


def test_every_row_names_a_test_that_exists() -> None:
    for _, _, file, test in rows():
        assert f"def {test}(" in (ROOT / file).read_text(), f"{file}::{test}"
