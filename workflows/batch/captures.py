"""Which captures a batch is about: a FaceScape tree, or a list in CSV or JSON. Nothing is hashed or decoded here."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.errors import StageError, UsageError

PARAMS = "params.json"
PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr")
# One or two plain names: a list from outside can neither leave OUT nor name a hidden folder or the batch's own.
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}(/[A-Za-z0-9_][A-Za-z0-9_.-]{0,63})?")
RECORDS = "batch"  # the folder in OUT that BatchRequest.folder names
MAX_LIST_BYTES, MAX_CAPTURES = 64 << 20, 100_000


class Item(BaseModel):
    """A capture: where it is and what it is called. `fault`: why it can't be one. `own`: settings of its own."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    capture: Path
    subject: str = ""
    expression: str = ""
    fault: str | None = None
    own: dict[str, Any] = {}


class Row(BaseModel):
    """One line of a list."""

    model_config = ConfigDict(extra="forbid", str_strip_whitespace=True)

    capture: str = Field(min_length=1)
    name: str | None = None
    subject: str = ""
    expression: str = ""
    preset: str | None = None
    holdout: str | None = None
    seed: int | None = Field(None, ge=0)
    until: str | None = None


def find(root: Path, subjects: str | None = None, expressions: str | None = None) -> list[Item]:
    """The captures below `root` (or in the list `root`) that pass both filters, in natural order.

    Raises:
        StageError: nothing there, or nothing left by the filters. UsageError: a filter or a list can't be read.
    """
    root = root.absolute()  # workers and later commands have other working folders
    if root.is_dir():
        found = list(_tree(root))
    elif root.suffix.lower() in (".csv", ".json") and root.is_file():
        found = list(_listed(root))
    else:
        raise StageError(
            "there are no captures",
            where=root,
            value="a file of another kind" if root.exists() else "nothing",
            limit="a folder ID/EXPRESSION/params.json, or a .csv or .json list",
            remedy="check the path",
        )
    low_high = [ranges(text, option) for text, option in ((subjects, "--subjects"), (expressions, "--expressions"))]
    kept = [i for i in found if _passes(i.subject, low_high[0]) and _passes(i.expression, low_high[1])]
    if not kept:
        raise StageError(
            "there are no captures",
            where=root,
            value=f"{len(found)} found, 0 left by the filters" if found else "no folder ID/EXPRESSION/params.json",
            limit="at least one",
            remedy="loosen --subjects or --expressions" if found else "name the folder above the subjects, or a list",
        )
    _all_different(kept, root)
    return sorted(kept, key=lambda i: natural(i.name))


# ------------------------------------------------------------------ a tree
def _tree(root: Path) -> Iterator[Item]:
    """ID/EXPRESSION. A folder of photos without params.json, or with a name that no result can have, is reported and
    not skipped."""
    for subject in _folders(root):
        for folder in _folders(subject):
            fault = None
            if not (folder / PARAMS).is_file():
                if not any(p.suffix.lower() in PHOTOS for p in folder.iterdir()):
                    continue
                fault = (
                    f"{PARAMS} is missing: put it back, or name the folder in a list if its cameras are to be solved"
                )
            yield _in_tree(subject, folder, fault)


def _in_tree(subject: Path, folder: Path, fault: str | None) -> Item:
    """The item of one folder. The records of the batch are kept under its name: where the folder's own can't be that
    of a result, it gets one that is near to it, and a fault."""
    name = f"{subject.name}/{folder.name}"
    if NAME.fullmatch(name):
        return Item(name=name, capture=folder, subject=subject.name, expression=folder.name, fault=fault)
    shown, *parts = (t.encode("utf-8", "backslashreplace").decode() for t in (str(folder), subject.name, folder.name))
    mark = hashlib.sha256(os.fsencode(name)).hexdigest()[:6]  # two such names may have the same plain letters
    return Item(
        name=f"{_plain(parts[0])}/{_plain(parts[1])}-{mark}",
        capture=Path(shown),
        subject=parts[0],
        expression=parts[1],
        fault=f"no result can have the name of the folder {shown}: rename it, or give the capture a name in a list "
        "(letters a to z, digits, _ - ., at most 64 each for subject and expression)",
    )


