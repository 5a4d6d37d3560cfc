"""docs/verdict.md lists every check with the limits and remedies of the code."""

from __future__ import annotations

from benchmarks import verdict_checks
from benchmarks.verdict_checks import Check, checks_in
from pipeline.verdict import Limits

SOURCE = """
def f(x, names):
    remedy = "shoot again" if names else f"look at {x} and shoot again"
    limits = A if x else B
    judged("sharp", x, A, f"{x} are sharp", "use a tripod")
    judged(f"error_{x}", x, limits, "said", remedy, unit="dB")
    judged("told", x, MADE(x), "said", "")
"""


def test_calls_are_read_with_all_their_branches() -> None:
    a, b = Limits(0.9, 0.5), Limits(3, float("inf"), lower=False)
    found = list(checks_in("masks", SOURCE, {"A": a, "B": b}))
    assert found == [
        Check("masks", "sharp", (a,), ("use a tripod",)),
        Check("masks", "error_*", (a, b), ("shoot again", "look at * and shoot again")),
        Check("masks", "told", (), ()),
    ]
    assert found[0].row() == "| masks | `sharp` | at least 0.9 | at least 0.5 | use a tripod |"
    assert "at least 0.9; or at most 3 | at least 0.5; or any |" in found[1].row()


def test_the_page_has_the_table_that_the_code_makes() -> None:
    """Make it anew with: python -m benchmarks.verdict_checks --write"""
    assert verdict_checks.table() in verdict_checks.PAGE.read_text()
