"""`neuface batch --average`: the average head of a batch in OUT/average, and whose captures it holds.

The work is a stage (workflows/batch/average_stage.py): the same captures give what the store has. OUT/average is
published as asset/ and report/ of a run are: a file of the user's in it stays.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.artifacts import Located
from pipeline.contract import Done, execute
from pipeline.errors import Cancelled, DiskError, NeufaceError, UsageError, stage_error_from_os_error
from pipeline.head_artifacts import AverageHead
from pipeline.store import Store, read_object
from workflows.batch.average_stage import NAME, Config, average_stage, inputs_of
from workflows.batch.captures import Item
from workflows.batch.heads import Found, head_of
from workflows.batch.page import RECORD
from workflows.batch.state import Averaged, Entry
from workflows.run.published import is_ours, note_published, published
from workflows.run.replace import drop, prepare, put, tidy
from workflows.run.room import check_room_for_copies

LEAST = 2  # heads


def check_average(items: Sequence[Item], out: Path) -> None:
    """Raises UsageError if a capture's results would lie where the average does."""
    taken = next((i.name for i in items if i.name.partition("/")[0] == NAME), None)
    if taken is not None:
        raise UsageError(
            "a capture's name is taken",
            where="--average",
            value=taken,
            limit=f"any but {NAME}, where the average head is written",
            remedy="rename the folder, give it a name in a list, or leave out --average",
        )


def average(
    entries: Sequence[Entry],
    out: Path,
    store: Store,
    config: Config,
    cancelled: Callable[[], bool],
    progress: Callable[..., None] = lambda *_, **__: None,
    notify: Callable[[str], None] = lambda text: None,
) -> Averaged:
    """Make and publish the average of these captures' heads, or say why there is none.

    Raises:
        Cancelled: the user stopped it. DiskError: the disk is full or can't be written.
    """
    heads, left_out = _heads(entries, out, store)
    if len(heads) < LEAST:
        why = f"{len(heads)} of {len(entries)} captures have a head with maps; an average takes {LEAST}"
        return Averaged(reason=why, left_out=left_out)
    stage = average_stage(len(heads))
    try:
        done = execute(stage, inputs_of(stage, heads), config, store, cancelled=cancelled, progress=progress)
        made: AverageHead = done.located.artifact
        record = _record(done, heads, left_out)
        if not _is_published(out, record, done.located):
            _publish(out, record, done.located, notify)
    except (Cancelled, DiskError):
        raise
    except OSError as e:
        raise stage_error_from_os_error(e, out) or e from e
    except (NeufaceError, ValueError) as e:
        return Averaged(reason=str(e), left_out=left_out)
    return Averaged(
        captures=tuple(f.name for f in heads), left_out=left_out, sharpness=made.sharpness,
        deviation_mm=made.deviation_mm, metric=made.metric,
    )  # fmt: skip


def _heads(entries: Sequence[Entry], out: Path, store: Store) -> tuple[list[Found], dict[str, str]]:
    """Heads of one topology, and why the other captures have none."""
    heads: list[Found] = []
    left_out: dict[str, str] = {}
    for entry in entries:
        found = head_of(entry, out, store)
        if isinstance(found, str):
            left_out[entry.name] = found
        elif found.baked is None:
            left_out[entry.name] = "it has no maps on the head template"
        elif heads and _kind(found) != _kind(heads[0]):
            left_out[entry.name] = f"its head is of another template or subdivision than that of {heads[0].name}"
        else:
            heads.append(found)
    return heads, left_out


def _kind(found: Found) -> tuple[object, ...]:
    a = found.template.artifact
    return (a.template, a.quads, a.levels, a.regions)


def _record(done: Done[Any], heads: Sequence[Found], left_out: Mapping[str, str]) -> dict[str, Any]:
    made: AverageHead = done.located.artifact
    figures = made.model_dump(mode="json", exclude={"files"})
    return {**figures, "captures": [f.name for f in heads], "left_out": dict(left_out), "key": done.key}


def _text(record: Mapping[str, Any]) -> str:
    return json.dumps(record, indent=1) + "\n"


def _is_published(out: Path, record: Mapping[str, Any], located: Located[AverageHead]) -> bool:
    """Whether OUT/average is what would be written."""
    same = read_object(out / NAME / RECORD) == record
    return same and all(is_ours(out / NAME / f.path, {f.sha256}) for f in located.artifact.files)


def _publish(
    out: Path, record: Mapping[str, Any], located: Located[AverageHead], notify: Callable[[str], None]
) -> None:
    """Replace OUT/average as a whole; until then the old one is there."""
    out.mkdir(parents=True, exist_ok=True)
    known = published(out)
    moved = tidy(out, NAME, known)
    check_room_for_copies(out, [located.path(f) for f in located.artifact.files])

    def fill(folder: Path) -> None:
        for ref in located.artifact.files:
            shutil.copyfile(located.path(ref), folder / ref.path)
        (folder / RECORD).write_text(_text(record))

    made = prepare(out, NAME, fill, known)
    try:
        both = {p: known.get(p, frozenset()) | {h} for p, h in made.hashes.items()}
        note_published(out, {**known, **both})
        put(made)
    except BaseException:
        drop(made)
        raise
    others = {p: h for p, h in known.items() if p.partition("/")[0] != NAME}
    note_published(out, {**others, **{p: {h} for p, h in made.hashes.items()}})
    for before, now in (moved | made.aside).items():
        notify(f"{out / before} is yours: kept as {out / now}")
