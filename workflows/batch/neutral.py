"""`neuface batch --neutral`: each person's other expressions become measured blend shapes of the neutral's asset.

After the captures' own runs: the shapes are made (workflows/batch/measure.py), and the run of the neutral is repeated
with the setting usd.measured. All but its last stages come from the store.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.contract import execute
from pipeline.errors import Cancelled, DiskError, NeufaceError, UsageError
from pipeline.head_artifacts import MeasuredShapes
from pipeline.store import Store
from workflows.batch.captures import Item
from workflows.batch.expressions import is_called, shape_name
from workflows.batch.heads import Found, head_of
from workflows.batch.measure import inputs_of, measured_stage
from workflows.batch.state import ENDED, Entry, Measured


@dataclass(slots=True)
class Subject:
    """One person's captures: the neutral (None if there is none), and the others by the name of their shape. twice:
    captures whose shape has the name of another's."""

    name: str
    neutral: Entry | None = None
    others: dict[str, Entry] = field(default_factory=dict)
    twice: list[str] = field(default_factory=list)


def subjects(pairs: Iterable[tuple[Item, Entry]], wanted: str) -> list[Subject]:
    """The captures by person, in their order. wanted: number or name of the neutral expression."""
    found: dict[str, Subject] = {}
    for item, entry in pairs:
        person = found.setdefault(subject_of(item), Subject(subject_of(item)))
        called = expression_of(item)
        shape = shape_name(called)
        if is_called(called, wanted) and person.neutral is None:
            person.neutral = entry
        elif shape in person.others:
            person.twice.append(entry.name)
        else:
            person.others[shape] = entry
    return list(found.values())


def subject_of(item: Item) -> str:
    """The person of a capture: as the tree or list says, else what stands before the / of its name."""
    return item.subject or item.name.partition("/")[0]


def expression_of(item: Item) -> str:
    """The expression of a capture: as the tree or list says, else what stands after the / of its name."""
    return item.expression or item.name.partition("/")[2]


def check_neutral(items: Sequence[Item], wanted: str) -> None:
    """Raises UsageError if nobody has the neutral expression."""
    if not any(is_called(expression_of(i), wanted) for i in items):
        names = sorted({expression_of(i) for i in items if expression_of(i)})
        raise UsageError(
            "nobody has the neutral expression",
            where="--neutral",
            value=wanted,
            limit="number or name of an expression among " + (", ".join(names[:25]) or "captures with an expression"),
            remedy="name another, or let it pass --expressions",
        )


def measure(
    person: Subject,
    out: Path,
    store: Store,
    cancelled: Callable[[], bool],
    progress: Callable[..., None] = lambda *_, **__: None,
) -> Measured:
    """Make a person's measured shapes, or say why there are none. What the store has is not made again.

    Raises:
        Cancelled: the user stopped it. DiskError: the disk is full or can't be written.
    """
    if person.neutral is None:
        return Measured(subject=person.name, reason="there is no capture of the neutral expression")
    result = Measured(subject=person.name, neutral=person.neutral.name)
    neutral = head_of(person.neutral, out, store)
    if isinstance(neutral, str):
        return result.model_copy(update={"reason": f"the neutral has no head: {neutral}"})
    if neutral.template.artifact.rig is None:
        return result.model_copy(update={"reason": "the head template has no joints: no asset of it has blend shapes"})
    left_out = dict.fromkeys(person.twice, "another expression of this person has its name")
    heads: dict[str, Found] = {}
    for shape, entry in person.others.items():
        found = head_of(entry, out, store)
        if isinstance(found, str):
            left_out[entry.name] = found
        else:
            heads[shape] = found
    if not heads:
        return result.model_copy(update={"reason": "no other expression has a head", "left_out": left_out})
    try:
        made = _made(neutral, heads, store, cancelled, progress)
    except (Cancelled, DiskError):
        raise
    except NeufaceError as e:
        return result.model_copy(update={"reason": str(e), "left_out": left_out})
    shapes: MeasuredShapes = made.artifact
    left_out |= {heads[n].name: why for n, why in shapes.left_out.items()}
    named = {n: heads[n].name for n in shapes.shapes}
    file = "" if shapes.file is None else str(made.path(shapes.file))
    why = "" if named else "no expression could be measured"
    return result.model_copy(
        update={"shapes": named, "figures": shapes.shapes, "left_out": left_out, "file": file, "reason": why}
    )


def _made(
    neutral: Found, heads: dict[str, Found], store: Store, cancelled: Callable[[], bool], progress: Callable[..., None]
) -> Any:
    stage = measured_stage(tuple(heads))
    inputs = inputs_of(stage, neutral, heads)
    return execute(stage, inputs, stage.config(), store, cancelled=cancelled, progress=progress).located


def wants_another_run(entry: Entry, made: Measured) -> bool:
    """Note the shapes in the neutral's entry; whether its asset has to be written again with them."""
    if entry.measured == made.file and entry.state in ENDED:
        return False
    if entry.state not in ENDED and not made.file:
        return False
    entry.measured = made.file
    entry.state, entry.fault, entry.earlier = "waiting", None, ()
    return True
