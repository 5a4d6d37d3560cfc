"""The table of checks in docs/verdict.md, from the calls of `judged` in the stages.

    python -m benchmarks.verdict_checks            # prints it
    python -m benchmarks.verdict_checks --write    # puts it into docs/verdict.md

It reads the source, so that a check that fires in no run is listed too. tests/docs holds the page to it.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.generated import print_or_write
from pipeline.verdict import Limits
from stages.registry import EVERY

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "verdict.md"
BEGIN, END = "<!-- checks -->", "<!-- /checks -->"
NAMES = ("check", "value", "limits", "said", "remedy")  # of judged's parameters
DEPENDS = "depends on the capture"


@dataclass(frozen=True)
class Check:
    """One call. name: with * for what is put in; limits and remedies: of every branch."""

    stage: str
    name: str
    limits: tuple[Limits, ...]
    remedies: tuple[str, ...]

    def row(self) -> str:
        """A line of the table."""
        good = _joined(x.words() for x in self.limits) or DEPENDS
        usable = _joined(_usable(x) for x in self.limits) or DEPENDS
        remedy = _joined(self.remedies).replace("|", "\\|") or "nothing: it is only reported"
        return f"| {self.stage} | `{self.name}` | {good} | {usable} | {remedy} |"


def checks() -> list[Check]:
    """Of all stages, in their order; a check that is judged in two places has one row."""
    found: dict[tuple[str, str], Check] = {}
    for stage in EVERY:
        for path in sorted((ROOT / "stages" / stage.name).glob("*.py")):
            text = path.read_text()
            if "judged(" not in text:
                continue
            module = importlib.import_module(f"stages.{stage.name}.{path.stem}")
            for check in checks_in(stage.name, text, vars(module)):
                before = found.get((stage.name, check.name))
                found[stage.name, check.name] = check if before is None else _merged(before, check)
    return list(found.values())


def checks_in(stage: str, source: str, known: dict[str, Any]) -> Iterator[Check]:
    """Of one module. known: its names and their values."""
    for function in (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)):
        assigned = [
            (node.lineno, target.id, node.value)
            for node in ast.walk(function)
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        ]
        for call in (n for n in ast.walk(function) if isinstance(n, ast.Call)):
            if isinstance(call.func, ast.Name) and call.func.id == "judged":
                earlier = sorted((a for a in assigned if a[0] < call.lineno), key=lambda a: a[0])
                local = {name: value for _, name, value in earlier}  # the last one before the call
                given = dict(zip(NAMES, call.args, strict=False)) | {k.arg: k.value for k in call.keywords if k.arg}
                for name in _texts(given["check"], local, known):
                    limits = tuple(x for x in _values(given["limits"], local, known) if isinstance(x, Limits))
                    yield Check(stage, name, limits, tuple(t for t in _texts(given["remedy"], local, known) if t))


def table() -> str:
    """The whole table, between its marks."""
    head = "| stage | check | good | usable | what to do |\n|---|---|---|---|---|"
    return "\n".join([BEGIN, head, *(c.row() for c in checks()), END])


def _branches(node: ast.expr, local: dict[str, ast.expr]) -> Iterator[ast.expr]:
    """An expression's alternatives: both sides of a condition, what a local name was set to."""
    if isinstance(node, ast.IfExp):
        yield from _branches(node.body, local)
        yield from _branches(node.orelse, local)
    elif isinstance(node, ast.Name) and node.id in local:
        yield from _branches(local[node.id], {k: v for k, v in local.items() if k != node.id})
    else:
        yield node


def _values(node: ast.expr, local: dict[str, ast.expr], known: dict[str, Any]) -> list[Any]:
    found: list[Any] = []
    for branch in _branches(node, local):
        try:
            value = eval(compile(ast.Expression(branch), "<check>", "eval"), dict(known))
        except Exception:  # made of what only a run knows
            continue
        found += [value] if value not in found else []
    return found


def _texts(node: ast.expr, local: dict[str, ast.expr], known: dict[str, Any]) -> list[str]:
    found = []
    for branch in _branches(node, local):
        if isinstance(branch, ast.JoinedStr):
            found.append("".join(str(p.value) if isinstance(p, ast.Constant) else "*" for p in branch.values))
        elif isinstance(branch, ast.BinOp) and isinstance(branch.op, ast.Add):
            left, right = _texts(branch.left, local, known), _texts(branch.right, local, known)
            found += [a + b for a in left or ["*"] for b in right or ["*"]]
        else:
            found += [v for v in _values(branch, local, known) if isinstance(v, str)]
    return list(dict.fromkeys(found))


def _usable(limits: Limits) -> str:
    if limits.usable == limits.good:
        return "as good"
    if abs(limits.usable) == float("inf"):
        return "any"
    return f"at {'least' if limits.lower else 'most'} {limits.usable:g}"


def _joined(parts: Any) -> str:
    return "; or ".join(dict.fromkeys(parts))


def _merged(a: Check, b: Check) -> Check:
    limits = tuple(dict.fromkeys((*a.limits, *b.limits)))
    return Check(a.stage, a.name, limits, tuple(dict.fromkeys((*a.remedies, *b.remedies))))


if __name__ == "__main__":
    sys.exit(print_or_write(sys.argv[1:], PAGE, table()))