def _plain(text: str) -> str:
    return re.sub(r"^[.-]", "_", re.sub(r"[^A-Za-z0-9_.-]", "_", text))[:50]


def _folders(of: Path) -> list[Path]:
    return sorted((p for p in of.iterdir() if p.is_dir() and not p.name.startswith(".")), key=lambda p: natural(p.name))


# ------------------------------------------------------------------ a list
def _listed(path: Path) -> Iterator[Item]:
    if path.stat().st_size > MAX_LIST_BYTES:
        raise _unreadable(path, f"{path.stat().st_size} bytes", f"at most {MAX_LIST_BYTES}")
    try:
        text = path.read_text(encoding="utf-8-sig")
        rows: Any = json.loads(text) if path.suffix.lower() == ".json" else _csv(text)
    except (ValueError, csv.Error, RecursionError) as e:
        raise _unreadable(path, e, "UTF-8 text, JSON or CSV") from e
    if not isinstance(rows, list) or len(rows) > MAX_CAPTURES:
        raise _unreadable(path, type(rows).__name__, f"a list of at most {MAX_CAPTURES} captures")
    for number, raw in enumerate(rows, 1):
        try:
            yield _item(Row.model_validate(raw), path.parent)
        except (ValidationError, ValueError) as e:
            fault = e.errors()[0] if isinstance(e, ValidationError) else {"loc": (), "msg": str(e)}
            where = ".".join(map(str, fault["loc"]))
            raise _unreadable(path, f"entry {number}: {where} {fault['msg']}".replace("  ", " "), _COLUMNS) from e


_COLUMNS = "capture, and if wanted name, subject, expression, " + ", ".join(["preset", "holdout", "seed", "until"])


def _csv(text: str) -> list[dict[str, Any]]:
    rows = list(csv.DictReader(text.splitlines(), strict=True))
    return [{k: v for k, v in row.items() if v not in (None, "")} for row in rows]


def _item(row: Row, beside: Path) -> Item:
    capture = (beside / row.capture).absolute()
    both = [p for p in (row.subject, row.expression) if p]
    name = row.name or "/".join(both if len(both) == 2 else [capture.name])
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r} is no name: letters, digits, _ - . and at most one / between two of them")
    own = row.model_dump(include={"preset", "holdout", "seed", "until"}, exclude_none=True)
    return Item(name=name, capture=capture, subject=row.subject, expression=row.expression, own=own)


def _unreadable(path: Path, value: object, limit: str) -> UsageError:
    return UsageError(
        "the list of captures can't be read", where=path, value=value, limit=limit, remedy="see docs/operations.md"
    )


def _all_different(items: Iterable[Item], root: Path) -> None:
    seen: dict[str, Item] = {}
    for item in items:
        if item.name.split("/")[0] == RECORDS:
            raise UsageError(
                "a capture's name is taken",
                where=root,
                value=item.name,
                limit=f"any but {RECORDS}, where the batch keeps its own records",
                remedy="rename the folder, or give it a name in a list",
            )
        if item.name in seen:
            raise UsageError(
                "two captures have one name",
                where=root,
                value=f"{item.name}: {seen[item.name].capture} and {item.capture}",
                limit="a name of its own for each",
                remedy="give one of them another name",
            )
        seen[item.name] = item


# ------------------------------------------------------------------ filters
def natural(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts 2 before 10."""
    parts = re.findall(r"\d+|\D+", text)
    return tuple((0, int(p), p) if p.isdecimal() else (1, 0, p.lower()) for p in parts)


def _passes(text: str, wanted: list[tuple[int, int]] | None) -> bool:
    if wanted is None:
        return True
    number = re.match(r"\d+", text)
    return number is not None and any(low <= int(number[0]) <= high for low, high in wanted)


def ranges(text: str | None, option: str) -> list[tuple[int, int]] | None:
    """ "1-40,57" -> [(1, 40), (57, 57)]; None lets everything pass."""
    if text is None:
        return None
    found = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", part)
        low, high = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if high < low:
            raise UsageError(
                "a filter can't be read",
                where=option,
                value=text,
                limit="numbers and ranges from low to high: 1-40 or 1,7,20-29",
                remedy="correct it",
            )
        found.append((low, high))
    return found
